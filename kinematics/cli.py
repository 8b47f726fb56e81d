"""The command ``points2dof``: parse, read, one library call, write, a short table."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from kinematics.errors import KinematicsError
from kinematics.motion_outputs import output_set
from kinematics.registration import geometry_options
from kinematics.registration.geometry_options import add_options
from kinematics.signals.series_options import add_series_arguments, series_options
from stapeskit.command import Outcome, Parser, run
from stapeskit.faults import Fault, collecting, raise_all

if TYPE_CHECKING:
    from kinematics.measure_motion import MotionInputs
    from kinematics.points2dof import Options
    from kinematics.readers import InputOptions
    from kinematics.results import MotionResult
    from stapeskit.own_files import OutputSet
    from stapeskit.records.measured_mass import MassInput

_EPILOG = """\
Vibrometer files, told by what they hold; several are parts of one measurement, or different runs when
they measure the same points again:
  tidy table      .csv, below
  universal file  .uff, .unv: functions 58 and 58b (frequency responses, spectra, coherence, cross and
                  auto spectra, time responses), nodes 15 or 2411, systems 18 or 2420, units 164
  PSV text        a folder of a FastScan (one file per frequency) or of single points (Real & Imag.)
  MATLAB, HDF5    .mat (v5, v7.3), .h5
  time series     .csv with a column time_s, .npz, .wav, .mat, .h5, with --channels FILE:
                  channel, role (response, reference, ignore), body, point, dir or dir_x, dir_y, dir_z,
                  unit (mm/s ...) or sensitivity (5 mm/s/V, 100 mV/g) [, x_mm, y_mm, z_mm] [, run] [, file]
Such files name points by numbers; --points or --body say which body each belongs to:
  --body stapes=1-10,12 --body base=11,13-20      --body stapes=scan.uff:1-9 --body base=plate.uff
  .svd files open in their own program only: export UFF or ASCII.
Tidy table, one row per body, point, beam and frequency (comma separated, header required):
  body, point, [x_mm, y_mm, z_mm,] dir_x, dir_y, dir_z, freq_hz, re_m_s, im_m_s
  The value is v . dir, positive towards the laser head. `dir` may hold x, y, z, -x, -y or -z instead.
  amp_m_s, phase_deg instead of re, im. Units by suffix: m, mm, um, nm (displacement), m_s (velocity),
  m_s2 (acceleration), rms_m_s ... Optional: sd_m_s (sd of the real = imaginary part, in the unit of the
  value), n_avg, coherence, run (one excitation each), repeat (names or numbers; compared for drift,
  creep and outliers, then pooled), level (amplitude of the excitation, any unit; level_db in decibels;
  tested for nonlinearity, then pooled at the highest). Empty or NaN value: missing. Lines that begin
  with # are comments.
points.csv:    body, point, x_mm, y_mm, z_mm [, sd_mm]
fiducials.csv: name, x_mm, y_mm, z_mm (vibrometer), x_ref_mm, y_ref_mm, z_ref_mm
               [, frame = plate (default) | scan | footplate] [, sd_mm | sd_x_mm, sd_y_mm, sd_z_mm]
               [, sd_ref_mm]
Written: X.csv, X.h5, X.channels.csv, X.html, named after --out X.csv.
Motion is displacement, peak, e^{+iwt}, about the footplate centre in footplate axes.
"""


def parser() -> Parser:
    """Return the options of the command."""
    made = Parser("points2dof", "Vibrometer points to the degrees of freedom of rigid bodies.", _EPILOG)
    made.add_argument("ldv", type=Path, nargs="+", metavar="LDV", help="vibrometer file or folder")
    made.add_argument("--points", type=Path, metavar="FILE", help="bodies and positions of the points")
    made.add_argument(
        "--body",
        action="append",
        default=[],
        metavar="NAME=POINTS",
        help="points of a body: 1-10,12 or FILE or FILE:1-10; once for each body",
    )
    made.add_argument(
        "--run",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="the excitation that a file belongs to; once for each file",
    )
    made.add_argument(
        "--beam",
        default="",
        metavar="DIR",
        help="direction towards the laser head where a file does not say it: x, -z ... or X,Y,Z",
    )
    made.add_argument(
        "--amplitude",
        default="",
        choices=("peak", "rms"),
        help="what amplitudes are where a file does not say it (default peak, with a warning)",
    )
    made.add_argument(
        "--length-unit",
        default="",
        choices=("m", "mm", "um"),
        help="unit of positions where a file does not say it (default m, with a warning)",
    )
    made.add_argument(
        "--n-avg",
        type=float,
        metavar="N",
        help="averages behind each value where a file does not say it: with coherence they give its noise",
    )
    made.add_argument(
        "--mapping",
        type=Path,
        metavar="FILE.toml",
        help="which variable of a MATLAB or HDF5 file is what (default: FILE.mat.toml, or told by names)",
    )
    made.add_argument("--fiducials", type=Path, metavar="FILE", help="points that tie vibrometer and scan")
    made.add_argument(
        "--frame",
        choices=("footplate", "plate", "scan"),
        help="frame of positions and directions when there are no fiducials (default footplate)",
    )
    made.add_argument("--mass", type=Path, metavar="mass.json", help="frames from ct2mass")
    made.add_argument(
        "--dof",
        default="all",
        metavar="LIST",
        help="all, or a list out of x,y,z,alpha,beta,gamma (default all)",
    )
    made.add_argument("--reference", default="", metavar="BODY:DOF", help="responses per unit of this motion")
    made.add_argument(
        "--reference-noise",
        type=float,
        default=0.0,
        metavar="S",
        help="relative noise (sd of the real part) of the signal that all readings refer to (default 0)",
    )
    made.add_argument(
        "--robust", default="none", choices=("none", "huber", "t4"), help="resist outliers (default none)"
    )
    made.add_argument(
        "--repeats",
        default="pool",
        choices=("pool", "separate"),
        help="pool repeats and levels of a run after comparing them (default), or keep them as runs",
    )
    made.add_argument(
        "--mirror", choices=("x", "y", "z"), help="turn this axis of left-handed scanner coordinates round"
    )
    add_options(made)
    made.add_argument("--out", type=Path, default=Path("dof.csv"), metavar="FILE.csv", help="default dof.csv")
    made.add_force()
    add_series_arguments(made)
    made.add_config()
    return made


def work(arguments: list[str]) -> tuple[argparse.Namespace, Outcome]:
    """Run the command on its arguments."""
    options = parser().parse(arguments)
    reading, chosen = _choices(options, _faults(options))
    inputs = motion_inputs(options, reading)
    outputs = output_set(options.out, [*inputs.by_role.values(), options.config], options.mass, options.force)
    outputs.check()
    result = _measure(options, inputs, chosen, options.mass, arguments)
    return options, _outcome(result, _write(options, result, outputs))


def measure(arguments: list[str], given_mass: MassInput | None = None) -> MotionResult:
    """Return the motion that the command with these arguments writes, without writing it.

    Parameters
    ----------
    arguments : list of str
    given_mass : path, MeasuredMass, or result of ct2mass, optional
        In place of ``--mass``.
    """
    options = parser().parse(arguments)
    options.mass = given_mass if given_mass is not None else options.mass
    reading, chosen = _choices(options, _faults(options))
    return _measure(options, motion_inputs(options, reading), chosen, options.mass, arguments)


def _measure(
    options: argparse.Namespace,
    inputs: MotionInputs,
    chosen: Options,
    given_mass: MassInput | None,
    arguments: list[str],
) -> MotionResult:
    from kinematics.measure_motion import motion_of, read_inputs
    from stapeskit.provenance import record
    from stapeskit.records.measured_mass import measured_mass

    mass = None if given_mass is None else measured_mass(given_mass)
    read = read_inputs(inputs)
    files = {**inputs.by_role, "mass": None if mass is None else mass.provenance_input}
    provenance = record(files, parameters(inputs, chosen, options), ["points2dof", *arguments])
    return motion_of(inputs, read, chosen, mass, provenance)


def motion_inputs(options: argparse.Namespace, reading: InputOptions) -> MotionInputs:
    """Return the files that the options name, and the coordinates that they are in."""
    from kinematics.measure_motion import MotionInputs

    return MotionInputs(
        files=tuple(options.ldv),
        points=options.points,
        fiducials=options.fiducials,
        plate_points=options.plate_points,
        bone_points=options.bone_points,
        frame=options.frame,
        mirror=options.mirror,
        mirror_points=options.mirror_points,
        reading=reading,
    )


def parameters(inputs: MotionInputs, chosen: Options, options: argparse.Namespace) -> dict[str, Any]:
    """Return the choices that provenance records, as JSON-able data."""
    reading = inputs.reading
    tied = inputs.source_frame == "vibrometer"
    return {
        "dof": list(chosen.dof),
        "reference": chosen.reference,
        "robust": chosen.robust,
        "reference_noise": chosen.reference_noise,
        "repeats": chosen.repeats,
        "frame": None if tied else inputs.source_frame,
        "mirror": inputs.mirror,
        "body": list(reading.body),
        "run": list(reading.run),
        "beam": reading.beam,
        "amplitude": reading.amplitude,
        "length_unit": reading.length_unit,
        "n_avg": reading.n_avg,
        **geometry_options.parameters(options),
        "series": None if reading.series is None else {k: str(v) for k, v in vars(reading.series).items()},
    }


def _choices(options: argparse.Namespace, faults: list[Fault]) -> tuple[InputOptions, Options]:
    """Return what the options say about files and fit.

    Raises
    ------
    KinematicsError
        The faults known before, and all of the options here, together.
    """
    from kinematics.points2dof import Options
    from kinematics.readers import InputOptions
    from kinematics.readers.formats import describes_series
    from stapeskit.spatial import parse_dof

    said, chosen, series, priors, dof = InputOptions(), Options(), None, None, Options().dof
    with collecting(faults):
        series = series_options(options, any(describes_series(path) for path in options.ldv))
    with collecting(faults):
        said = InputOptions(
            tuple(options.body),
            tuple(options.run),
            options.beam,
            options.amplitude,
            options.length_unit,
            options.n_avg,
            options.mapping,
            series,
        )
    with collecting(faults):
        priors = geometry_options.priors(options.calibrate, options.axes_sd, options.beam_sd, options.gain_sd)
    with collecting(faults):
        dof = parse_dof(options.dof)
    with collecting(faults):
        chosen = Options(
            dof, options.reference, options.robust, priors, options.repeats, options.reference_noise
        )
    raise_all(KinematicsError, dict.fromkeys(faults))
    return said, chosen


def _faults(options: argparse.Namespace) -> list[Fault]:
    """List options that contradict each other, before any file is read."""
    faults = []
    if options.out.suffix.lower() != ".csv":
        faults.append(Fault("--out", "a name that ends in .csv", options.out, "", "Add .csv"))
    elif options.out.is_dir():
        faults.append(Fault("--out", "a file", f"the folder {options.out}", "", "Choose another name"))
    if options.fiducials is not None and options.frame is not None:
        faults.append(
            Fault(
                "--frame",
                "left out beside --fiducials, which name their frame themselves",
                options.frame,
                next_step="Put the frame into the column frame of the fiducials file",
            )
        )
    if options.frame in ("plate", "scan") and options.mass is None:
        faults.append(
            Fault(
                f"--frame {options.frame}", "given with --mass mass.json", "no --mass", next_step="Add --mass"
            )
        )
    named = [("the vibrometer file", path) for path in options.ldv]
    named += [(f"--{name}", getattr(options, name)) for name in ("points", "fiducials", "mass", "mapping")]
    named += [("--plate-points", options.plate_points), ("--bone-points", options.bone_points)]
    faults += geometry_options.faults(options)
    for thing, path in named:
        if isinstance(path, Path) and not path.exists():
            faults.append(Fault(thing, "an existing file", path, "", "Check its name and folder"))
    return faults


def _write(options: argparse.Namespace, result: MotionResult, outputs: OutputSet) -> list[Path]:
    """Write all outputs at once and return their paths."""
    from kinematics.motion_outputs import write_outputs

    with outputs.staged() as stage:
        write_outputs(stage, options.out.stem, result, result.scenery)
    return [outputs.folder / name for name in outputs.names]


def _outcome(result: MotionResult, files: list[Path]) -> Outcome:
    """Return the table of the terminal and the JSON result."""
    from kinematics.report import geometry_report
    from kinematics.report.summary import bodies_json, summary_rows

    motion = result.motion
    return Outcome(
        "points2dof",
        summary_rows(result),
        result.notices,
        files,
        {
            "schema": "stapeskit.points2dof/1",
            "dof": list(motion.dof),
            "reference": motion.reference,
            "inputs_say": list(result.measurement.said),
            "runs": list(motion.runs),
            "lines": len(motion.freq_hz),
            "bodies": bodies_json(result),
            **geometry_report.as_json(result),
            "repeats": [one.as_json() for one in result.repeats],
            "verdicts": [
                {
                    "run": v.run,
                    "body": v.body,
                    "point": v.point,
                    "direction": [float(value) for value in v.direction],
                    "verdict": v.verdict,
                    "estimate": v.estimate,
                    "p_value": v.p_value,
                }
                for v in result.channels
                if v.verdict != "ok"
            ],
            "warnings": [notice.as_json() for notice in result.notices],
            "files": [str(path) for path in files],
        },
    )


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("points2dof", work)

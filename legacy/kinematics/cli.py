"""The command ``points2dof``: parse, read, one library call, write, a short table."""

from __future__ import annotations

from legacy.stapeskit.process import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from pathlib import Path
    from typing import NoReturn

    from legacy.kinematics.results import MotionResult
    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.option_parser import ParsedOptions, Parser
    from legacy.stapeskit.own_files import OutputSet

_EPILOG = """\
Vibrometer files, recognised by their content; several are parts of one
measurement, or different runs when they measure the same points again:
{}
.svd files open in their own program only: export UFF or ASCII.
Time series need --channels FILE: channel, role (response, reference, ignore),
  body, point, dir or dir_x, dir_y, dir_z, unit (mm/s ...) or sensitivity
  (5 mm/s/V, 100 mV/g) [, x_mm, y_mm, z_mm] [, run] [, file]
Other files than the tidy table name points by numbers; --points or --body
assign them to bodies:
  --body stapes=1-10,12 --body base=11,13-20
  --body stapes=scan.uff:1-9 --body base=plate.uff
Tidy table, one row per body, point, beam and frequency (comma separated, header
required):
  body, point, [x_mm, y_mm, z_mm,] dir_x, dir_y, dir_z, freq_hz, re_m_s, im_m_s
  The value is v . dir, positive towards the laser head. `dir` may hold x, y, z,
  -x, -y or -z instead.
  amp_m_s, phase_deg instead of re, im. Units by suffix: m, mm, um, nm
  (displacement), m_s (velocity), m_s2 (acceleration), rms_m_s ... Optional:
  sd_m_s (sd of the real = imaginary part, in the unit of the value), n_avg,
  coherence, run (one excitation each), repeat (names or numbers; compared for
  drift, creep and outliers, then pooled), level (amplitude of the excitation,
  any unit; level_db in decibels; tested for nonlinearity, then pooled at the
  highest). Empty or NaN value: missing. Lines that begin with # are comments.
points.csv:    body, point, x_mm, y_mm, z_mm [, sd_mm]
fiducials.csv: name, x_mm, y_mm, z_mm (vibrometer), x_ref_mm, y_ref_mm, z_ref_mm
               [, frame = plate (default) | scan | footplate]
               [, sd_mm | sd_x_mm, sd_y_mm, sd_z_mm] [, sd_ref_mm]
Written: X.csv, X.h5, X.channels.csv, X.html, named after --out X.csv.
Motion is displacement, peak, e^{{+iwt}}, about the footplate centre in footplate
axes.
"""


def parser() -> Parser:
    """Return the parser of the command."""
    from textwrap import fill

    from legacy.kinematics.options import LdvOptions, PointsFiles
    from legacy.kinematics.readers.formats import FORMATS
    from legacy.stapeskit.option_parser import Parser

    formats = [
        fill(
            f"{entry.words}: {entry.reads.replace('`', '')}",
            80,
            initial_indent="  ",
            subsequent_indent="      ",
        )
        for entry in reversed(FORMATS)
        if entry.reads
    ]

    return Parser(
        "points2dof",
        "Vibrometer points to the degrees of freedom of rigid bodies.",
        _EPILOG.format("\n".join(formats)),
        LdvOptions,
        PointsFiles,
    )


def work(arguments: list[str]) -> tuple[ParsedOptions, Outcome]:
    """Run the command on its arguments."""
    options = parser().parse(arguments)
    from legacy.kinematics.measure_motion import measure, motion_inputs
    from legacy.kinematics.motion_outputs import output_set
    from legacy.kinematics.options import LdvOptions
    from legacy.stapeskit.progress import stage_on_terminal

    ldv = options.make(LdvOptions)
    with stage_on_terminal(not options.quiet and not options.json) as progress:
        progress("reading the measurement")
        inputs = motion_inputs(ldv)
        outputs = output_set(
            options.out, [*inputs.by_role.values(), options.config], options.mass, options.force
        )
        outputs.check()
        progress("fitting rigid motion, looking for faults")
        result = measure(ldv, inputs, options.mass, ["points2dof", *arguments])
        progress("drawing the report")
        files = _write(options, result, outputs)
    return options, _outcome(result, files)


def _write(options: ParsedOptions, result: MotionResult, outputs: OutputSet) -> list[Path]:
    """Write all outputs at once and return their paths."""
    from legacy.kinematics.motion_outputs import write_outputs

    with outputs.staged() as stage:
        write_outputs(stage, options.out.stem, result, result.scenery)
    return [outputs.folder / name for name in outputs.names]


def _outcome(result: MotionResult, files: list[Path]) -> Outcome:
    """Return the table of the terminal and the JSON result."""
    from legacy.kinematics.report import geometry_report
    from legacy.kinematics.report.summary import bodies_json, summary_rows
    from legacy.stapeskit.command import Outcome

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
            "repeats": [repeat.as_json() for repeat in result.repeats],
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
            "corrections": [correction.as_json(result.measurement) for correction in result.corrections],
            "warnings": [notice.as_json() for notice in result.notices],
            "files": [str(path) for path in files],
        },
    )


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("points2dof", work)


if __name__ == "__main__":
    main()

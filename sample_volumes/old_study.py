"""Make the sample study, or other ears: scan, vibrometer data, study file and the truth behind them.

    python -m sample_volumes.old_study                       the sample study, always the same
    python -m sample_volumes.old_study --out ear2 --seed 2 --gap-um 60 --bridges 2
    python -m sample_volumes.old_study --out ear3 --seed 3 --incus-gap-um 60 --bone-reach 1.5 --mirror z
    python -m sample_volumes.old_study --out big --voxel-um 5 --shape 1024,1024,1024 --only scan

Vibrometer data and grey values are simulated on the geometry of a real stapes; nothing here is a measurement.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.page.quantities import MASS
from sample_volumes import bodies
from sample_volumes.analytic import write_analytic_stapes
from sample_volumes.exports import write_exports
from sample_volumes.gutter import write_gutter_stapes
from sample_volumes.phantom import Ear, Scene, scene, truth, write_scan
from sample_volumes.scanner import DTYPES, stored_levels
from sample_volumes.vibrometer import Recording, Vibrometry, record

HERE = Path(__file__).parent
DENSITY_SD = 0.01

_SIMULATED = (
    "the grey values, the bone around it, the plate and all vibrometer data are computed. Nothing here is a "
    "measurement."
)
_REAL = (
    f"SIMULATED on real geometry: the stapes is a real one (OpenEar library, Sieber et al. 2019, CC BY 4.0); "
    f"{_SIMULATED}"
)
_MADE = f"SIMULATED: the stapes is a made one; {_SIMULATED}"


def reseeded(ear: Ear, how: Vibrometry, seed: int) -> tuple[Ear, Vibrometry]:
    """Return the same study with pose, noise, position errors and stated density drawn anew."""
    return replace(ear, pose_seed=seed, noise_seed=seed), replace(how, seed=seed)


def make_study(
    folder: Path, ear: Ear, how: Vibrometry, name: str, parts: tuple[str, ...] = ("scan", "ldv")
) -> dict[str, Any]:
    """Write a study into a folder and return the truth behind it.

    Parameters
    ----------
    folder : Path
        Made when missing.
    ear, how
        The ear with its scan, and its measurement.
    name : str
        Name of the study.
    parts : tuple of str
        ``scan`` and ``ldv``, or one of them; ``exports`` writes the measurement in other formats too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    placed = scene(ear)
    behind = truth(placed)
    behind |= {
        "dof": ["y", "alpha", "gamma"],
        "stiffness_si": PAPER_STIFFNESS.tolist(),
        "damping_si": PAPER_DAMPING_CORRECTED.tolist(),
    }
    if "scan" in parts:
        write_scan(folder / "scan.tif", placed)
    if "ldv" in parts:
        stapes = bodies.stapes_in_footplate(ear.stapes)
        frame, marks = _references(placed, behind)
        mass = np.array(behind["mass_matrix_si"])
        recording = record(mass, frame, how, marks, stapes=stapes)
        write_recording(folder, recording, how, frame.source)
        if "exports" in parts:
            write_exports(folder / "exports", recording)
    if ear.gradient:
        air, _, bone = stored_levels(ear.levels, ear.dtype)
        points = f"points = [[{air:g}, 0], [{bone:g}, {ear.density_kg_m3:g}]]\n"
        (folder / "calibration.toml").write_text(points, encoding="utf-8")
    (folder / "study.toml").write_text(study_text(name, ear, placed, how), encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps(behind, indent=1) + "\n", encoding="utf-8")
    return behind


def _references(
    placed: Scene, behind: dict[str, Any]
) -> tuple[RigidTransform, list[tuple[str, np.ndarray[Any, Any]]]]:
    """Return the frame that ties the vibrometer to the scan, and its fiducials: plate, else scan."""
    plate = RigidTransform(np.array(behind["plate_from_footplate"]), "plate", "footplate").inverse()
    marks = {name: np.array(place) for name, place in behind["fiducials_in_plate_mm"].items()}
    if placed.ear.plate:
        return plate, list(marks.items())
    scan_from_plate = placed.scan_from_footplate @ plate
    frame = placed.scan_from_footplate.inverse()
    return frame, [(name, scan_from_plate.points(place)) for name, place in marks.items()]


def study_text(name: str, ear: Ear, placed: Scene, how: Vibrometry) -> str:
    """Return the study file; the stated density is drawn around the true one, as a lab would know it."""
    rng = np.random.default_rng([ear.noise_seed, 11])
    sd = DENSITY_SD * ear.density_kg_m3
    stated = ear.density_kg_m3 + sd * rng.standard_normal()
    anterior = placed.scan_from_footplate.rotation[:, 0]
    direction = ", ".join(f"{part:.1f}" for part in anterior)
    state = "Incus removed" if ear.incus_gap_mm is None else "Incus attached"
    notes = f"{_REAL if ear.stapes == bodies.OPENEAR_STAPES else _MADE} {state}, cochlea open."
    tables = [
        ["[study]", f'name = "{name}"', f'notes = "{notes}"', 'truth = "truth.json"'],
        [
            "[scan]",
            'file = "scan.tif"',
            f'density_kg_m3 = "{stated:.1f}+-{sd:.1f}"',
            'side = "left"',
            f"anterior = [{direction}]",
            *([f'mirror = "{ear.mirror}"'] if ear.mirror else []),
        ],
        [
            "[ldv]",
            'file = "ldv.csv"',
            'points = "points.csv"',
            'fiducials = "fiducials.csv"',
            *([f'mirror = "{how.mirror}"'] if how.mirror else []),
        ],
        ["[fit]", 'dof = "y,alpha,gamma"', 'estimator = "ml"'],
    ]
    return "\n\n".join("\n".join(table) for table in tables) + "\n"


def write_recording(folder: Path, recording: Recording, how: Vibrometry, frame: str = "plate") -> None:
    """Write ldv.csv, points.csv and fiducials.csv, the fiducials' references in ``frame``."""
    many = len(recording.runs) > 1
    digits = ".15g" if how.noise_free else ".7g"
    header = "body,point,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s" + ("" if how.noise_free else ",sd_m_s")
    lines = [header + (",run" if many else "")]
    for run, excitation in enumerate(recording.runs):
        tail = f",{excitation}" if many else ""
        for channel, body in enumerate(recording.body):
            direction = ",".join(f"{part:.12g}" for part in recording.direction[channel])
            head = f"{body},{recording.point[channel]},{direction}"
            sd = "" if how.noise_free else f",{recording.sd_m_s[run, channel]:.5g}"
            for freq, value in zip(recording.freq_hz, recording.velocity_m_s[run, channel], strict=True):
                lines.append(f"{head},{freq:.12g},{value.real:{digits}},{value.imag:{digits}}{sd}{tail}")
    _write(folder / "ldv.csv", lines)
    places = dict(zip(zip(recording.body, recording.point, strict=True), recording.position_mm, strict=True))
    coordinate = ".15g" if how.noise_free else ".4f"
    sd_mm = "" if how.noise_free else f",{how.position_sd_mm:g}"
    rows = [
        f"{body},{point}," + ",".join(f"{part:{coordinate}}" for part in place) + sd_mm
        for (body, point), place in places.items()
    ]
    _write(folder / "points.csv", ["body,point,x_mm,y_mm,z_mm" + (",sd_mm" if sd_mm else ""), *rows])
    sd_mm = "" if how.noise_free else f",{how.fiducial_sd_mm:g}"
    rows = [
        f"{name}," + ",".join(f"{part:{coordinate}}" for part in (*seen, *place)) + f",{frame}{sd_mm}"
        for name, seen, place in recording.fiducials
    ]
    head = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame" + (",sd_mm" if sd_mm else "")
    _write(folder / "fiducials.csv", [head, *rows])


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return an option's reader of ``count`` numbers with commas between them."""

    def read(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"must be {count} numbers with commas between them; got {text}")
        return values

    return read


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_sample", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder (the sample study's own)")
    parser.add_argument("--seed", type=int, default=1, help="pose, noise, positions and stated density")
    parser.add_argument("--pose-seed", type=int, help="pose in the scanner alone (--seed)")
    parser.add_argument("--only", choices=("scan", "ldv"), help="make this part alone")
    parser.add_argument(
        "--exports", action="store_true", help="the measurement in other formats too (the sample has them)"
    )
    parser.add_argument("--voxel-um", default="25", help="one number, or DX,DY,DZ")
    parser.add_argument("--shape", help="NX,NY,NZ voxels (the smallest that holds everything)")
    parser.add_argument("--gap-um", type=float, default=200.0, help="ligament gap")
    parser.add_argument("--bridges", type=int, default=0, help="bony bridges across the gap")
    parser.add_argument("--bridge-radius-um", type=float, default=50.0)
    parser.add_argument("--psf", type=float, default=1.2, help="sigma of the point spread, voxels")
    parser.add_argument("--noise", type=float, default=0.04, help="of the contrast between bone and air")
    parser.add_argument(
        "--noise-correlation", type=float, default=0.0, help="sigma of the blur of the noise, voxels"
    )
    parser.add_argument(
        "--cupping", type=float, default=0.0, help="percent of the contrast lost in the middle of the view"
    )
    parser.add_argument(
        "--levels",
        type=_numbers(3),
        default="8000,15000,30000",
        help="air, plastic, bone; 0 to 65535 whatever the type that is stored",
    )
    parser.add_argument("--dtype", choices=DTYPES, default="uint16", help="numbers in the file")
    parser.add_argument(
        "--gradient", type=float, default=0.0, help="percent of density from halfway up to either end"
    )
    parser.add_argument(
        "--tilt", type=float, default=18.0, help="most lean of the sample in the scanner, degrees"
    )
    parser.add_argument(
        "--upright", choices=("x", "y", "z"), default="z", help="scan axis near the lateral direction"
    )
    parser.add_argument("--shift-mm", default="0,0,0", help="moves the sample in the volume")
    parser.add_argument(
        "--plate-tilt-deg",
        type=_numbers(2),
        default="4,-3",
        help="of the plate about x and z of the footplate",
    )
    parser.add_argument("--plate-turn-deg", type=float, default=12.0, help="of the plate about y")
    parser.add_argument("--plate-distance-mm", type=float, default=0.8, help="plate face to footplate centre")
    parser.add_argument(
        "--plate-gap-um", type=float, help="plate face to the nearest point of the stapes; 0: contact"
    )
    parser.add_argument(
        "--plate-reach", type=float, default=1.0, help="above 1: the plate runs out of the field of view"
    )
    parser.add_argument(
        "--bone-reach", type=float, default=1.0, help="above 1: bone runs out of the field of view"
    )
    parser.add_argument("--incus-gap-um", type=float, help="add an incus; negative: grown onto the head")
    parser.add_argument("--dust", type=int, default=0, help="loose fragments")
    parser.add_argument("--mirror", choices=("x", "y", "z"), default="", help="store slices in reverse order")
    parser.add_argument("--no-plate", action="store_true")
    parser.add_argument("--no-bone", action="store_true", help="no peripheral bone")
    parser.add_argument(
        "--phantom",
        choices=("openear", "analytic", "gutter"),
        default="openear",
        help="real stapes, or a made one: with solid crura, or with gutters for crura",
    )
    parser.add_argument("--stapes", type=Path, help="closed surface of another stapes, mm")
    parser.add_argument("--ldv-noise", type=float, default=0.01)
    parser.add_argument("--position-sd-um", type=float, default=10.0)
    parser.add_argument("--fiducial-sd-um", type=float, default=10.0)
    parser.add_argument("--excitations", default="y", help="one run each, e.g. y,x,z")
    parser.add_argument("--noise-free", action="store_true", help="vibrometer data without any error")
    return parser


def _stapes(options: argparse.Namespace) -> Path:
    """Return the mesh of the stapes; a made one is written beside the study."""
    if options.stapes is not None:
        return Path(options.stapes)
    if options.phantom == "openear":
        return bodies.OPENEAR_STAPES
    options.out.mkdir(parents=True, exist_ok=True)
    if options.phantom == "gutter":
        return write_gutter_stapes(options.out / "gutter_stapes.ply")
    return write_analytic_stapes(options.out / "analytic_stapes.ply")


def main(arguments: list[str] | None = None) -> None:
    """Make what the command line asks for."""
    options = _parser().parse_args(arguments)
    spacing = [float(part) * 1e-3 for part in options.voxel_um.split(",")] * 3
    shape = None if options.shape is None else tuple(int(part) for part in options.shape.split(","))
    tilt, levels = options.plate_tilt_deg, options.levels
    ear = replace(
        Ear(),
        voxel_mm=tuple(spacing[:3]),
        shape=shape,
        shift_mm=tuple(float(part) for part in options.shift_mm.split(",")),
        gap_mm=options.gap_um * 1e-3,
        bridges=options.bridges,
        bridge_radius_mm=options.bridge_radius_um * 1e-3,
        psf_voxels=options.psf,
        noise=options.noise,
        noise_correlation_voxels=options.noise_correlation,
        cupping=options.cupping * 1e-2,
        levels=(levels[0], levels[1], levels[2]),
        dtype=options.dtype,
        gradient=options.gradient * 1e-2,
        tilt_deg=options.tilt,
        upright=options.upright,
        plate_tilt_deg=(tilt[0], tilt[1]),
        plate_turn_deg=options.plate_turn_deg,
        plate_distance_mm=options.plate_distance_mm,
        plate_gap_mm=None if options.plate_gap_um is None else options.plate_gap_um * 1e-3,
        plate_reach=options.plate_reach,
        bone_reach=options.bone_reach,
        incus_gap_mm=None if options.incus_gap_um is None else options.incus_gap_um * 1e-3,
        dust=options.dust,
        mirror=options.mirror,
        plate=not options.no_plate,
        bone=not options.no_bone,
        stapes=_stapes(options),
        pose_seed=options.seed if options.pose_seed is None else options.pose_seed,
        noise_seed=options.seed,
    )
    how = Vibrometry(
        noise=options.ldv_noise,
        position_sd_mm=options.position_sd_um * 1e-3,
        fiducial_sd_mm=options.fiducial_sd_um * 1e-3,
        excitations=tuple(options.excitations.split(",")),
        noise_free=options.noise_free,
        seed=options.seed,
    )
    parts = ("scan", "ldv") if options.only is None else (options.only,)
    if "ldv" in parts and (options.exports or options.out == HERE):
        parts = (*parts, "exports")
    name = "sample ear" if options.out == HERE else f"simulated ear {options.seed}"
    behind = make_study(options.out, ear, how, name, parts)
    print(f"{options.out}: {', '.join(parts)}; true mass {MASS.text(behind['mass_kg'], '.4f')}")


if __name__ == "__main__":
    main()

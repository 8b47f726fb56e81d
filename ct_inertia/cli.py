"""The command `ct2mass`: a micro-CT scan in, the mass matrix of the stapes out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from stapeskit.background import take_short_turns
from stapeskit.command import Outcome, Parser, numbers, run, value_with_sd
from stapeskit.faults import Fault, StapeskitError
from stapeskit.memory import hold_little_memory, keep_algebra_to_one_thread

if TYPE_CHECKING:
    from ct_inertia.ct2mass import MassOptions, MassResult
    from ct_inertia.readers.raw_layout import RawLayout
    from stapeskit.own_files import OutputSet
    from stapeskit.provenance import Hashes
    from stapeskit.warnings import Notice

_DESCRIPTION = """Mass matrix of a stapes about the centre of its footplate, from a micro-CT scan.

SCAN is a volume (TIFF, OME-Zarr, NRRD, MHA, NIfTI, DICOM, Scanco, VGStudio, Amira, raw), a folder of slices
or DICOM files, or a closed surface mesh (STL, PLY, OBJ, GLB; mm). Coordinates and directions are x, y, z in
scan coordinates, mm."""

_EPILOG = """Exit code 0: done; 2: the input is at fault, with one sentence that says what to do; 1: a bug.

examples:
  ct2mass scan.tif --density 1900+-60 --anterior -0.9,0.1,0 --side left
  ct2mass scan.tif --spacing 0.018 --mass-mg 3.1+-0.05
  ct2mass --labels corrected.seg.nrrd --density 1900
  ct2mass stapes.stl --density 1900
  ct2mass scan.tif --mass-mg 3.1+-0.05 --calibration phantom.toml --density 1900   (compared; the mass leads)
  ct2mass scan.tif --density 1900 --export mjcf,urdf,abaqus,mat --faces 20000

FILE.toml of --calibration holds two or more points, air and a known material, or the inserts of a
hydroxyapatite phantom with the line from mineral to bone density:
  points = [[2000, 0], [20000, 1900]]                                  # grey value, kg/m3
or
  points_mg_ha_cm3 = [[3100, 0], [9800, 400], [16400, 800]]            # grey value, mg HA/cm3
  kg_m3_at_zero = 1000                                                 # density of bone without mineral
  kg_m3_per_mg_ha_cm3 = 0.75
and, if known, sd_kg_m3 = 30, the standard deviation of a density read off the line."""

_ENDINGS = (".nii.gz", ".seg.nrrd", ".ome.tiff", ".ome.tif", ".ome.zarr")


def parser() -> Parser:
    """Return the parser of the command's options."""
    made = Parser("ct2mass", _DESCRIPTION, _EPILOG)
    made.add_argument("scan", nargs="?", type=Path, metavar="SCAN", help="volume, folder of slices, or mesh")
    mass = made.add_argument_group(
        "mass (at least one; a measured mass leads, then a calibration, then a density)"
    )
    mass.add_argument("--density", type=value_with_sd, metavar="RHO[+-SD]", help="density of the bone, kg/m3")
    mass.add_argument(
        "--mass-mg", type=value_with_sd, metavar="M[+-SD]", help="mass of the bone from a balance, mg"
    )
    mass.add_argument(
        "--calibration", type=Path, metavar="FILE.toml", help="density of every voxel from its grey value"
    )
    mass.add_argument(
        "--add-mass",
        type=_added_mass,
        action="append",
        metavar="X,Y,Z,MG[+-SD]",
        help="a bead, glue, a tendon stump: a point mass; may be repeated",
    )
    reading = made.add_argument_group("reading")
    reading.add_argument(
        "--spacing", type=_spacing, metavar="H|DX,DY,DZ", help="voxel size, mm; overrides the file"
    )
    reading.add_argument(
        "--voxel-size-sd", type=float, metavar="PERCENT", help="standard deviation of the voxel size"
    )
    reading.add_argument(
        "--mirror",
        choices=("x", "y", "z"),
        help="reverse the slices along an axis; points are those of the mirrored scan",
    )
    raw = made.add_argument_group("raw voxels without a header")
    raw.add_argument(
        "--shape", type=_shape, metavar="NX,NY,NZ", help="numbers of voxels; x runs fastest in the file"
    )
    raw.add_argument(
        "--dtype", metavar="TYPE", help="uint8, int8, uint16, int16, uint32, int32, float32, float64"
    )
    raw.add_argument("--byte-order", choices=("little", "big"), help="default little")
    raw.add_argument("--header-bytes", type=int, metavar="N", help="bytes before the first voxel")
    reading.add_argument("--nan-as-air", action="store_true", help="let voxels that are not finite be air")
    finding = made.add_argument_group("finding the stapes")
    finding.add_argument("--labels", type=Path, metavar="FILE", help="label volume; never written over")
    finding.add_argument("--stapes-label", type=int, default=1, metavar="N", help="default 1")
    finding.add_argument("--plate-label", type=int, default=2, metavar="N", help="default 2")
    finding.add_argument("--threshold", type=float, metavar="T", help="grey value between air and bone")
    finding.add_argument(
        "--seed", type=numbers(3, "--seed"), metavar="X,Y,Z", help="a point inside the stapes"
    )
    finding.add_argument(
        "--box", type=numbers(6, "--box"), metavar="X0,Y0,Z0,X1,Y1,Z1", help="part of the scan to look at"
    )
    frames = made.add_argument_group("frames")
    frames.add_argument(
        "--anterior",
        type=numbers(3, "--anterior"),
        metavar="X,Y,Z",
        help="direction towards anterior; only its sign along the footplate is used",
    )
    frames.add_argument(
        "--side", choices=("left", "right"), help="names z superior (left) or inferior (right)"
    )
    frames.add_argument(
        "--landmarks", type=Path, metavar="FILE", help=".mrk.json, .fcsv, .pp or .csv with named points"
    )
    frames.add_argument(
        "--plate-fiducials",
        type=Path,
        metavar="FILE",
        help="CSV name,x_mm,y_mm,z_mm in the scan [,x_ref_mm,y_ref_mm,z_ref_mm in the plate frame]",
    )
    output = made.add_argument_group("output")
    output.add_argument("--out", type=Path, metavar="DIR", help="default <scan name>_mass")
    output.add_argument("--no-report", action="store_true", help="do not write report.html")
    output.add_argument(
        "--export",
        type=_formats,
        metavar="LIST|all",
        default=(),
        help="stl, obj (mm, scan axes), glb (m, footplate axes), mjcf (MuJoCo), urdf, abaqus, mat",
    )
    output.add_argument(
        "--smooth", type=int, metavar="N", help="steps of smoothing of the surface shown and exported"
    )
    output.add_argument("--faces", type=int, metavar="N", help="triangles of the surface shown and exported")
    output.add_argument("--sha256", action="store_true", help="hash the inputs with SHA-256")
    made.add_force()
    made.add_config()
    return made


def _formats(text: str) -> tuple[str, ...]:
    from ct_inertia.exports import parse_formats

    try:
        return parse_formats(text)
    except StapeskitError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from fault


def _spacing(text: str) -> tuple[float, ...]:
    values = numbers((1, 3), "--spacing")(text)
    if min(values) <= 0.0:
        raise argparse.ArgumentTypeError(f"--spacing must be positive, in mm; got {text}")
    return values


def _shape(text: str) -> tuple[int, int, int]:
    x, y, z = (int(n) if n == int(n) else n for n in numbers(3, "--shape")(text))
    if min(x, y, z) < 2 or not all(isinstance(n, int) for n in (x, y, z)):
        raise argparse.ArgumentTypeError(f"--shape must be three whole numbers of at least 2; got {text}")
    return int(x), int(y), int(z)


def _raw_layout(given: argparse.Namespace) -> RawLayout | None:
    """Return the layout of raw voxels, or None when none of its options is given."""
    told = {"--shape": given.shape, "--dtype": given.dtype}
    if all(v is None for v in (given.shape, given.dtype, given.byte_order, given.header_bytes)):
        return None
    missing = [name for name, value in told.items() if value is None]
    if missing:
        raise StapeskitError(
            Fault(
                missing[0],
                "given with the other options of raw voxels",
                "none",
                next_step="Give --shape NX,NY,NZ and --dtype, or none of these options",
            )
        )
    from ct_inertia.readers.raw_layout import RawLayout

    return RawLayout(given.shape, given.dtype, given.byte_order or "little", given.header_bytes or 0)


def _added_mass(text: str) -> tuple[float, float, float, float, float]:
    place, _, last = text.rpartition(",")
    x, y, z = numbers(3, "--add-mass before the mass")(place)
    value, sd = value_with_sd(last)
    return x, y, z, value, sd or 0.0


def options_from(given: argparse.Namespace) -> MassOptions:
    """Turn parsed options into the library's.

    Raises
    ------
    StapeskitError
        They contradict each other or one is missing.
    """
    import numpy as np

    from ct_inertia.ct2mass import MassOptions
    from ct_inertia.mass.mass_properties import PointMass

    percent = given.voxel_size_sd
    if percent is not None and not 0.0 <= percent < 50.0:
        raise StapeskitError(
            Fault(
                "--voxel-size-sd",
                "a percentage from 0 to 50",
                percent,
                next_step="Give it in percent, for example 0.2",
            )
        )
    if given.box is not None and any(
        low >= high for low, high in zip(given.box[:3], given.box[3:], strict=True)
    ):
        raise StapeskitError(
            Fault(
                "--box",
                "X0,Y0,Z0,X1,Y1,Z1 with X0 < X1, Y0 < Y1, Z0 < Z1",
                given.box,
                next_step="Give the lower corner first, then the upper one",
            )
        )
    return MassOptions(
        scan=given.scan,
        density=given.density,
        mass_mg=given.mass_mg,
        calibration=given.calibration,
        spacing_mm=given.spacing,
        raw=_raw_layout(given),
        labels=given.labels,
        stapes_label=given.stapes_label,
        plate_label=given.plate_label,
        landmarks=given.landmarks,
        plate_fiducials=given.plate_fiducials,
        side=given.side,
        anterior=given.anterior,
        threshold=given.threshold,
        seed_mm=given.seed,
        box_mm=given.box,
        mirror=given.mirror,
        nan_as_air=given.nan_as_air,
        added=tuple(
            PointMass(np.array(entry[:3]), entry[3] * 1e-6, entry[4] * 1e-6) for entry in given.add_mass or ()
        ),
        voxel_size_sd=None if percent is None else percent / 100.0,
    )


def output_folder(given: argparse.Namespace) -> Path:
    """Return ``--out``, or ``<scan name>_mass`` in the current folder."""
    if given.out is not None:
        return Path(given.out)
    name = Path(given.scan if given.scan is not None else given.labels).resolve().name
    for ending in _ENDINGS:
        if name.lower().endswith(ending):
            return Path(f"{name[: -len(ending)]}_mass")
    return Path(f"{Path(name).stem}_mass")


def work(arguments: list[str]) -> tuple[argparse.Namespace, Outcome]:
    """Parse, compute, write, and return the outcome."""
    given = parser().parse(arguments)
    options = options_from(given)
    if given.smooth is not None or given.faces is not None:
        from ct_inertia.surface.display import check_request

        check_request(given.smooth, given.faces)
    from ct_inertia.ct2mass import ct2mass
    from ct_inertia.exports.output_files import output_set
    from ct_inertia.volume.progress import told_on_terminal
    from stapeskit.provenance import Hashes

    outputs = output_set(
        options,
        output_folder(given),
        report=not given.no_report,
        display=given.smooth is not None or given.faces is not None,
        exports=given.export,
        force=given.force,
        config=given.config,
    )
    outputs.check()
    hashes = Hashes(options.inputs.values(), given.sha256)
    with told_on_terminal(not given.quiet and not given.json) as progress:
        result = ct2mass(options, progress)
        progress("writing" if given.no_report else "drawing the report")
        files, content, notices = _write(given, outputs, result, hashes)
    title = f"ct2mass: {options.scan or options.labels}"
    return given, Outcome(title, _rows(result, content), (*result.notices, *notices), files, content)


def _write(
    given: argparse.Namespace, outputs: OutputSet, result: MassResult, hashes: Hashes
) -> tuple[list[Path], dict[str, Any], tuple[Notice, ...]]:
    """Write every output; return their paths, the content of mass.json, and what writing has to tell."""
    from ct_inertia.exports.mass_json import mass_json, names_of, write_outputs
    from ct_inertia.exports.output_files import LABELS, MEASURED_LABELS

    labels = LABELS if LABELS in outputs.names else MEASURED_LABELS
    content = mass_json(result, given.sha256, hashes, not given.no_report, labels)
    shown = None
    if given.smooth is not None or given.faces is not None:
        from ct_inertia.surface.display import display_mesh

        mesh = display_mesh(result.stapes, given.smooth, given.faces)
        content["display_mesh"] = mesh.as_json()
        shown = mesh.surface
    with outputs.staged() as stage:
        names = []
        if shown is not None:
            from ct_inertia.surface.surface import write_surface

            write_surface(stage / "stapes_display.ply", shown)
            names.append("stapes_display.ply")
        if given.export:
            from ct_inertia.exports import export, units_of

            content["exports"] = units_of(given.export)
            names += export(result, stage, given.export, shown)
        report = [] if given.no_report else ["report.html"]
        notices = outputs.kept_notices([*names_of(result, content), *names, *report])
        content["warnings"] += [notice.as_json() for notice in notices]
        if report:
            from ct_inertia.report.sections import write_report

            content = write_report(stage / "report.html", result, content, shown)
        names = [*write_outputs(result, stage, content), *names, *report]
    return [outputs.folder / name for name in names], content, notices


def _rows(result: MassResult, content: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
    import numpy as np

    body, footplate, matrix = result.body, result.footplate, result.matrix
    deviation = matrix.standard_deviation
    pose = np.sqrt(np.diag(footplate.covariance))

    def entry(row: int, column: int, factor: float, unit: str) -> str:
        return f"{matrix.matrix[row, column] * factor:.4f} ± {deviation[row, column] * factor:.4f} {unit}"

    rows: list[tuple[str, str]] = [
        ("volume", f"{body.volume_m3 * 1e9:.4f} mm3 at {body.density_kg_m3:.0f} kg/m3"),
        ("mass", entry(0, 0, 1e6, "mg")),
        ("centre of mass (footplate)", _vector(matrix.parameters[1:4] / matrix.parameters[0] * 1e3, "mm")),
        ("M(alpha, alpha)", entry(3, 3, 1e12, "e-12 kg m2")),
        ("M(gamma, gamma)", entry(5, 5, 1e12, "e-12 kg m2")),
        ("M(y, alpha)", entry(1, 3, 1e12, "e-12 kg m")),
        ("M(y, gamma)", entry(1, 5, 1e12, "e-12 kg m")),
        (
            "footplate",
            f"{footplate.length_mm:.2f} x {footplate.width_mm:.2f} mm; height {footplate.height_mm:.2f} mm",
        ),
        ("footplate centre (scan)", _vector(footplate.scan_from_footplate.translation_mm, "mm")),
        (
            "frame sd",
            f"{1e6 * np.max(pose[:3]):.1f} um, {np.degrees(np.max(pose[3:])):.2f} degrees; "
            f"x by {footplate.anterior_from}",
        ),
    ]
    if result.plate_frame is not None:
        rows.append(("plate frame (scan)", _vector(result.plate_frame.scan_from_plate.translation_mm, "mm")))
    for way in content["mass_alternatives"]:
        worst = max(abs(value) for row in way["matrix_change_percent"] for value in row)
        shift = float(np.linalg.norm(way["center_of_mass_change_m"])) * 1e6
        rows.append(
            (
                f"by {way['by']} instead",
                f"{way['mass_kg'] * 1e6:.4f} mg ({way['mass_change_percent']:+.2f} %) at "
                f"{way['density_kg_m3']:.0f} kg/m3; centre {shift:.1f} um off; M within {worst:.2f} %",
            )
        )
    for step in content.get("display_mesh", {}).get("steps", []):
        shift = float(np.linalg.norm(step["center_of_mass_change_mm"])) * 1e3
        rows.append(
            (
                f"display: {step['step']} {step['asked']}",
                f"{step['faces']} faces; would change the mass by {step['mass_change_percent']:+.3f} %, "
                f"its centre by {shift:.2f} um, M by {step['mass_matrix_change_percent']:.3f} %",
            )
        )
    return rows


def _vector(values: Any, unit: str) -> str:
    return ", ".join(f"{value:.4f}" for value in values) + f" {unit}"


def main() -> NoReturn:
    """Run `ct2mass`."""
    hold_little_memory()
    keep_algebra_to_one_thread()
    take_short_turns()
    run("ct2mass", work)

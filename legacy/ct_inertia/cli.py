"""The command `ct2mass`: a micro-CT scan in, the mass matrix of the stapes out."""

from __future__ import annotations

from legacy.stapeskit.process import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any, NoReturn

    from legacy.ct_inertia.ct2mass import MassMeasurement
    from legacy.ct_inertia.exports.scan_crop import EarlyCrop
    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.option_parser import ParsedOptions, Parser
    from legacy.stapeskit.own_files import OutputSet
    from legacy.stapeskit.provenance import Hashes
    from legacy.stapeskit.warnings import Notice

_DESCRIPTION = """\
Mass matrix of a stapes about the centre of its footplate, from a micro-CT scan.

"""
_SCAN = (
    "SCAN is a volume ({}), or a closed surface mesh (STL, PLY, OBJ, GLB; mm). Coordinates and directions "
    "are x, y, z in scan coordinates, mm."
)

_EPILOG = """\
Exit code 0: done; 2: the input is at fault, with what to do; 1: a bug.

examples:
  ct2mass scan.tif --density 1900+-60 --anterior -0.9,0.1,0 --side left
  ct2mass scan.tif --spacing 0.018 --mass-mg 3.1+-0.05
  ct2mass --labels corrected.seg.nrrd --density 1900
  ct2mass stapes.stl --density 1900
  ct2mass scan.tif --mass-mg 3.1+-0.05 --calibration phantom.toml --density 1900
      (compared; the measured mass leads)
  ct2mass scan.tif --density 1900 --export mjcf,urdf,abaqus,mat --faces 20000

FILE.toml of --calibration holds two or more points, air and a known material,
or the inserts of a hydroxyapatite phantom with the line from mineral to bone
density:
  points = [[2000, 0], [20000, 1900]]                    # grey value, kg/m3
or
  points_mg_ha_cm3 = [[3100, 0], [9800, 400], [16400, 800]]
                                                         # grey value, mg HA/cm3
  kg_m3_at_zero = 1000                   # density of bone without mineral
  kg_m3_per_mg_ha_cm3 = 0.75
and, if known, sd_kg_m3 = 30, the standard deviation of a density read off the
line."""


def parser() -> Parser:
    """Return the parser of the command."""
    from textwrap import fill

    from legacy.ct_inertia.options import MassOptions, MassOutputs
    from legacy.ct_inertia.readers.formats import FORMATS
    from legacy.stapeskit.option_parser import Parser

    scan = fill(_SCAN.format(", ".join(entry.title for entry in FORMATS)), 80)
    return Parser("ct2mass", _DESCRIPTION + scan, _EPILOG, MassOptions, MassOutputs)


def output_folder(given: ParsedOptions) -> Path:
    """Return ``--out``, or ``<scan name>_mass`` in the current folder."""
    from pathlib import Path

    from legacy.ct_inertia.readers.formats import stem_of

    if given.out is not None:
        return Path(given.out)
    name = Path(given.scan if given.scan is not None else given.labels).resolve().name
    return Path(f"{stem_of(name)}_mass")


def work(arguments: list[str]) -> tuple[ParsedOptions, Outcome]:
    """Parse, compute, write, and return the outcome."""
    from legacy.ct_inertia.options import MassOptions

    given = parser().parse(arguments)
    options = given.make(MassOptions)
    if given.smooth is not None or given.faces is not None:
        from legacy.ct_inertia.surface.display_surface import check_request

        check_request(given.smooth, given.faces)
    from legacy.stapeskit.provenance import Hashes

    hashes = Hashes(options.inputs.values(), given.sha256)  # the files are read while modules are imported
    from legacy.ct_inertia.ct2mass import ct2mass
    from legacy.ct_inertia.exports.output_files import SCAN_CROP, output_set
    from legacy.ct_inertia.exports.scan_crop import EarlyCrop
    from legacy.ct_inertia.report.summary import summary_rows
    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.progress import stage_on_terminal

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
    with stage_on_terminal(not given.quiet and not given.json) as progress, outputs.staged() as stage:
        crop = EarlyCrop(options, stage / SCAN_CROP, outputs.hash_of)
        result = ct2mass(options, progress, crop.begin)
        progress("writing" if given.no_report else "drawing the report")
        names, content, notices = _write(given, outputs, stage, result, hashes, crop)
    files = [outputs.folder / name for name in names]
    title = f"ct2mass: {options.scan or options.labels}"
    return given, Outcome(title, summary_rows(result, content), (*result.notices, *notices), files, content)


def _write(
    given: ParsedOptions,
    outputs: OutputSet,
    stage: Path,
    result: MassMeasurement,
    hashes: Hashes,
    crop: EarlyCrop,
) -> tuple[list[str], dict[str, Any], tuple[Notice, ...]]:
    """Write every output; return their names, the content of mass.json, and the warnings of writing."""
    from legacy.ct_inertia.exports.output_files import LABELS, MEASURED_LABELS
    from legacy.ct_inertia.exports.write_result import write_result

    return write_result(
        result,
        outputs,
        stage,
        labels_file=LABELS if LABELS in outputs.names else MEASURED_LABELS,
        report=not given.no_report,
        display=(given.smooth, given.faces),
        export=given.export,
        hashes=hashes,
        sha256=given.sha256,
        crop=crop,
    )


def _start(arguments: list[str]) -> tuple[ParsedOptions, Outcome]:
    """Choose how the process takes memory and turns, then run the command."""
    from legacy.stapeskit.background import take_short_turns
    from legacy.stapeskit.memory import hold_little_memory

    hold_little_memory()
    take_short_turns()
    return work(arguments)


def main() -> NoReturn:
    """Run `ct2mass`."""
    run("ct2mass", _start)


if __name__ == "__main__":
    main()

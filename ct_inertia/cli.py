"""The command ``ct2mass``: a micro-CT scan in, the mass matrix of the stapes out."""

from __future__ import annotations

from stapeskit.command import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from pathlib import Path
    from typing import NoReturn

    from ct_inertia.options import MassOptions
    from stapeskit.command import Outcome

_TEXT = """\
Mass matrix of a stapes about the centre of its footplate, from a micro-CT scan.

SCAN is a volume, a folder of slices or a closed surface mesh (STL, PLY, OBJ, GLB;
mm). Coordinates and directions are x, y, z in scan coordinates, mm. Without
density, mass and calibration a density of 1900+-200 kg/m3 is assumed."""

_EPILOG = """\
Exit code 0: done; 2: the input is at fault, with what to do; 1: a bug.

examples:
  ct2mass scan.tif --density 1900+-60 --anterior -0.9,0.1,0 --side left
  ct2mass scan.tif --spacing 0.018 --mass-mg 3.1+-0.05
  ct2mass --labels corrected.seg.nrrd --density 1900
  ct2mass stapes.stl --density 1900
  ct2mass scan.tif --mass-mg 3.1+-0.05 --calibration phantom.toml --density 1900
      (compared; the measured mass leads)

FILE of --calibration holds two or more points, air and a known material, or the
inserts of a hydroxyapatite phantom with the line from mineral to bone density:
  points = [[2000, 0], [20000, 1900]]                    # grey value, kg/m3
or
  points_mg_ha_cm3 = [[3100, 0], [9800, 400], [16400, 800]]
                                                         # grey value, mg HA/cm3
  kg_m3_at_zero = 1000                   # density of bone without mineral
  kg_m3_per_mg_ha_cm3 = 0.75
and, if known, sd_kg_m3 = 30, the standard deviation of a density read off the
line."""


def work(words: list[str]) -> Outcome:
    """Parse, compute, write, and return the outcome."""
    from pathlib import Path

    from ct_inertia.options import MassOptions, MassOutputs
    from stapeskit.command_line import parse

    options, given = parse("ct2mass", _TEXT, (MassOptions, MassOutputs), words, _EPILOG)
    from ct_inertia.ct2mass import measure_mass
    from ct_inertia.exports.write import outputs_of
    from stapeskit.command import Outcome, progress_line

    folder = Path(given.out) if given.out is not None else _usual_folder(options)
    report = not given.no_report
    outputs, labels_name = outputs_of(options, folder, report=report, exports=given.export, force=given.force)
    outputs.check()
    with progress_line(not given.quiet and not given.as_json) as progress, outputs.staged() as stage:
        result = measure_mass(options, progress)
        progress("drawing the report" if report else "writing")
        names = result.write_into(stage, report=report, labels_name=labels_name, exports=given.export)
    return Outcome(
        f"ct2mass: {options.source}",
        result.summary(),
        result.notices,
        [folder / name for name in names],
        result.content(),
        json=given.as_json,
        quiet=given.quiet,
    )


def _usual_folder(options: MassOptions) -> Path:
    """Return ``<scan name>_mass`` in the current folder."""
    from pathlib import Path

    from ct_inertia.scan.formats import stem_of

    return Path(f"{stem_of(options.source.resolve().name)}_mass")


def main() -> NoReturn:
    """Run ``ct2mass``."""
    run("ct2mass", work)


if __name__ == "__main__":
    main()

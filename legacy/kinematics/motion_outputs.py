"""The files that a motion is written into, and the check that none of them is an input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from legacy.stapeskit.provenance import content_hash

if TYPE_CHECKING:
    from legacy.kinematics.points2dof import Points2Dof
    from legacy.kinematics.report.stapes_surface import Scenery
    from legacy.stapeskit.own_files import OutputSet

DATA_ENDINGS = (".csv", ".h5", ".channels.csv")
REPORT_ENDING = ".html"
_NEXT_TO_MASS = ("stapes.ply", "plate.ply", "labels.nrrd", "labels.measured.nrrd")


def output_set(
    out: Path, inputs: Sequence[Path | None], mass_file: Path | None = None, force: bool = False
) -> OutputSet:
    """Return the files that are written for ``out``, X.csv, and those that are read.

    Parameters
    ----------
    mass_file : Path, optional
        The surfaces and labels next to it are inputs, too.
    force : bool
        Replace files that are not known as written by the command.
    """
    from legacy.stapeskit.own_files import OutputSet

    scan = [] if mass_file is None else [mass_file.parent / name for name in _NEXT_TO_MASS]
    read = tuple(path for path in (*inputs, mass_file, *scan) if path is not None)
    names = tuple(f"{out.stem}{end}" for end in (*DATA_ENDINGS, REPORT_ENDING))
    return OutputSet("points2dof", out.parent, names, read, force)


def write_outputs(
    folder: Path,
    stem: str,
    result: Points2Dof,
    scenery: Scenery | None = None,
    report: bool = True,
    hash_of: Callable[[Path], str] = content_hash,
) -> list[str]:
    """Write motion, channels and, unless ``report`` is off, the page into a folder; return their names.

    Parameters
    ----------
    scenery : Scenery, optional
        The stapes to draw behind the points.
    hash_of : callable
        Returns the content hash of a file.
    """
    from legacy.kinematics.faults.verdicts import left_out_verdicts, write_channels
    from legacy.kinematics.report.sections import write_report
    from legacy.stapeskit.records.motion_files import write_motion

    folder = Path(folder)
    write_motion(folder, stem, result.motion, hash_of)
    channels = (*result.channels, *left_out_verdicts(result.motion.runs, result.measurement.left_out))
    write_channels(folder / f"{stem}.channels.csv", channels)
    if report:
        write_report(folder / f"{stem}{REPORT_ENDING}", result, scenery)
    return [f"{stem}{end}" for end in (*DATA_ENDINGS, *([REPORT_ENDING] if report else []))]

"""The sample study: where its files are, and copying them into a folder of the user."""

from __future__ import annotations

import shutil
from pathlib import Path

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.own_files import OutputSet

_EXPORTS = ("points.csv", "scan.uff", "fastscan.txt", "scan.mat", "wide.csv")
FILES = (
    *("study.toml", "scan.tif", "ldv.csv", "points.csv", "fiducials.csv", "truth.json", "ATTRIBUTION.md"),
    *(f"exports/{name}" for name in _EXPORTS),
)


def sample_folder() -> Path:
    """Return the folder of the sample study: in the installed package, or in the source tree.

    Raises
    ------
    StapeskitError
        The installation has no sample study.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "sample_study", here.parents[1] / "sample_volumes"):
        if all((folder / name).is_file() for name in FILES):
            return folder
    raise StapeskitError.of(
        "the sample study", "part of this installation", "none", "", "Install stapeskit again"
    )


def copy_sample(target: Path, *, force: bool = False) -> tuple[Path, ...]:
    """Copy the sample study into a folder and return the paths of its files.

    Parameters
    ----------
    target : Path
        Made when missing.
    force : bool
        Replace files of the same names that this function did not write.

    Raises
    ------
    StapeskitError
        A file of another origin, or an edited one, has the name of a file of the sample.
    """
    source = sample_folder()
    outputs = OutputSet("stapeskit", target, FILES, tuple(source / name for name in FILES), force)
    outputs.check()
    with outputs.staged() as stage:
        (stage / "exports").mkdir()
        for name in FILES:
            shutil.copyfile(source / name, stage / name)
    return tuple(outputs.folder / name for name in FILES)

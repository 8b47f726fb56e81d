"""Copy the sample study: a whole simulated ear, from its scan to its truth."""

from __future__ import annotations

from pathlib import Path

from stapeskit.faults import StapeskitError
from stapeskit.outputs import Outputs

FILES = (
    *("study.toml", "scan.tif", "ldv.csv", "points.csv", "fiducials.csv", "truth.json", "ATTRIBUTION.md"),
    *(f"exports/{name}" for name in ("points.csv", "scan.uff", "fastscan.txt", "scan.mat", "wide.csv")),
)


def sample_folder() -> Path:
    """Return the folder of the sample study: in the installed package, or in the source tree.

    Raises
    ------
    StapeskitError
        The installation has no sample study.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "sample_study", here.parent / "sample_volumes"):
        if all((folder / name).is_file() for name in FILES):
            return folder
    step = "Install stapeskit again"
    raise StapeskitError.of("the sample study", "part of this installation", "none", "", step)


def copy_sample(target: Path, *, force: bool = False) -> tuple[Path, ...]:
    """Copy the sample study into a folder and return the paths of its files.

    Raises
    ------
    StapeskitError
        A file of another origin has the name of one of its files, unless ``force``.
    """
    import shutil

    source = sample_folder()
    outputs = Outputs("stapeskit sample", Path(target), FILES, [source / name for name in FILES], force)
    with outputs.staged() as stage:
        for name in FILES:
            (stage / name).parent.mkdir(exist_ok=True)
            shutil.copyfile(source / name, stage / name)
    return tuple(outputs.folder / name for name in FILES)

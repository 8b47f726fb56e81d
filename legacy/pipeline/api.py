"""`stapeskit.scan2kd`: the command scan2kd for one study as a function."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legacy.pipeline.results import StudyResult


def scan2kd(
    study: str | os.PathLike[str], *, out: str | os.PathLike[str] | None = None, force: bool = False
) -> StudyResult:
    """Run a study: scan to mass, points to motion, motion to stiffness and damping, and the report.

    Parameters
    ----------
    study : path
        The study file.
    out : path, optional
        Folder of the results; default ``<study name>_out`` in the current folder.
    force : bool
        Compute every stage anew, and replace files at the names of outputs that are not known as written by
        scan2kd.

    Raises
    ------
    StapeskitError
        What is wrong with the study file or the files that it names; the output folder is then unchanged.

    Examples
    --------
    >>> result = scan2kd("study.toml")  # doctest: +SKIP
    """
    from legacy.pipeline.scan2kd import run_study

    path = Path(study)
    return run_study(path, Path(f"{path.stem}_out") if out is None else Path(out), force)

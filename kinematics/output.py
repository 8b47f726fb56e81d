"""Outputs that appear whole or not at all: written beside their place, then moved into it in one go."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from kinematics.errors import StapeskitError, sentence


@contextmanager
def staged(folder: Path, of_ours: Collection[str] = ()) -> Iterator[Path]:
    """Lend an empty folder whose files replace those of the same name in ``folder`` when the block ends well.

    When the block fails or is interrupted, nothing of it remains and the old files stand untouched.

    Parameters
    ----------
    folder : Path
        Where the outputs shall appear; made when missing.
    of_ours : collection of str, optional
        Names that belong to the same set of outputs: files of these names that are not written this time
        are of an earlier input, and are removed.

    Yields
    ------
    Path
        The folder to write into; it lies on the same file system.

    Raises
    ------
    StapeskitError
        ``folder`` is a file, or cannot be written.
    """
    folder = Path(folder).absolute()
    parent = _existing_folder(folder)
    try:
        stage = Path(tempfile.mkdtemp(prefix=".stapeskit-", dir=parent))
    except OSError as fault:
        raise StapeskitError(
            sentence("the output folder", "writable", parent, next_step="Choose another place with --out")
        ) from fault
    try:
        yield stage
        folder.mkdir(parents=True, exist_ok=True)
        for name in of_ours:
            if not (stage / name).exists():
                (folder / name).unlink(missing_ok=True)
        for path in sorted(stage.rglob("*")):
            target = folder / path.relative_to(stage)
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                os.replace(path, target)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _existing_folder(folder: Path) -> Path:
    """Return the nearest folder above (or at) ``folder`` that exists."""
    for candidate in (folder, *folder.parents):
        if candidate.is_dir():
            return candidate
        if candidate.exists():
            raise StapeskitError(
                sentence(
                    "the output folder",
                    "a folder",
                    f"the file {candidate}",
                    next_step="Choose another place with --out",
                )
            )
    return Path.cwd()

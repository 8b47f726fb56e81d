"""Outputs that appear whole or not at all: written beside their place, then moved into it in one go."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from stapeskit.faults import Fault, StapeskitError, raise_all

_FULL = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def staged(folder: Path, settle: Callable[[Path], Callable[[], None]] | None = None) -> Iterator[Path]:
    """Lend an empty folder whose files replace those of the same name in ``folder`` when the block ends well.

    When the block fails or is interrupted, nothing of it remains and the old files stand untouched. What
    stands at an output's name is replaced whoever made it: commands write by `own_files.OutputSet`.

    Parameters
    ----------
    folder : Path
        Where the outputs shall appear; made when missing.
    settle : callable, optional
        Gets the lent folder before its files are moved, and may refuse; what it returns is called when they
        have been moved.

    Yields
    ------
    Path
        The folder to write into; it lies on the same file system.

    Raises
    ------
    StapeskitError
        ``folder`` is a file, or cannot be written; its disk is full; or a folder stands where a file shall
        appear, or a file where a folder shall.
    """
    folder = Path(folder).absolute()
    parent = existing_folder(folder)
    try:
        stage = Path(tempfile.mkdtemp(prefix=".stapeskit-", dir=parent))
    except OSError as fault:
        raise StapeskitError(
            Fault("the output folder", "writable", parent, next_step="Choose another place with --out")
        ) from fault
    try:
        yield stage
        raise_all(StapeskitError, _in_the_way(stage, folder))
        made = sorted(stage.rglob("*"))
        finish = None if settle is None else settle(stage)
        folder.mkdir(parents=True, exist_ok=True)
        for path in made:
            target = folder / path.relative_to(stage)
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                os.replace(path, target)
        if finish is not None:
            finish()
    except (OSError, RuntimeError) as fault:
        if not _disk_full(fault):
            raise
        raise StapeskitError(
            Fault(
                "the output folder",
                "on a disk with room for the outputs",
                "no space left",
                str(folder),
                "Make room there, or choose another place with --out",
            )
        ) from fault
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _disk_full(fault: BaseException | None) -> bool:
    """Tell whether a fault, or one behind it, is a full disk; HDF5 tells it in its text only."""
    while fault is not None:
        number = getattr(fault, "errno", None)
        if number in _FULL or any(f"errno = {code}," in str(fault) for code in _FULL):
            return True
        fault = fault.__cause__ or fault.__context__
    return False


def _in_the_way(stage: Path, folder: Path) -> list[Fault]:
    """Return a sentence on every folder that stands where a file shall appear, and the reverse."""
    faults = []
    for path in sorted(stage.rglob("*")):
        target = folder / path.relative_to(stage)
        if path.is_dir() and target.is_file():
            faults.append(Fault(f"the output {target}", "a folder", "a file", "", "Move it away"))
        elif path.is_file() and target.is_dir():
            faults.append(Fault(f"the output {target}", "a file", "a folder", "", "Move it away"))
    return faults


def existing_folder(folder: Path) -> Path:
    """Return the nearest folder above (or at) ``folder`` that exists.

    Raises
    ------
    StapeskitError
        It, or one above it, is a file.
    """
    folder = Path(folder).absolute()
    for candidate in (folder, *folder.parents):
        if candidate.is_dir():
            return candidate
        if candidate.exists():
            raise StapeskitError(
                Fault(
                    "the output folder",
                    "a folder",
                    f"the file {candidate}",
                    next_step="Choose another place with --out",
                )
            )
    return Path.cwd()

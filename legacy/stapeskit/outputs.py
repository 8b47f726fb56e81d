"""Outputs that appear whole or not at all: written to a temporary folder, then moved into place at once.

A folder that does not exist yet appears by one rename. In a folder that exists, files are replaced one by one
while interruptions wait and other runs are locked out; for a process that is killed just then see
`own_files.check_whole`.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from legacy.stapeskit.faults import Fault, StapeskitError, raise_all
from legacy.stapeskit.process import defer_interrupts, outputs_written
from legacy.stapeskit.system_faults import is_full
from legacy.stapeskit.temporary_folders import remove_abandoned, scratch

Settle = Callable[[Path], Callable[[], None] | None]
_ELSEWHERE = "Choose another place with --out"


@contextmanager
def stage_outputs(folder: Path, settle: Settle | None = None) -> Iterator[Path]:
    """Lend an empty folder whose files replace those of the same name in ``folder`` when the block ends well.

    When the block fails or is interrupted, nothing of it remains and the old files are untouched. A file at
    an output's name is replaced whoever made it: commands write by `own_files.OutputSet`.

    Parameters
    ----------
    folder : Path
        Where the outputs shall appear; made when missing.
    settle : callable, optional
        Gets the lent folder before its files are moved, and may refuse; what it returns is called when they
        have been moved. It is called again where ``folder`` appears meanwhile.

    Yields
    ------
    Path
        The folder to write into; it lies on the same file system.

    Raises
    ------
    StapeskitError
        ``folder`` is a file, or cannot be written; its disk is full; or a folder is where a file shall
        appear, or a file where a folder shall.
    """
    folder = Path(folder).absolute()
    parent = existing_folder(folder)
    remove_abandoned(folder.parent)  # where a run that made the folder had its own
    entered = False
    try:
        with scratch(parent) as stage:
            entered = True
            yield stage
            raise_all(StapeskitError, _in_the_way(stage, folder))
            _store(stage)
            with defer_interrupts(), _lock_folder(folder):
                _place(stage, folder, settle)
                outputs_written()
    except (OSError, RuntimeError) as fault:
        if is_full(fault):
            raise StapeskitError(_full_disk(fault, folder)) from fault
        if entered or not isinstance(fault, OSError):
            raise
        refused = Fault("the output folder", "writable", fault.strerror, str(parent), _ELSEWHERE)
        raise StapeskitError(refused) from fault


def _full_disk(fault: BaseException, folder: Path) -> Fault:
    if getattr(fault, "errno", None) == errno.EFBIG:
        expected, step = "allowed to hold files of this size", "Raise the limit (ulimit -f)"
        return Fault("the output folder", expected, "a limit that is lower", str(folder), step)
    expected, step = (
        "on a disk with room for the outputs",
        "Make room there, or choose another place with --out",
    )
    return Fault("the output folder", expected, "no space left", str(folder), step)


def _store(stage: Path) -> None:
    """Have the files on the disk before they get their names: after a power cut no name leads to nothing."""
    for path in sorted(stage.rglob("*")):
        if path.is_file():
            with path.open("r+b") as stream:
                os.fsync(stream.fileno())


@contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Keep other runs from placing files in a folder meanwhile, where the system has locks."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    while True:
        place = existing_folder(folder)
        descriptor = os.open(place, os.O_RDONLY)
        try:
            with suppress(OSError):  # some network file systems have no locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if existing_folder(folder) == place:
                yield
                return
        finally:
            os.close(descriptor)


def _place(stage: Path, folder: Path, settle: Settle | None) -> None:
    """Move the files of a folder into another one, by one rename where that is possible."""
    finish = None if settle is None else settle(stage)
    if not os.path.lexists(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.rename(stage, folder)
        except OSError:
            if not os.path.lexists(folder):
                raise
            finish = None if settle is None else settle(stage)
        else:
            _store_names(folder.parent)
            return
    for path in sorted(stage.rglob("*")):
        target = folder / path.relative_to(stage)
        if path.is_dir():
            target.mkdir(exist_ok=True)
        else:
            os.replace(path, target)
    _store_names(folder)
    if finish is not None:
        finish()


def _store_names(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    with suppress(OSError):  # Windows opens no folders
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _in_the_way(stage: Path, folder: Path) -> list[Fault]:
    """Return a fault for every folder that is where a file shall appear, and the reverse."""
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
        It, or one above it, is a file, a link that leads nowhere, or of a name that no folder can have.
    """
    folder = Path(folder).absolute()
    for candidate in (folder, *folder.parents):
        try:
            if candidate.is_dir():
                return candidate
            link = candidate.is_symlink()
            exists = link or candidate.exists()
        except (OSError, ValueError) as fault:
            got = getattr(fault, "strerror", None) or str(fault)
            raise StapeskitError.of("the output folder", "a folder", got, "", _ELSEWHERE) from fault
        if exists:
            got = f"the {'link that leads to no folder' if link else 'file'} {candidate}"
            raise StapeskitError.of("the output folder", "a folder", got, next_step=_ELSEWHERE)
    return Path.cwd()

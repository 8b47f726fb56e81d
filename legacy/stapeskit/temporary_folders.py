"""Temporary folders; those of killed runs are removed by the next run."""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from legacy.stapeskit.process import on_forced_end

PREFIX = ".stapeskit-"
_OURS = re.compile(r"\.stapeskit-[a-z0-9_]{8}")
_MARK, _FILES = "stapeskit-temporary", "files"
_FRESH_S = 60.0  # a folder is not yet locked for a moment after it is made
_OLD_S = 7 * 86400.0  # where folders cannot be locked: longer than any run takes
_open: set[Path] = set()


@contextmanager
def scratch(parent: Path | None = None) -> Iterator[Path]:
    """Lend an empty folder that is removed when the block ends.

    The folder is locked while it is in use. Folders that killed runs left in the same place are removed
    first: those of this name, mark and owner whose lock is free.

    Parameters
    ----------
    parent : Path, optional
        Where it is made; the system's folder for temporary files by default.

    Raises
    ------
    OSError
        It cannot be made.
    """
    place = Path(tempfile.gettempdir()) if parent is None else Path(parent)
    remove_abandoned(place)
    top = Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
    _open.add(top)
    lock = None
    try:
        with suppress(OSError):
            lock = _lock(top)
        (top / _MARK).touch()
        inside = top / _FILES
        inside.mkdir()  # with the permissions that the user's other folders have
        yield inside
    finally:
        _remove(top)
        if lock is not None:
            os.close(lock)


def remove_abandoned(place: Path) -> None:
    """Remove temporary folders of runs that were killed."""
    with suppress(OSError):
        for path in [entry for entry in place.iterdir() if _OURS.fullmatch(entry.name)]:
            with suppress(OSError):
                if _is_abandoned(path):
                    _remove(path)


def files_within(folder: Path) -> list[Path]:
    """Return the files within a folder in the order of their names, without those of temporary folders."""
    files = [
        path
        for path in Path(folder).rglob("*")
        if path.is_file() and not any(map(_OURS.fullmatch, path.relative_to(folder).parts))
    ]
    return sorted(files)


def _is_abandoned(path: Path) -> bool:
    state = path.lstat()
    age_s = time.time() - state.st_mtime
    own = not hasattr(os, "getuid") or state.st_uid == os.getuid()
    if path in _open or path.is_symlink() or not path.is_dir() or not own or age_s < _FRESH_S:
        return False
    if not (path / _MARK).exists() and (any(path.iterdir()) or not _is_private(state.st_mode)):
        return False
    lock = _lock(path)
    if lock is None:
        return age_s > _OLD_S
    os.close(lock)
    return True


def _is_private(mode: int) -> bool:
    """Return whether a folder can be as mkdtemp makes it: of nobody else."""
    return os.name == "nt" or stat.S_IMODE(mode) == stat.S_IRWXU


def _lock(folder: Path) -> int | None:
    """Return a descriptor that holds the lock of a folder; None where the system has no such locks.

    Raises
    ------
    OSError
        Another process holds it.
    """
    try:
        import fcntl
    except ImportError:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _remove(top: Path) -> None:
    """Remove a folder, also while a thread still writes into it."""
    for _ in range(5):
        # the mark is removed last: by it the next run knows a folder whose removal was interrupted
        shutil.rmtree(top / _FILES, ignore_errors=True)
        if not (top / _FILES).exists():
            shutil.rmtree(top, ignore_errors=True)
        if not top.exists():
            break
        time.sleep(0.01)
    _open.discard(top)


def _remove_open() -> None:
    for top in list(_open):
        _remove(top)


on_forced_end(_remove_open)

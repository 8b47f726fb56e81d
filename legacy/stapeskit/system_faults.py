"""Faults of the file system, in a sentence: what could not be read or written, and what to do."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from legacy.stapeskit.faults import Fault

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that is full, a quota that is used up, or a limit on the size of files."""

_STEPS = {
    errno.EACCES: "Change its permissions, or choose another place",
    errno.EPERM: "Change its permissions, or choose another place",
    errno.EROFS: "Choose another place: this file system is mounted read-only",
    errno.ENOSPC: "Make room there, or choose another place with --out",
    errno.EDQUOT: "Make room there, or choose another place with --out",
    errno.EFBIG: "Raise the limit on the size of files (ulimit -f)",
    errno.ENAMETOOLONG: "Choose a shorter name",
    errno.ELOOP: "Remove the link that leads back to itself",
    errno.EMFILE: "Raise the limit on open files (ulimit -n)",
    errno.EIO: "Check the disk, or copy the file to another one",
}


def system_fault(fault: OSError) -> Fault:
    """Return what an error of the operating system says, as a fault of the user's files.

    Parameters
    ----------
    fault : OSError
        With its number.
    """
    number = fault.errno or 0
    names = [os.fsdecode(name) for name in (fault.filename, fault.filename2) if isinstance(name, str | bytes)]
    thing = " and ".join(_shorten(name) for name in names) or "a file or device"
    step = _STEPS.get(number, "Check that it exists and may be read and written")
    return Fault(thing, "readable, or writable where it is an output", os.strerror(number), "", step)


def is_full(fault: BaseException | None) -> bool:
    """Return whether a fault, or its cause, is a full disk; HDF5 reports that in its text only."""
    while fault is not None:
        number = getattr(fault, "errno", None)
        if number in FULL or any(f"errno = {code}," in str(fault) for code in FULL):
            return True
        fault = fault.__cause__ or fault.__context__
    return False


def _shorten(name: str) -> str:
    return name if len(name) <= 200 else f"{name[:90]} ... {name[-90:]}"


MISSING = "missing"


def why_unreadable(path: Path) -> str:
    """Return why a file or folder cannot be read, or nothing; a pipe or device counts as `MISSING`."""
    try:
        if path.is_dir():
            os.scandir(path).close()
        elif path.is_file():
            # without opening it: files are opened once a run, by what reads them
            return "" if os.access(path, os.R_OK) else os.strerror(errno.EACCES)
        else:
            path.stat()
            return MISSING  # a pipe or a device would be waited for without end
    except (FileNotFoundError, NotADirectoryError):
        return MISSING
    except (OSError, ValueError) as fault:
        return getattr(fault, "strerror", None) or str(fault)
    return ""

"""Damaged HDF5 files can hold up or crash the library that reads them: try in a process of its own first."""

from __future__ import annotations

import os
import signal
import time
import warnings
from pathlib import Path
from typing import Any

from kinematics.errors import KinematicsError
from stapeskit.faults import Fault

_PATIENCE_S = 8.0
_SMALL = 4 << 20
_STEP = "It is damaged: copy or export it again"


def probe(path: Path, wanted: str, patience_s: float = _PATIENCE_S) -> None:
    """Read names, types and attributes, of small files also the data, in a forked process.

    Nothing is tried where processes cannot be forked. What the library says in words is left to the reader.

    Raises
    ------
    KinematicsError
        The reading does not end in time, or crashes.
    """
    if not hasattr(os, "fork"):
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            _walk(path)
        finally:
            os._exit(0)
    ended, status = _waited(child, patience_s)
    if not ended:
        got = f"one on which the HDF5 library is stuck after {patience_s:g} s"
        raise KinematicsError(Fault(wanted, "readable", got, Path(path).name, _STEP))
    if os.WIFSIGNALED(status):
        got = "one on which the HDF5 library crashes"
        raise KinematicsError(Fault(wanted, "readable", got, Path(path).name, _STEP))


def _waited(child: int, patience_s: float) -> tuple[bool, int]:
    """Return whether a process ended in time, and its status; end it otherwise."""
    stop, pause = time.monotonic() + patience_s, 0.0005
    try:
        while time.monotonic() < stop:
            found, status = os.waitpid(child, os.WNOHANG)
            if found:
                return True, status
            time.sleep(pause)
            pause = min(2.0 * pause, 0.05)
    except BaseException:
        _end(child)
        raise
    _end(child)
    return False, 0


def _end(child: int) -> None:
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def _walk(path: Path) -> None:
    """Touch all that a reader may touch."""
    import h5py

    small = Path(path).stat().st_size <= _SMALL

    def touch(_name: Any, node: Any) -> None:
        for name in node.attrs:
            node.attrs[name]
        if isinstance(node, h5py.Dataset):
            stored = node.id.get_storage_size()
            if small and node.size is not None and node.size * node.dtype.itemsize <= _SMALL + 100 * stored:
                node[()]

    with h5py.File(path, "r") as file:
        touch("", file)
        file.visititems(touch)

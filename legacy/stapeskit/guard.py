"""Damaged files can hold up or crash the libraries of HDF5 and DICOM: a child process reads them."""

from __future__ import annotations

import faulthandler
import os
import pickle
import select
import signal
import struct
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TypeVar

import numpy as np

from legacy.stapeskit.faults import Fault, StapeskitError

Result = TypeVar("Result")
# A sound file takes milliseconds; one of 10^5 groups has some 50 MB and takes 5 s.
_PROCESSOR_S, _PROCESSOR_S_PER_MB = 3.0, 0.2
# Seconds on the clock for a second of processor time: a busy machine gives a process little of it.
_CLOCK = 15.0
# Address space: what the library takes, and so many times the size of the file (packed numbers).
_MEMORY, _PACKING = 256 << 20, 40
_STEP = "It is damaged: copy or export it again"


@dataclass(frozen=True)
class Library:
    """A library that damaged files may bring down: its name, and its module, loaded before the fork."""

    module: str
    name: str


HDF5 = Library("h5py", "HDF5")


def read_apart(
    read: Callable[[], Result],
    path: Path,
    wanted: str,
    error: type[StapeskitError] = StapeskitError,
    processor_s: float | None = None,
    memory: int | None = None,
    library: Library = HDF5,
) -> Result:
    """Return what ``read`` returns in a forked process with limits on processor time and memory.

    Where processes cannot be forked (Windows, a browser), ``read`` is called directly and nothing is limited.

    Parameters
    ----------
    read : callable
        Reads the file. Its result must be plain data: arrays, texts, data classes.
    wanted : str
        What the file is, for the message.
    error : type of StapeskitError
        The class of the error.
    processor_s : float, optional
        Limit on the processor time; by default 3 s and 0.2 s for each MB of the file.
    memory : int, optional
        Limit on the memory that is taken for it, bytes; by default 256 MB and 40 times the size of the file.
    library : Library
        What reads.

    Raises
    ------
    StapeskitError
        The reading does not end in time or crashes; also every error that ``read`` raises.
    """
    if not hasattr(os, "fork") or sys.platform == "emscripten":
        return read()
    import_module(library.module)  # once, not in every child
    size = Path(path).stat().st_size
    limit_s = processor_s or _PROCESSOR_S + _PROCESSOR_S_PER_MB * size / 1e6
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        os.close(reader)
        _work(read, writer, limit_s, _PACKING * size + _MEMORY if memory is None else memory)
    os.close(writer)
    try:
        answer = _receive(reader, _CLOCK * limit_s)
    finally:
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    if answer is None:
        late = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGKILL, signal.SIGXCPU)
        got = f"stuck after {limit_s:.3g} s" if late else "brought down"
        name = Path(path).name
        raise error(
            Fault(wanted, "readable", f"one by which the {library.name} library is {got}", name, _STEP)
        )
    value, fault = answer
    if fault is not None:
        raise fault
    return value


def _work(read: Callable[[], Any], writer: int, limit_s: float, memory: int) -> NoReturn:
    """Read and send the result, in the child; nothing of the caller runs in it."""
    code = 1
    try:
        faulthandler.disable()
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the C library's last words
        _limit(limit_s, memory)
        try:
            answer: tuple[Any, BaseException | None] = read(), None
        except StapeskitError as fault:
            answer = None, fault
        except Exception as fault:
            fault.add_note(traceback.format_exc())
            answer = None, fault
        with os.fdopen(writer, "wb", closefd=False) as stream:
            _send(stream, answer)
        code = 0
    finally:
        os._exit(code)


def _limit(processor_s: float, memory: int) -> None:
    """Limit the processor time and the further address space of this process."""
    import resource

    seconds = max(1, round(processor_s))
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError, ValueError):  # where the limits are lower already, or /proc is missing
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (used * os.sysconf("SC_PAGE_SIZE") + memory, most))


def _send(stream: BinaryIO, answer: object) -> None:
    """Write a value with its arrays behind it, uncopied."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(answer, protocol=5, buffer_callback=buffers.append)
    parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
    stream.write(struct.pack(f"<{len(parts) + 1}Q", len(parts), *(part.nbytes for part in parts)))
    for part in parts:
        stream.write(part)


def _receive(reader: int, patience_s: float) -> tuple[Any, BaseException | None] | None:
    """Return what the child sent; None when it ended without, or sends nothing in that time."""
    with os.fdopen(reader, "rb") as stream:
        ready, _, _ = select.select([reader], [], [], patience_s)
        count = stream.read(8) if ready else b""
        if len(count) < 8:
            return None
        number = struct.unpack("<Q", count)[0]
        sizes = struct.unpack(f"<{number}Q", stream.read(8 * number))
        head, *buffers = [np.empty(size, dtype=np.uint8) for size in sizes]
        for part in (head, *buffers):
            if stream.readinto(part.data) < part.nbytes:
                return None
        return pickle.loads(head.data, buffers=buffers)

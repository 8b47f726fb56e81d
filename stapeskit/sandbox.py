"""Run a library that reads a file in a child process with limits: damaged files crash or hang libraries.

`read_apart` reads a file once. `Session` keeps a source open in its child and answers requests for parts of
it. Where processes cannot be forked (Windows) the process itself reads, without limits.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import signal
import threading
import time
import traceback
import warnings
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from multiprocessing import Pipe
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NoReturn, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

Result = TypeVar("Result")
Opened = TypeVar("Opened")
Answer = Callable[[Any], NDArray[Any]]

CLOCK = 15.0
"""Seconds on the clock for a second of processor time: a busy machine gives a process little of it."""

_LONGEST_TEXT = 200  # letters of a library's own message
_FORK = threading.Lock()  # no child may inherit the half-made pipe of another one


def processor_limit_s(path: Path) -> float:
    """Return the default limit on processor time: a sound file takes milliseconds, 10^5 groups take 5 s."""
    return 3.0 + 0.2e-6 * size_on_disk(path)


def memory_limit(path: Path) -> int:
    """Return the default limit on further memory, bytes: 256 MB for a library, 40 times the packed file."""
    return (256 << 20) + 40 * size_on_disk(path)


def size_on_disk(path: Path) -> int:
    """Return the size of a file, or of all files below a folder, bytes; 0 where there is nothing."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def read_apart(
    read: Callable[[], Result],
    path: Path,
    what: str,
    limit_s: float | None = None,
    memory: int | None = None,
    modules: Sequence[str] = (),
) -> Result:
    """Return what ``read()`` returns in a child process: plain data, arrays, texts, data classes.

    Parameters
    ----------
    path, what
        The file or folder, for limits and message, and what it is: ``an HDF5 file``.
    limit_s, memory
        Limits on processor time, s, and on further memory, bytes; see `processor_limit_s`, `memory_limit`.
    modules : sequence of str
        Libraries that are imported before the fork, once instead of in every child.

    Raises
    ------
    StapeskitError
        The library crashes, hangs, needs too much memory or raises; also every fault that ``read`` raises.
    """
    with Session(lambda: (read(), no_requests), path, what, limit_s, memory, modules) as session:
        return session.opened


def no_requests(_: Any) -> NDArray[Any]:
    """Refuse requests: the answer of a source that was read whole."""
    raise ValueError("this source was read whole and answers no requests")


class Session(Generic[Opened]):
    """A source that is open in a child process and answers requests with arrays, one after the other.

    ``open_source`` runs in the child: it returns a description (plain data), which is ``opened``, and a
    function that takes a request (any picklable value) and returns an array. The other arguments and errors
    are those of `read_apart`; ``limit_s`` holds for opening and for each request.
    """

    opened: Opened

    def __init__(
        self,
        open_source: Callable[[], tuple[Opened, Answer]],
        path: Path,
        what: str,
        limit_s: float | None = None,
        memory: int | None = None,
        modules: Sequence[str] = (),
    ) -> None:
        self._lock = threading.Lock()
        self._name, self._what = path.name, what
        self._limit_s = processor_limit_s(path) if limit_s is None else limit_s
        self._memory = memory_limit(path) if memory is None else memory
        for module in modules:
            import_module(module)
        if not can_fork():
            self.opened, self._answer = _result(self._outcome(open_source))
            return
        with _FORK, warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads
            self._pipe, theirs = Pipe()
            self._child = os.fork()
            if self._child == 0:
                self._pipe.close()
                self._serve(open_source, theirs)
            theirs.close()
        self._end = weakref.finalize(self, _end, self._child, self._pipe)
        try:
            self.opened = self._receive()
        except BaseException:
            self._end()
            raise

    def ask(self, request: Any) -> NDArray[Any]:
        """Return the array that answers a request.

        Raises
        ------
        StapeskitError
            The library crashes, hangs, needs too much memory or raises; the first two end the session.
        """
        with self._lock:
            if not can_fork():
                return _result(self._outcome(lambda: self._answer(request)))
            if not self._end.alive:
                raise self._error("a source whose reading ended before")
            with suppress(OSError):  # of a child that has ended, which the answer tells
                self._pipe.send(request)
            return self._receive()

    def close(self) -> None:
        """End the child process."""
        if can_fork():
            self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self) -> Any:
        """Return the next result of the child; one that crashed or hangs is ended."""
        try:
            if not self._pipe.poll(CLOCK * self._limit_s):
                raise EOFError
            head, sizes = self._pipe.recv()
            buffers = [np.empty(size, dtype=np.uint8) for size in sizes]
            for rest in (buffer.data for buffer in buffers):
                while rest:
                    count = os.readv(self._pipe.fileno(), [rest])
                    if not count:
                        raise EOFError
                    rest = rest[count:]
        except (EOFError, OSError):
            status = self._end() or 0
            late = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGKILL, signal.SIGXCPU)
            hangs = f"one that its library does not finish reading ({self._limit_s:.3g} s)"
            raise self._error(hangs if late else "one that crashes its library") from None
        except BaseException:  # an interrupt: what the child sends later would answer another request
            self._end()
            raise
        return _result(pickle.loads(head, buffers=buffers))

    def _serve(self, open_source: Callable[[], tuple[Opened, Answer]], pipe: Connection) -> NoReturn:
        """In the child process: open the source and answer requests until the parent ends."""
        try:
            _isolate(self._memory)
            _limit_processor(self._limit_s)
            found = self._outcome(open_source)
            opened, answer = (found, no_requests) if isinstance(found, StapeskitError) else found
            _send(pipe, opened)
            while True:
                request = pipe.recv()
                _limit_processor(self._limit_s)
                _send(pipe, self._outcome(partial(answer, request)))
        except EOFError:  # the parent has ended or closed the session
            pass
        finally:
            os._exit(0)

    def _outcome(self, work: Callable[[], Any]) -> Any:
        """Return the result, or the error that the user reads; of another exception with its traceback."""
        try:
            return work()
        except StapeskitError as error:
            return error
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_TEXT]
            if isinstance(error, MemoryError):
                text = f"one that needs more than {self._memory / 1e6:.0f} MB of memory"
            refused = self._error(text)
            refused.add_note(traceback.format_exc())
            return refused

    def _error(self, got: str) -> StapeskitError:
        step = "It is damaged: copy or export it again"
        return StapeskitError.of(self._what, "readable", got, self._name, step)


def _result(outcome: Any) -> Any:
    if isinstance(outcome, StapeskitError):
        raise outcome
    return outcome


def can_fork() -> bool:
    """Return whether a child process can be forked."""
    return hasattr(os, "fork")


def _end(child: int, pipe: Connection) -> int:
    """Kill a child process, close the pipe to it, and return its exit status."""
    status = 0
    with suppress(ProcessLookupError, ChildProcessError):
        ended, status = os.waitpid(child, os.WNOHANG)
        if not ended:
            os.kill(child, signal.SIGKILL)
            status = os.waitpid(child, 0)[1]
    pipe.close()
    return status


def _send(pipe: Connection, outcome: object) -> None:
    """Send an outcome; the bytes of its arrays follow, from their place to that of their copies."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(outcome, protocol=5, buffer_callback=buffers.append)
    pipe.send((head, [buffer.raw().nbytes for buffer in buffers]))
    for rest in (buffer.raw() for buffer in buffers):
        while rest:
            rest = rest[os.write(pipe.fileno(), rest) :]


def _isolate(memory: int) -> None:
    """Limit the further address space of this process; ignore Ctrl-C; drop the messages of C libraries."""
    import resource

    faulthandler.disable()
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError, ValueError):  # where limits are lower already, or /proc is missing
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (used * os.sysconf("SC_PAGE_SIZE") + memory, most))


def _limit_processor(limit_s: float) -> None:
    """Let the system end this process after so much more processor time, s, rounded up."""
    import resource

    with suppress(OSError, ValueError):
        most = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + limit_s) + 1, most))

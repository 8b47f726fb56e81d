"""The process of a command: its exit code, its standard streams, and what Ctrl-C does.

Exit 0 done, 2 the input or the system is at fault, 1 a bug in stapeskit, 130 interrupted. This module imports
little, so that an interruption is handled from the first moments on.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from legacy.stapeskit.terminal import plain

TYPE_CHECKING = False  # typing itself would take longer than the rest
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn

    from legacy.stapeskit.command import Outcome

PATIENCE_S = 0.7
"""How long an interrupted command may take to leave by itself."""

# Objects made before Python looks for garbage again. Imports and figures make some 10^5 that live to the
# end; with Python's own number, 700, the search takes some 5 to 10 % of a command's time.
_GARBAGE_AFTER = 50_000
_STARVED = "not enough memory; crop the scan with --box or close other programs."
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class _State:
    """How this process is to end, shared by its threads."""

    prog = "stapeskit"
    interrupted = False
    written = False
    code: int | None = None
    watched = False
    placing = threading.RLock()
    cleanups: tuple[Callable[[], None], ...] = ()


def run(prog: str, work: Callable[[list[str]], tuple[Any, Outcome] | None]) -> NoReturn:
    """Run a command's work and leave the process with its exit code.

    Parameters
    ----------
    prog : str
        The command's name.
    work : callable
        Takes the arguments, returns the options and the outcome, or None when it has printed already.
    """
    _State.written = False
    if not sys.warnoptions:  # what Python warns of is no warning of ours: those have a code and a sentence
        warnings.simplefilter("ignore")
    try:
        gc.set_threshold(_GARBAGE_AFTER)
        _open_descriptors()
        listen(prog)
        _open_streams()
        code = _end_of(prog, work)
    except KeyboardInterrupt as stop:
        code = 130
        _write_message(f"{prog}: {stop if str(stop) else _farewell()}\n")
    except (MemoryError, SystemError):  # what says so needs memory, too
        code = 2
        _write_message(f"{prog}: {_STARVED}\n")
    _State.code = code
    with suppress(OSError, ImportError, ValueError):
        if "legacy.stapeskit.run_log" in sys.modules:
            sys.modules["legacy.stapeskit.run_log"].end(code)
    raise SystemExit(code)


def listen(prog: str, patience_s: float = PATIENCE_S) -> None:
    """End the process on Ctrl-C, SIGTERM or a closed terminal: by KeyboardInterrupt, else by force.

    The exception that a signal raises reaches nobody while a library computes, and is lost within a callback
    of the import machinery. A thread that the signal wakes therefore looks ``patience_s`` later whether the
    process still runs, removes its temporary folders and ends it with 130.
    """
    _State.prog, _State.interrupted, _State.code = prog, False, None
    sys.unraisablehook = _without_interruptions
    for number in _SIGNALS:
        signal.signal(number, _interrupt)
    if _State.watched:
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    _State.watched = True
    atexit.register(_ignore)
    with suppress(RuntimeError):  # no memory for a thread: the work will find that out, too
        threading.Thread(target=_watch, args=(reader, patience_s), name="interrupts", daemon=True).start()


def is_command() -> bool:
    """Return whether this process runs a command, not a notebook or another program: it called `listen`."""
    return _State.watched


def on_forced_end(cleanup: Callable[[], None]) -> None:
    """Call this before the process is ended by force."""
    _State.cleanups = (*_State.cleanups, cleanup)


def outputs_written() -> None:
    """Remember that outputs have appeared, for what an interruption says."""
    _State.written = True


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer interruptions until the block has ended."""
    caught: list[int] = []
    with _State.placing:
        replaced: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if callable(signal.getsignal(number)):
                    replaced[number] = signal.signal(number, lambda received, _frame: caught.append(received))
        try:
            yield
        finally:
            for number, handler in replaced.items():
                signal.signal(number, handler)
    if caught:
        replaced[caught[0]](caught[0], None)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, once: what cleans up must not be interrupted again."""
    if not _State.interrupted and _State.code is None:
        _State.interrupted = True
        raise KeyboardInterrupt


def _without_interruptions(raised: sys.UnraisableHookArgs) -> None:
    """Be silent on an interruption that a callback of the interpreter lost; ``_watch`` ends the process."""
    if not issubclass(raised.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(raised)


def _ignore() -> None:
    """Let no signal end the process otherwise once its exit code is known."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _watch(reader: int, patience_s: float) -> None:
    while not set(os.read(reader, 64)) & set(_SIGNALS):
        pass
    time.sleep(patience_s)
    with _State.placing:
        for cleanup in _State.cleanups:
            with suppress(Exception):
                cleanup()
        if _State.code is None:
            _write_message(f"{_State.prog}: {_farewell()}\n")
        os._exit(130 if _State.code is None else _State.code)


def _farewell() -> str:
    return (
        "interrupted; the outputs had been written."
        if _State.written
        else "interrupted; nothing was written."
    )


def _end_of(prog: str, work: Callable[[list[str]], tuple[Any, Outcome] | None]) -> int:
    """Return the exit code; what went wrong is on standard error."""
    try:
        _prepare_algebra()
        result = work(sys.argv[1:])
    except BrokenPipeError:
        _drop_output()
        return 0
    except Exception as fault:
        if _State.interrupted:  # libraries turn the interruption within their callbacks into other errors
            raise KeyboardInterrupt from fault
        text = _sentence(fault)
        if text is not None:
            _write_message(f"{text}\n")
            return 2
        import traceback

        _write_message(traceback.format_exc())
        _write_message(f"{prog}: this is a bug in stapeskit; please report it with the lines above.\n")
        return 1
    try:
        if result is not None:
            from legacy.stapeskit.command import show

            show(*result)
        sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
    except OSError as fault:
        _drop_output()
        _write_message(
            f"{prog}: standard output must be writable; got {fault.strerror}. The outputs are written.\n"
        )
        return 2
    return 0


def _prepare_algebra() -> None:
    from legacy.stapeskit.memory import keep_algebra_to_one_thread, take_algebra_buffers

    keep_algebra_to_one_thread()
    take_algebra_buffers()


def _sentence(fault: Exception) -> str | None:
    """Return what to say of a fault of the input or the system; None for a bug."""
    from legacy.stapeskit.faults import StapeskitError

    if isinstance(fault, StapeskitError):
        return str(fault)
    text = str(fault)
    # CPython says no more than the last two where there is no room for the exception itself.
    starved = (
        *("can't start new thread", "failed to map segment", "annot allocate memory", "bad_alloc"),
        *("error return without exception set", "without setting an exception"),
    )
    if isinstance(fault, MemoryError) or any(words in text for words in starved):
        return f"{_State.prog}: {_STARVED}"
    if isinstance(fault, OSError) and fault.errno is not None:
        from legacy.stapeskit.system_faults import system_fault

        return str(system_fault(fault))
    return None


def _open_descriptors() -> None:
    """Open standard streams that the caller has closed, before other files take their numbers."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one


def _open_streams() -> None:
    """Let every standard stream be open, and able to write any character."""
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _drop_output() -> None:
    """Let what is left in the buffer of standard output go nowhere, so that closing it raises nothing."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _write_message(text: str) -> None:
    """Write to standard error, and to the log of the run, where that is possible."""
    text = plain(text)
    with suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(text)
        sys.stderr.flush()
    with suppress(OSError, ValueError):
        if "legacy.stapeskit.run_log" in sys.modules:
            sys.modules["legacy.stapeskit.run_log"].note(text)

"""What every command shares: exit codes, Ctrl-C, progress, and the table or JSON that it prints.

Exit 0 done, 2 the input or the system is at fault, 1 a bug in stapeskit, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

TYPE_CHECKING = False  # typing itself would take longer than the rest of this module
if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any, NoReturn, Protocol

    from stapeskit.warnings import Notice

    class Progress(Protocol):
        """Called with the stage at work and, where it is known, the share of it that is done."""

        def __call__(self, stage: str, share: float | None = None) -> None:
            """Report the stage."""


INTERRUPTED = 130
"""Exit code of a command that was interrupted: that of shells, 128 and the number of SIGINT (POSIX)."""
_CLEAR = "\r\x1b[2K"


@dataclass(frozen=True)
class Outcome:
    """What a command reports: the numbers that a reader looks for first, or with ``json`` its content.

    Warnings go to standard error; ``files`` were written; ``quiet`` prints nothing.
    """

    title: str
    rows: Sequence[tuple[str, str]]
    notices: Sequence[Notice] = ()
    files: Sequence[Path] = ()
    content: dict[str, Any] = field(default_factory=dict)
    json: bool = False
    quiet: bool = False


def run(prog: str, work: Callable[[list[str]], Outcome | None]) -> NoReturn:
    """Run a command's work and leave the process with its exit code.

    The work takes the words of the command line; it returns the outcome, or None when it has printed already.
    """
    import atexit
    import gc
    import signal
    import warnings

    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        # small matrices: threads that wait for each other cost more than they bring
        os.environ.setdefault(name, "1")
    gc.set_threshold(20_000)  # looking for cycles among objects that live on took a tenth of a command
    atexit.register(gc.freeze)  # and at the end, among all of scipy, VTK and matplotlib, another tenth
    if not sys.warnoptions:  # warnings of libraries are no warnings of ours: those have a code and a sentence
        warnings.simplefilter("ignore")
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _interrupt)
    streams = (sys.stdout, sys.stderr)
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    sys.stdout, sys.stderr = (_Printable(stream) for stream in streams)
    code = 0
    try:
        outcome = work(sys.argv[1:])
        if outcome is not None:
            show(outcome)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output has left, as in "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt as interruption:
        code = INTERRUPTED
        sys.stderr.write(f"{prog}: interrupted; {str(interruption) or 'no output was changed'}.\n")
    except Exception as error:
        sentence = fault_sentence(error)
        code = 1 if sentence is None else 2
        if sentence is None:
            import traceback

            traceback.print_exc()
            sentence = f"{prog}: this is a bug in stapeskit; please report it with the lines above."
        sys.stderr.write(f"{sentence}\n")
    finally:
        sys.stdout, sys.stderr = streams
    raise SystemExit(code)


def _interrupt(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


def fault_sentence(error: Exception) -> str | None:
    """Return what to say of a fault of the input or the system; None for a bug."""
    from stapeskit.faults import Fault, StapeskitError

    if isinstance(error, StapeskitError):
        return str(error)
    if isinstance(error, MemoryError):
        step = "Crop the scan with --box, or close other programs"
        return str(Fault("memory", "enough for this input", "too little", "", step))
    if isinstance(error, OSError) and error.errno is not None:
        name = error.filename if isinstance(error.filename, str | bytes) else "a file or device"
        step = "Check permissions and free space, or choose another place with --out"
        expected = "readable, or writable where it is an output"
        return str(Fault(os.fsdecode(name), expected, os.strerror(error.errno), "", step))
    return None


def printable(text: str) -> str:
    """Return a text with ``?`` for characters that could steer a terminal, which file names may hold."""
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "?" for letter in text)


@dataclass
class _Printable:
    """A stream that writes only what `printable` leaves of a text."""

    stream: Any

    def write(self, text: str) -> int:
        return int(self.stream.write(printable(text)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def show(outcome: Outcome) -> None:
    """Print an outcome: JSON, or a table of its rows; notices go to standard error."""
    if not outcome.quiet:
        for notice in outcome.notices:
            sys.stderr.write(f"warning [{notice.code}] {notice.text}\n")
        sys.stderr.flush()
    if outcome.json:
        import json

        sys.stdout.write(json.dumps(outcome.content, indent=1) + "\n")
    elif not outcome.quiet:
        written = [("written", ", ".join(map(str, outcome.files)))] if outcome.files else []
        rows = [*outcome.rows, *written]
        width = max((len(name) for name, _ in rows), default=0)
        lines = [outcome.title, *(f"  {name:<{width}}  {text}" for name, text in rows)]
        sys.stdout.write("\n".join(lines) + "\n")


def no_progress(stage: str, share: float | None = None) -> None:
    """Show nothing."""


@contextmanager
def progress_line(shown: bool = True) -> Iterator[Progress]:
    """Yield a function that shows time, stage, share and time left in one line of standard error.

    Nothing is shown unless ``shown`` and standard error is a terminal; the line is wiped when the block ends.
    """
    if not shown or not sys.stderr.isatty():
        yield no_progress
        return
    import time

    terminal = getattr(sys.stderr, "stream", sys.stderr)
    began = {"": time.monotonic()}

    def report(stage: str, share: float | None = None) -> None:
        now = time.monotonic()
        passed = now - began.setdefault(stage, now)
        more = "" if share is None else f" {100 * share:.0f} %"
        if share is not None and 0.02 < share < 1.0 and passed > 1.0:
            more += f", about {passed * (1.0 - share) / share:.0f} s left"
        terminal.write(f"{_CLEAR}{now - began['']:5.1f} s  {printable(stage)} ...{more}")
        terminal.flush()

    try:
        yield report
    finally:
        terminal.write(_CLEAR)
        terminal.flush()

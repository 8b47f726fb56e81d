"""The log file of a command (``--log FILE``): its command, inputs, messages and end.

Runs are appended. A file that does not begin as a log of this program is never written to.
"""

from __future__ import annotations

import os
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from legacy.stapeskit.faults import StapeskitError

_FIRST = "# log of stapeskit\n"


class _State:
    """The log of this process, when one was asked for."""

    stream: TextIO | None = None
    start = 0.0


def begin(path: Path, prog: str, words: tuple[str, ...]) -> None:
    """Open the log and write what is run.

    Raises
    ------
    StapeskitError
        The file is another one, or cannot be written.
    """
    import platform
    import shlex

    from legacy.stapeskit import __version__

    try:
        if path.exists() and not (path.is_file() and (path.stat().st_size == 0 or _is_log(path))):
            step = "Choose another name"
            raise StapeskitError.of("--log", "a log of stapeskit, or a new file", path, "", step)
        stream = path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as fault:
        step = "Choose another place"
        raise StapeskitError.of(
            "--log", "a file that can be written", fault.strerror, str(path), step
        ) from fault
    if stream.tell() == 0:
        stream.write(_FIRST)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    system = f"stapeskit {__version__}, Python {platform.python_version()}, {platform.platform()}"
    stream.write(f"\n{now} {shlex.join((prog, *words))}\n{system}, in {os.getcwd()}\n")
    stream.flush()
    _State.stream, _State.start = stream, time.perf_counter()


def note(text: str) -> None:
    """Write lines with the seconds since the start; nothing without a log."""
    if _State.stream is None:
        return
    seconds = time.perf_counter() - _State.start
    lines = [f"{seconds:8.1f} s  {line}\n" for line in text.splitlines() if line.strip()]
    _State.stream.writelines(lines)
    _State.stream.flush()


def end(code: int) -> None:
    """Write how the run ended, and close the log."""
    if _State.stream is not None:
        note(f"exit code {code}")
        _State.stream.close()
        _State.stream = None


def _is_log(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(_FIRST)) == _FIRST.encode()

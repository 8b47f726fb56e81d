"""Progress of a cohort over ears and stages: lines for the terminal and for a log file."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from legacy.pipeline.runners.study_process import End
from legacy.stapeskit.own_files import RECORDS
from legacy.stapeskit.process import on_forced_end

LIVE_NAME = "cohort.log"


class CohortLog:
    """Writes each line when it comes, with its time, so that the log survives whatever ends the run.

    The file lies in the program's own folder within the output folder. Where no ear was finished it is
    removed at the end, with folders that it alone has filled.

    Parameters
    ----------
    ears : int
        How many there are.
    tell : callable, optional
        Gets the same lines without their time.
    """

    def __init__(self, out: Path, ears: int, tell: Callable[[str], None] | None = None) -> None:
        self.path = out / RECORDS / LIVE_NAME
        self._ears, self._ended, self._finished = ears, 0, 0
        self._tell = tell or (lambda _line: None)
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.unlink(missing_ok=True)  # it could be a link to a file of the user
        self._stream = self.path.open("w", encoding="utf-8")
        on_forced_end(self._close)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if value is not None:
            self._write(f"{type(value).__name__}: {value}")  # the terminal gets it from the command
        self._close()

    def _close(self) -> None:
        self._stream.close()
        if self._finished:
            return
        with suppress(OSError):
            self.path.unlink(missing_ok=True)
            self.path.parent.rmdir()
            self.path.parent.parent.rmdir()

    def tell(self, name: str, line: str) -> None:
        """Write a line about an ear, or about the run where ``name`` is empty."""
        text = f"{name}: {line}" if name else line
        self._write(text)
        self._tell(text)

    def _write(self, text: str) -> None:
        with self._lock:
            if not self._stream.closed:
                now = datetime.now(UTC).isoformat(timespec="milliseconds")
                self._stream.write(f"{now} {text}\n")
                self._stream.flush()

    def ended(self, name: str, end: End) -> None:
        """Write how an ear ended, and how many have."""
        self._ended += 1
        self._finished += end.code == 0
        reason = " ".join(end.fault.split())
        how = "done" if not end.code else f"failed: {reason}"
        self.tell(name, f"{how} ({self._ended} of {self._ears} ears)")

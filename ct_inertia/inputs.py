"""Input files: hashed on another thread while they are read, and refused when they change meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from stapeskit.faults import StapeskitError
from stapeskit.provenance import input_record


class Inputs:
    """The input files by their role."""

    def __init__(self, paths: Mapping[str, Path]) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._states: dict[Path, tuple[int, int]] = {}
        self._records: dict[str, Future[dict[str, Any]]] = {}
        for role, path in paths.items():
            self.add(role, path)

    def add(self, role: str, path: Path) -> None:
        """Take one more file."""
        if path not in self._states:
            self._states[path] = _state(path)
            self._records[role] = self._pool.submit(input_record, path)

    def records(self) -> dict[str, dict[str, Any]]:
        """Return name, size, time and hash of every input by its role."""
        return {role: record.result() for role, record in self._records.items()}

    def check(self) -> None:
        """Refuse inputs that have changed since they were given.

        Raises
        ------
        StapeskitError
            One of them has changed.
        """
        for path, state in self._states.items():
            if _state(path) != state:
                step = "Wait until it is written, and try again"
                raise StapeskitError.of(
                    "the input", "left alone while it is read", "changes", path.name, step
                )

    def close(self) -> None:
        """End the thread without waiting for what is left to hash."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _state(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns

"""Refuse inputs that change while they are read."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from legacy.stapeskit.faults import Fault, StapeskitError, raise_all

# Files of a folder that are looked at; a folder of more (chunks of a Zarr image) is held to these.
_MOST_FILES = 20_000
_State = tuple[int, ...]


@dataclass(frozen=True)
class InputStates:
    """Device, inode, size and time of change of every input at the beginning of a run.

    Attributes
    ----------
    states : dict of Path to tuple of int
        Empty tuples for what was not there.
    """

    states: dict[Path, _State]

    @classmethod
    def of(cls, paths: Iterable[Path | None]) -> InputStates:
        """Record the state of files, and of the files within folders."""
        return cls({file: _state(file) for path in paths if path is not None for file in _files(Path(path))})

    def check(self, error: type[StapeskitError] = StapeskitError) -> None:
        """Refuse inputs that are not as they were.

        Raises
        ------
        StapeskitError
            Of the given class: a file was written, cut, replaced or removed since.
        """
        changed = [file for file, state in self.states.items() if _state(file) != state]
        step = "Wait until it is written or copied completely, and run again"
        raise_all(
            error,
            [
                Fault("the input", "left alone while it is read", "a file that changed", file.name, step)
                for file in changed
            ],
        )


@contextmanager
def refuse_changes(
    paths: Iterable[Path | None], error: type[StapeskitError] = StapeskitError
) -> Iterator[InputStates]:
    """Lend the states of files that the block reads, and refuse those that change meanwhile.

    Raises
    ------
    StapeskitError
        Of the given class, as `InputStates.check`; also in place of what failed in the block for that reason.
    """
    states = InputStates.of(paths)
    try:
        yield states
    except Exception:
        states.check(error)
        raise
    states.check(error)


def _files(path: Path) -> Iterator[Path]:
    yield path
    if not path.is_dir():
        return
    count = 0
    for top, _, names in os.walk(path):
        for name in sorted(names):
            count += 1
            if count > _MOST_FILES:
                return
            yield Path(top, name)


def _state(file: Path) -> _State:
    try:
        status = os.stat(file)
    except (OSError, ValueError):
        return ()
    state = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    # A folder changes with every other file in it that comes and goes: its files are looked at.
    return state[:2] if os.path.isdir(file) else state

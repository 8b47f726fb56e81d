"""Show the stage of long work in one line on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from legacy.stapeskit.run_log import note

Tell = Callable[[str], None]
_CLEAR = "\r\x1b[2K"


def silent(_stage: str) -> None:
    """Show nothing."""


@contextmanager
def stage_on_terminal(shown: bool) -> Iterator[Tell]:
    """Lend a function that shows the stage at work, and the time since the start, on standard error.

    The line is wiped when the block ends, however it ends.

    Parameters
    ----------
    shown : bool
        False: nothing is shown, as when standard error is no terminal.
    """
    if not shown or not sys.stderr.isatty():
        yield note
        return
    start = time.perf_counter()

    def tell(stage: str) -> None:
        note(stage)
        sys.stderr.write(f"{_CLEAR}{time.perf_counter() - start:5.1f} s  {stage} ...")
        sys.stderr.flush()

    try:
        yield tell
    finally:
        sys.stderr.write(_CLEAR)
        sys.stderr.flush()

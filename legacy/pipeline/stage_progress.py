"""What a person sees while a study runs: one line per stage on standard error, alive on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, TextIO

from legacy.stapeskit.run_log import note


@dataclass
class Step:
    """One stage at work; ``note`` is what its line says at the end."""

    title: str
    note: str = ""
    started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """Time since the step began."""
        return time.perf_counter() - self.started


@dataclass
class Progress:
    """A display of steps.

    Attributes
    ----------
    quiet : bool
        Show nothing.
    prefix : str
        Put before every line.
    stream : text stream
        Standard error when None.
    """

    quiet: bool = False
    prefix: str = ""
    stream: TextIO | None = None

    @contextmanager
    def step(self, title: str) -> Iterator[Step]:
        """Show a step while its block runs, and its line when it has ended."""
        current = Step(title)
        stream = sys.stderr if self.stream is None else self.stream
        with nullcontext() if self.quiet else _turn_wheel(title, stream):
            yield current
        remark = f"  {current.note}" if current.note else ""
        line = f"{self.prefix}{title:<40} {current.seconds:7.1f} s{remark}\n"
        note(line)
        if not self.quiet:
            stream.write(line)
            stream.flush()


@contextmanager
def _turn_wheel(title: str, stream: TextIO) -> Iterator[Any]:
    """Turn a wheel with the elapsed time on a terminal; do nothing elsewhere."""
    if not stream.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Bar(*columns, console=Console(file=stream), transient=True) as bar:
        bar.add_task(title, total=None)
        yield bar

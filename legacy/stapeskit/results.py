"""What the result of every step offers in a notebook: a short text, a table, a figure, files."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Kind = TypeVar("Kind")
# A result printed in a console fits one screen of 80 columns.
_MOST_ROWS = 24
_WIDEST = 76


class Result:
    """Base of results: what it prints comes from `title` and `summary`."""

    if TYPE_CHECKING:

        @property
        def notices(self) -> tuple[Notice, ...]:
            """Every warning."""

    @property
    @abstractmethod
    def title(self) -> str:
        """What this is, in a few words."""

    @abstractmethod
    def summary(self) -> Sequence[tuple[str, str]]:
        """Return the numbers that a reader looks for first, as rows of name and text."""

    @abstractmethod
    def to_frame(self) -> DataFrame:
        """Return the numbers as a pandas table, SI."""

    @abstractmethod
    def plot(self) -> Figure:
        """Return the figure that shows the result best."""

    @abstractmethod
    def write(self, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write the files of the command into a folder and return their paths.

        Parameters
        ----------
        force : bool
            Replace files that are not known as written by the command. Inputs are never replaced.

        Raises
        ------
        StapeskitError
            An output is an input, or a file of another origin has its name.
        """

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """Every warning, each with ``code`` and ``text``."""
        return self.notices

    def __repr__(self) -> str:
        rows = self._summary_rows()
        width = max(len(name) for name, _ in rows)
        lines = [self.title, *(f"  {name:<{width}}  {text}" for name, text in rows)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from legacy.stapeskit.page import page

        return (
            f"<p><b>{page.text(self.title)}</b></p>{page.table(('', ''), self._summary_rows(), words=True)}"
        )

    def _summary_rows(self) -> list[tuple[str, str]]:
        """Return the rows of the summary, at most one screen of them, and the codes of the warnings."""
        rows = [(name, shorten_line(text)) for name, text in self.summary()]
        if len(rows) > _MOST_ROWS:
            rows = [*rows[:_MOST_ROWS], ("...", f"{len(rows) - _MOST_ROWS} more in summary()")]
        return [*rows, ("warnings", codes_of(self.notices))]


def extend_result(kind: type[Kind], core: Any, **more: Any) -> Kind:
    """Return a result with the fields of what was computed and more fields."""
    return kind(**{part.name: getattr(core, part.name) for part in fields(core)}, **more)


def shorten_line(text: str, most: int = _WIDEST) -> str:
    """Return a text of at most ``most`` letters on one line."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[: most - 3]}..."


def codes_of(notices: Iterable[Notice]) -> str:
    """Return the codes of warnings, each once, with how often it occurs."""
    counts = Counter(notice.code for notice in notices)
    named = (code if number == 1 else f"{code} ({number})" for code, number in counts.items())
    return shorten_line(", ".join(named) or "none", 3 * _WIDEST)

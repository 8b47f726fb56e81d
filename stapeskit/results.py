"""Give the result of every step its form in Python: a short text, a table, a figure, files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

# A result printed in a console fits one screen of 80 columns and 30 lines.
_MOST_ROWS = 24
_WIDEST = 76


class Result(ABC):
    """Base of results: what it prints comes from `title`, `summary` and `notices`.

    Subclasses are frozen dataclasses, declared with ``repr=False`` so that they print as here.
    """

    if TYPE_CHECKING:

        @property
        def notices(self) -> tuple[Notice, ...]:
            """Every warning; a field of the subclass."""

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
        """Return the figure that shows the result best; a notebook shows it, with or without pyplot."""

    @abstractmethod
    def write(self, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write the files of the command into a folder and return their paths.

        Raises
        ------
        StapeskitError
            An output is an input, or a file of another origin has its name, which ``force`` replaces.
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
        """Return the summary as a table for a notebook."""
        from markupsafe import Markup

        row = Markup('<tr><th style="text-align:left">{}</th><td style="text-align:left">{}</td></tr>')
        rows = Markup("").join(row.format(name, text) for name, text in self._summary_rows())
        return str(Markup("<p><b>{}</b></p><table>{}</table>").format(self.title, rows))

    def _summary_rows(self) -> list[tuple[str, str]]:
        """Return the rows of the summary, at most one screen of them, and the codes of the warnings."""
        rows = [(shorten_line(name, 30), shorten_line(text)) for name, text in self.summary()]
        if len(rows) > _MOST_ROWS:
            rows = [*rows[:_MOST_ROWS], ("...", f"{len(rows) - _MOST_ROWS} more in summary()")]
        return [*rows, ("warnings", list_codes(self.notices))]


def shorten_line(text: str, most: int = _WIDEST) -> str:
    """Return a text of at most ``most`` letters on one line.

    >>> shorten_line("one   and\\ntwo", 9)
    'one an...'
    """
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[: most - 3]}..."


def list_codes(notices: Iterable[Notice]) -> str:
    """Return the codes of warnings, each once, with how often it occurs.

    >>> list_codes([Notice("a", ""), Notice("b", ""), Notice("a", "")]), list_codes([])
    ('a (2), b', 'none')
    """
    counts = Counter(notice.code for notice in notices)
    named = (code if number == 1 else f"{code} ({number})" for code, number in counts.items())
    return shorten_line(", ".join(named) or "none", 3 * _WIDEST)

"""Tables in Markdown, with the figures of version 0.2 next to the new ones.

`benchmarks/results/before.json` holds what the scripts of version 0.2 printed. `Before` finds a figure there
by the first words of its row and the head of its column.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from stapeskit.arrays import Array

RESULTS = Path(__file__).parent / "results"
NOTHING = "–"
PISTON_ENTRIES = tuple(f"{letter}{i}{j}" for letter in "KD" for i in (1, 2, 3) for j in range(i, 4))
"""Names of the twelve entries of K and D for y, alpha, gamma."""


class Before:
    """The tables that one script of version 0.2 printed.

    Parameters
    ----------
    name : str
        Key of before.json, e.g. ``fitting_estimators_100_20``.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @cached_property
    def lines(self) -> list[str]:
        """What it printed."""
        text = (RESULTS / "before.json").read_text(encoding="utf-8")
        return list(json.loads(text)["tables"].get(self.name, {}).get("printed", ()))

    @cached_property
    def rows(self) -> list[tuple[list[str], list[str]]]:
        """Head and cells of every row of every table."""
        found, head = list[tuple[list[str], list[str]]](), list[str]()
        for line, following in zip(self.lines, [*self.lines[1:], ""], strict=False):
            if not line.startswith("|"):
                continue
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if set(following) <= set("|- ") and following:
                head = cells
            elif not set(line) <= set("|- "):
                found.append((head, cells))
        return found

    def cell(self, column: str, *first: str) -> str:
        """Return the cell of a column in the row that begins with some words; a dash where there is none."""
        for head, cells in self.rows:
            if tuple(cells[: len(first)]) == first and column in head:
                return cells[head.index(column)]
        return NOTHING

    def line(self, start: str) -> str:
        """Return the line that begins with some words, without them; a dash where there is none."""
        return next((line[len(start) :].strip() for line in self.lines if line.startswith(start)), NOTHING)


def arguments(text: str | None, **defaults: float | str) -> argparse.Namespace:
    """Return the options of a script: each keyword is one of them, with its type and default."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    return parser.parse_args()


def print_head(*cells: str) -> None:
    """Print the head of a table."""
    print(f"| {' | '.join(cells)} |\n|{'-|' * len(cells)}", flush=True)


def print_row(*cells: object) -> None:
    """Print a row of a table."""
    print(f"| {' | '.join(str(cell) for cell in cells)} |", flush=True)


def print_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table; rows appear as they are made."""
    print_head(*head)
    for row in rows:
        print_row(*row)
    print(flush=True)


def percent(values: object, digits: int = 1) -> str:
    """Return the mean of values in percent; a dash where there are none."""
    array = np.asarray(values, dtype=float)
    return f"{100.0 * np.mean(array):.{digits}f} %" if array.size else NOTHING


def covers(deviations: Array) -> Array:
    """Return the share of errors over their standard deviation (draws, p) within 95 % intervals, (p,)."""
    return np.asarray(np.mean(np.abs(deviations) < 1.96, axis=0))


def root_mean_square(values: object) -> Array:
    """Return the root mean square over the first axis."""
    return np.asarray(np.sqrt(np.mean(np.square(np.asarray(values, dtype=float)), axis=0)))

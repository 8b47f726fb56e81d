"""Tables in Markdown, with the figures of version 0.2 next to the new ones.

`benchmarks/results/before.json` holds what the scripts of version 0.2 printed. `before` finds a figure there
by the first word of its row and the head of its column.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from stapeskit.arrays import Array

RESULTS = Path(__file__).parent / "results"
NOTHING = "–"
PISTON_ENTRIES = tuple(f"{letter}{i}{j}" for letter in "KD" for i in (1, 2, 3) for j in range(i, 4))
"""Names of the twelve entries of K and D for y, alpha, gamma."""


def printed_before(name: str) -> list[str]:
    """Return what a script of version 0.2 printed; the name is a key of before.json."""
    text = (RESULTS / "before.json").read_text(encoding="utf-8")
    return list(json.loads(text)["tables"][name]["printed"])


def before(name: str, column: str, first: str) -> str:
    """Return the cell that version 0.2 printed in a column of the row that begins so; else a dash."""
    head = list[str]()
    for line in printed_before(name):
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells or not head:
            head = cells
        elif cells[0] == first and column in head:
            return cells[head.index(column)]
    return NOTHING


def arguments(text: str | None, **defaults: float | str) -> argparse.Namespace:
    """Return the options of a script: each keyword is one of them, with its type and default."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    return parser.parse_args()


def print_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table; rows appear as they are made."""
    print(f"| {' | '.join(head)} |\n|{'-|' * len(head)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(str(cell) for cell in row)} |", flush=True)
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

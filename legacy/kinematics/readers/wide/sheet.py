"""The text of a wide table: lines above it, one line of names, perhaps one of units, rows of numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.psv.text_blocks import decoded, value_of
from legacy.kinematics.readers.text import lines_of, shown
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, raise_all

_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
# Lines above the names: a header of a measuring program has some ten.
_MOST_ABOVE = 100


@dataclass(frozen=True)
class Sheet:
    """A table of numbers.

    Attributes
    ----------
    line : int
        Of the names, from 1.
    names, units : tuple of str
        Names without units, and the units; empty where none is stated.
    numbers : ndarray, (rows, columns)
        NaN where a cell is empty.
    """

    file: str
    line: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array

    def place(self, column: int | None = None) -> Place:
        """Return the place of the header, or of a column, for messages."""
        detail = "" if column is None else f"column {shown(self.names[column])}"
        return Place(self.file, "line", (self.line,), detail)


def header_of(text: str) -> tuple[int, list[str], list[str], str] | None:
    """Return line (from 0), names, units and separator of the header in the first lines of a text.

    None where no line of names is followed by a row of at least two numbers.
    """
    lines = lines_of(text)[:_MOST_ABOVE]
    for mark in ("\t", ";", ","):
        first = next((n for n, line in enumerate(lines) if _is_row(_cells(line, mark))), None)
        if not first:
            continue
        above = [n for n in range(first) if lines[n].strip()]
        if not above or mark not in lines[above[-1]]:
            continue
        names, units, at = _cells(lines[above[-1]], mark), [], above[-1]
        if len(above) > 1 and all(_is_unit(cell) for cell in names):
            units = [cell.strip("[]() ") for cell in names]
            at = above[-2]
            names = _cells(lines[at], mark)
        units += [""] * (len(names) - len(units))
        matches = [_UNIT.search(name) for name in names]
        stated = [match[1].strip() if match else unit for match, unit in zip(matches, units, strict=False)]
        return at, [_UNIT.sub("", name).strip() for name in names], stated, mark
    return None


def read_sheet(path: Path) -> Sheet:
    """Read a wide table.

    Raises
    ------
    KinematicsError
        No line of names above rows of numbers, rows of another length, or cells that are no numbers.
    """
    text = decoded(path.read_bytes())
    header = header_of(text)
    if header is None:
        step = "Put one line of names above the rows"
        raise KinematicsError.of(
            "the table", "one line of names above rows of numbers", "none", path.name, step
        )
    at, names, units, mark = header
    rows: list[list[float | None]] = []
    faults: list[Fault] = []
    for number, line in enumerate(lines_of(text)[at + 1 :], at + 2):
        cells = _cells(line, mark)
        if not any(cells) or (not rows and not faults and not _is_row(cells)):
            continue
        values = [value_of(cell) for cell in cells]
        if len(values) == len(names) and None not in values:
            rows.append(values)
            continue
        place = Place(path.name, "line", (number,))
        if len(values) != len(names):
            faults.append(Fault("a row", f"of {len(names)} cells as its header", len(values), place))
        else:
            bad = values.index(None)
            where = Place(path.name, "line", (number,), f"column {shown(names[bad])}")
            faults.append(
                Fault("a cell", "a number", shown(cells[bad]), where, "Correct it, or leave it empty")
            )
    raise_all(KinematicsError, faults)
    return Sheet(path.name, at + 1, tuple(names), tuple(units), np.array(rows, dtype=float))


def _cells(line: str, mark: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]
    except csv.Error:
        return []


def _is_row(cells: Sequence[str]) -> bool:
    return len(cells) > 1 and sum(bool(cell) and value_of(cell) is not None for cell in cells) * 2 > len(
        cells
    )


def _is_unit(cell: str) -> bool:
    """Return whether a cell is a unit alone: in brackets, or one of the usual ones."""
    return bool(re.fullmatch(r"[\[(].*[\])]|k?Hz|°|deg|rad|[munp]?m(/s[2²]?)?|µm(/s)?|g|", cell))

"""Tables of numbers in text: lines above (some ``Name: value``), names, perhaps units, and rows.

A text may hold many tables. Tabs, semicolons or commas separate cells; with the first two, or in quotes,
commas may be decimal ones.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kinematics.readers.text import CUT, shown
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError

_NUMBER = re.compile(r"\s*[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?\s*")
_FIELD = re.compile(r"\s*([^:\t,;]{2,40}):(.*)")
_UNIT = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*$")
_UNIT_ALONE = re.compile(r"[\[(].*[\])]|k?Hz|°|deg|rad|[munp]?m(/s[2²]?)?|µm(/s)?|g|")

Line = tuple[int, str]
"""Its number, from 1, and its text."""


@dataclass(frozen=True)
class Sheet:
    """A table: place of its line of names, names and units of its columns, ``Name: value`` lines, numbers.

    ``lines`` (row,) are the numbers of its rows in the file, ``left_out`` of those behind a ``#``.
    ``decimal`` is the mark of decimals in its rows; empty where they have none.
    """

    where: Place
    names: tuple[str, ...]
    units: tuple[str, ...]
    fields: Mapping[str, str] = field(default_factory=dict)
    numbers: Array = field(default_factory=lambda: np.empty((0, 0)))
    lines: Array = field(default_factory=lambda: np.empty(0))
    left_out: tuple[int, ...] = ()
    decimal: str = ""

    def field_of(self, names: Sequence[str]) -> str:
        """Return the value of the first ``Name: value`` line that is there; empty without one."""
        return next((self.fields[name] for name in names if name in self.fields), "")

    def number(self, text: str) -> float | None:
        """Read a number of the lines above; None of text, and of ``1,150`` where rows have decimal points."""
        thousands = re.fullmatch(r"[+-]?\d{1,3}([.,])\d{3}", text.strip())
        unclear = thousands is not None and thousands[1] != self.decimal
        return None if unclear else number_of(text.replace(",", "."))

    def refuse(self, thing: str, expected: str, got: str, step: str = "") -> StapeskitError:
        """Return the error of the table, at its line of names."""
        return StapeskitError.of(thing, expected, shown(got) or "none", self.where, step)


def sheets_of(text: str, file: str, faults: list[Fault]) -> list[Sheet]:
    """Read every table of a text; what is wrong with their rows and cells is added to the faults."""
    found = []
    for above, rows, left_out in _regions(text):
        sheet, separator = _header(above, file)
        found.append(replace(_with_numbers(sheet, rows, separator, faults), left_out=tuple(left_out)))
    if not found:
        step = "Export it again with its header, or take it out of the folder"
        faults.append(Fault("the table", "one line of names above rows of numbers", "none", file, step))
    return found


def _regions(text: str) -> Iterator[tuple[list[Line], list[Line], list[int]]]:
    """Find the tables of a text: the lines above, and the rows, of which the first begins with a number.

    Lines of empty cells and comments (``#``) are passed over; third are the numbers of those that were rows.
    """
    above, rows, left_out = list[Line](), list[Line](), list[int]()
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip(" \t;,\r\f"):
            continue
        if rows and line.lstrip().startswith("#"):
            left_out += [number] if re.search("[\t;,]", line) else []
            continue
        if rows and _FIELD.match(line):
            yield above, rows, left_out
            above, rows, left_out = [], [], []
        first = re.split("[\t;,]", line, maxsplit=1)
        if rows or (above and len(first) == 2 and _NUMBER.fullmatch(first[0].strip('" '))):
            rows.append((number, line))
        else:
            above.append((number, line))
    if rows:
        yield above, rows, left_out


def _header(above: Sequence[Line], file: str) -> tuple[Sheet, str]:
    """Read the names and units right above the rows, and the fields above them; return also the separator."""
    number, line = above[-1]
    separator = next((mark for mark in "\t;" if mark in line), ",")
    names, units = _cells(line, separator), [""]
    if len(above) > 1 and all(map(_UNIT_ALONE.fullmatch, names)):
        units = [cell.strip("[]() ") for cell in names]
        number, line = above[-2]
        names = _cells(line, separator)
    matches = [_UNIT.search(cell) for cell in names]
    inline = ["" if match is None else (match[1] or match[2] or "").strip() for match in matches]
    units += [""] * (len(names) - len(units))
    fields = [match for _, line in above if (match := _FIELD.match(line))]
    sheet = Sheet(
        Place(file, "line", (number,)),
        tuple(_UNIT.sub("", cell).strip() for cell in names),
        tuple(own or below for own, below in zip(inline, units, strict=False)),
        {match[1].strip().lower(): match[2].strip(" \t;") for match in fields},
    )
    return sheet, separator


def _split(line: str, separator: str) -> list[str]:
    """Split a line into its cells, without the quotes around them."""
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def _cells(line: str, separator: str) -> list[str]:
    """Split a line of names or units; nothing stands behind the last one."""
    cells = _split(line, separator)
    while cells and not cells[-1].strip():
        cells.pop()
    return [cell.strip() for cell in cells]


def _with_numbers(sheet: Sheet, rows: Sequence[Line], separator: str, faults: list[Fault]) -> Sheet:
    """Return the table with its numbers, NaN for empty cells; rows at fault are reported and left out."""
    width, sound = len(sheet.names), dict[int, list[float]]()
    table = [(number, _split(line, separator)) for number, line in rows]
    point, comma = (any(mark in cell for _, cells in table for cell in cells) for mark in ".,")
    for number, cells in table:
        cells = cells[:-1] if len(cells) == width + 1 and not cells[-1].strip() else cells
        cells = [cell.replace(",", ".") for cell in cells] if comma and not point else cells
        where = Place(sheet.where.file, "line", (number,))
        if len(cells) != width:
            faults.append(Fault("a row", f"of {width} numbers", len(cells), where, CUT))
            continue
        try:
            sound[number] = [float(cell) if cell and not cell.isspace() else np.nan for cell in cells]
        except ValueError:
            bad = next(k for k, cell in enumerate(cells) if cell.strip() and number_of(cell) is None)
            step = "Write a plain number without separators of thousands, or leave the cell empty"
            if re.search(r"\d[ij]\)?$", cells[bad].strip()):
                step = "Write real and imaginary part into two columns"
            thing = f"column {shown(sheet.names[bad])}"
            faults.append(Fault(thing, "a number", shown(cells[bad]), where, step))
    numbers = np.array([*sound.values()], dtype=float).reshape(len(sound), width)
    decimal = "." if point else "," if comma else ""
    return replace(sheet, numbers=numbers, lines=np.array([*sound], dtype=int), decimal=decimal)


def number_of(cell: str) -> float | None:
    """Read a number; None of text."""
    try:
        return float(cell)
    except ValueError:
        return None

"""Tables of numbers in text: ``Name: value`` lines, a line of names, perhaps one of units, and rows.

A text may hold many tables. Cells stand between tabs, semicolons, commas or blanks, with decimal points or,
but for the comma, decimal commas.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kinematics.readers.text import CUT, read_text, shown
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError

_NUMBER = re.compile(
    r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE
)
_LONGEST_NUMBER = 400  # letters; longer ones are no numbers of a measurement
_LARGEST_FILE = 1 << 30  # 1 GB of text holds 10^7 readings
_FIELD = re.compile(r"\s*([^:\t,;]{2,40}):(.*)")
_UNIT = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*$")
_UNIT_ALONE = re.compile(r"[\[(].*[\])]|k?Hz|°|deg|rad|[munp]?m(/s[2²]?)?|µm(/s)?|g|")


@dataclass(frozen=True)
class Sheet:
    """A table: place of its line of names, names and units of its columns, numbers, ``Name: value`` lines."""

    where: Place
    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array
    fields: Mapping[str, str] = field(default_factory=dict)

    def field_of(self, names: Sequence[str]) -> str:
        """Return the value of the first ``Name: value`` line that is there; empty without one."""
        return next((self.fields[name] for name in names if name in self.fields), "")

    def column_of(self, name: str) -> int:
        """Return the column of a name, which may have its unit behind it.

        Raises
        ------
        StapeskitError
            It is not in the table once.
        """
        plain = name_and_unit(name)[0]
        if self.names.count(plain) != 1:
            step, got = f"It has {', '.join(self.names[:12])}", f"{self.names.count(plain)} of that name"
            raise refuse(self, f"the column {plain}", "in the table once", got, step)
        return self.names.index(plain)


@dataclass(frozen=True)
class _Region:
    """Lines of one table, counted from 0: its header begins, its rows begin, its rows end."""

    start: int
    first: int
    stop: int
    separator: str


def number_of(cell: str, comma: bool = True) -> float | None:
    """Read a number with a decimal point, or comma where allowed: NaN of an empty cell, None of text."""
    cell = cell.strip()
    if not cell:
        return np.nan
    if len(cell) > _LONGEST_NUMBER or not _NUMBER.fullmatch(cell) or ("," in cell and not comma):
        return None
    return float(cell.replace(",", "."))


def name_and_unit(cell: str) -> tuple[str, str]:
    """Split ``Real X [m/s]`` into the name and the unit, which is empty without one."""
    match = _UNIT.search(cell)
    if match is None:
        return cell.strip(), ""
    return cell[: match.start()].strip(), (match[1] or match[2] or "").strip()


def sheets_of(path: Path, faults: list[Fault]) -> list[Sheet]:
    """Read every table of a file; what is wrong with their rows and cells is added to the faults."""
    if path.stat().st_size > _LARGEST_FILE:
        faults.append(Fault("a text export", "smaller than 1 GB", "a larger one", path.name))
        return []
    lines = read_text(path).split("\n")
    sheets = []
    for region in _regions(lines):
        sheet = _header(lines, region, path.name)
        rows = lines[region.first : region.stop]
        sheets.append(_with_numbers(sheet, rows, region, faults))
    if not sheets:
        want, step = (
            "one line of names above rows of numbers",
            "Export it again with its header, or take it out of the folder",
        )
        faults.append(Fault("the table", want, "none", path.name, step))
    return sheets


def first_header(text: str) -> Sheet | None:
    """Return the first table of the beginning of a text without its rows; None where there is none."""
    lines = text.split("\n")
    region = next(_regions(lines), None)
    return None if region is None else _header(lines, region, "")


def _regions(lines: Sequence[str]) -> Iterator[_Region]:
    """Find the tables of a text: rows of numbers and the lines above them."""
    filled = [number for number, line in enumerate(lines) if line.strip()]
    start = header = at = 0
    while at < len(filled):
        separator = _separator(lines[filled[at]])
        if not separator:
            at += 1
            continue
        end = at + 1
        while end < len(filled) and not _FIELD.match(lines[filled[end]]):
            apart = filled[end] > filled[end - 1] + 1
            if apart and _separator(lines[filled[end]]) != separator:
                break
            end += 1
        if at > header:
            yield _Region(start, filled[at], filled[end - 1] + 1, separator)
        start, header, at = filled[end - 1] + 1, end, end


def _separator(line: str) -> str:
    """Return what separates the cells of a row of numbers, of which it has two or more; else empty."""
    if not line.strip() or _FIELD.match(line):
        return ""
    for mark in "\t;, ":
        if mark in line:
            cells = _cells(line, mark)
            numbers = sum(bool(cell) and number_of(cell) is not None for cell in cells)
            if len(cells) > 1 and 2 * numbers > len(cells):
                return mark
    return ""


def _cells(line: str, separator: str) -> list[str]:
    """Split a line; where the separator is a blank, several in a row count as one."""
    if separator == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator), []) if '"' in line else line.split(separator)
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def _header(lines: Sequence[str], region: _Region, file: str) -> Sheet:
    """Read the names and units right above the rows, and the fields above them."""
    above = [number for number in range(region.start, region.first) if lines[number].strip()]
    names, units = _names(lines[above[-1]], region.separator), [""]
    if len(above) > 1 and all(map(_UNIT_ALONE.fullmatch, names)):
        units = [cell.strip("[]() ") for cell in names]
        above.pop()
        names = _names(lines[above[-1]], region.separator)
    named = [name_and_unit(cell) for cell in names]
    units += [""] * (len(named) - len(units))
    matches = [match for number in above[:-1] if (match := _FIELD.match(lines[number]))]
    return Sheet(
        Place(file, "line", (above[-1] + 1,)),
        tuple(name for name, _ in named),
        tuple(unit or below for (_, unit), below in zip(named, units, strict=False)),
        np.empty((0, len(named))),
        {match[1].strip().lower(): match[2].strip(" \t;") for match in matches},
    )


def _names(line: str, separator: str) -> list[str]:
    """Split a line of names or units as the rows are; at two blanks or at brackets where rows have blanks."""
    line = line.strip()
    if separator == " ":
        cells = re.findall(r"\[[^\]]*\]", line) if line.startswith("[") else re.split(r"\s{2,}", line)
    else:
        cells = _cells(line, separator)
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _with_numbers(sheet: Sheet, rows: Sequence[str], region: _Region, faults: list[Fault]) -> Sheet:
    """Return the table with the numbers of its rows; rows at fault are reported and left out."""
    joined, width, separator = "\n".join(rows), len(sheet.names), region.separator
    comma = separator != "," and "," in joined and "." not in joined
    if '"' not in joined and "_" not in joined:
        try:  # by numpy, which knows no empty cells
            text = io.StringIO(joined.replace(",", ".") if comma else joined)
            delimiter = None if separator == " " else separator
            with np.errstate(over="ignore"):
                numbers = np.loadtxt(text, delimiter=delimiter, comments=None, ndmin=2)
            if numbers.shape[1] == width:
                return Sheet(sheet.where, sheet.names, sheet.units, numbers, sheet.fields)
        except ValueError:
            pass
    sound = []
    for line, row in enumerate(rows, region.first + 1):
        if not row.strip():
            continue
        cells = _cells(row, separator)
        cells = cells[:-1] if len(cells) == width + 1 and not cells[-1] else cells
        values = [number_of(cell, comma) for cell in cells]
        where = Place(sheet.where.file, "line", (line,))
        if len(values) != width:
            faults.append(Fault("a row", f"of {width} numbers", len(values), where, CUT))
        elif None in values:
            bad = values.index(None)
            step = "Write a plain number without separators of thousands, or leave the cell empty"
            thing = f"column {shown(sheet.names[bad])}"
            faults.append(Fault(thing, "a number", shown(cells[bad]), where, step))
        else:
            sound.append([value for value in values if value is not None])
    numbers = np.array(sound, dtype=float).reshape(len(sound), width)
    return Sheet(sheet.where, sheet.names, sheet.units, numbers, sheet.fields)


def refuse(sheet: Sheet, thing: str, expected: str, got: str, step: str = "") -> StapeskitError:
    """Return the error of a table, at its line of names."""
    return StapeskitError.of(thing, expected, got, sheet.where, step)

"""Read a CSV file cell by cell and say what is wrong where."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place
from legacy.stapeskit.tables.csv_fast import MISSING
from legacy.stapeskit.tables.csv_text import Sheet, decoded, no_text

_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_ENDLESS = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)


@dataclass(frozen=True)
class Cells:
    """What was read: numbers by column, texts by column, lines of the rows, faults, skipped comments."""

    numbers: dict[str, Array]
    texts: dict[str, list[str]]
    lines: NDArray[np.int64]
    faults: tuple[Fault, ...]
    comments: int


def read_cells(sheet: Sheet, numbers: set[str], texts: set[str]) -> Cells:
    """Read every row below the header; blank lines and lines that begin with ``#`` are passed over.

    Raises
    ------
    StapeskitError
        The text is not UTF-8.
    """
    data = sheet.data[sheet.start : sheet.stop]
    if b"\x00" in data:
        raise no_text(sheet.file)
    text = decoded(data, sheet.file, sheet.line)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=sheet.separator, skipinitialspace=True)
    cells: dict[str, list[str]] = {column: [] for column in (*sorted(numbers), *sorted(texts))}
    places = [(column, sheet.header.index(column)) for column in cells]
    lines: list[int] = []
    faults: list[Fault] = []
    width, comments, begun = len(sheet.header), 0, sheet.line
    rows = iter(reader)
    while True:
        try:
            row = next(rows)
        except StopIteration:
            break
        except csv.Error as fault:
            where = Place(sheet.file, "line", (begun,))
            faults.append(Fault("a row", "text that can be split into cells", fault, where, "Correct it"))
            break
        line, begun = begun, sheet.line + reader.line_num
        if not any(cell.strip() for cell in row):
            continue
        if row[0].lstrip().startswith("#"):
            comments += 1
            continue
        if (len(row) != width and "".join(row[width:]).strip()) or len(row) < width:
            faults.append(_length_fault(sheet, line, begun - line, row))
            continue
        if not lines and not faults and _are_units([row[place] for name, place in places if name in numbers]):
            where = Place(sheet.file, "line", (line,))
            got, step = "units", "Units belong in the names of the columns: remove the line"
            faults.append(Fault("the line below the header", "the first row of numbers", got, where, step))
            continue
        lines.append(line)
        for column, place in places:
            cells[column].append(row[place].strip())
    decimal = _decimal(sheet, cells, numbers)
    values = {
        column: _parse(cells[column], column, decimal, sheet.file, lines, faults)
        for column in sheet.header
        if column in numbers
    }
    words = {column: cells[column] for column in texts}
    faults.sort(key=_line_of)
    return Cells(values, words, np.array(lines, dtype=np.int64), tuple(faults), comments)


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether the number columns hold several words and no number."""
    words = [cell for cell in map(str.strip, cells) if cell not in MISSING]
    return len(words) > 1 and not any(letter.isdigit() for word in words for letter in word.rstrip("23²³"))


def _line_of(fault: Fault) -> int:
    """Return the line of a fault."""
    return fault.where.numbers[0] if isinstance(fault.where, Place) and fault.where.numbers else 0


def _decimal(sheet: Sheet, cells: dict[str, list[str]], numbers: set[str]) -> str:
    """Return the mark of the decimals that most of the numbers have."""
    if sheet.separator == ",":
        return "."
    comma = sum("," in cell for column in numbers for cell in cells[column])
    point = sum("." in cell for column in numbers for cell in cells[column])
    return "," if comma > point else "."


def _parse(
    cells: Sequence[str], column: str, decimal: str, name: str, lines: Sequence[int], faults: list[Fault]
) -> Array:
    import pandas as pd

    plain = [cell.replace(",", ".") for cell in cells] if decimal == "," else cells
    values = np.array(pd.to_numeric(pd.Series(plain, dtype=object), errors="coerce"), dtype=float)
    other = "." if decimal == "," else ","
    doubtful = np.isnan(values) | np.array([other in cell for cell in cells], dtype=bool)
    for place in np.flatnonzero(doubtful).tolist():
        cell = cells[place]
        values[place] = np.nan
        if cell in MISSING:
            continue
        if (_NUMBER.fullmatch(cell) and other not in cell) or _ENDLESS.fullmatch(cell):
            values[place] = float(cell.replace(",", "."))
            continue
        where = Place(name, "line", (lines[place],))
        faults.append(Fault(column, "a number", f'"{_printable(cell)}"', where, _hint(cell, decimal)))
    return values


def _hint(cell: str, decimal: str) -> str:
    if decimal == "," and "." in cell:
        return "Write decimal commas or decimal points throughout, and nothing between thousands"
    if "," in cell:
        return "Write a point for the decimals, or semicolons between the columns"
    if cell.startswith("#") or not any(letter.isdigit() for letter in cell):
        return "Write a plain number, or leave the cell empty where the value is missing"
    return "Write a plain number such as 1000 or 1e-6"


def _length_fault(sheet: Sheet, line: int, height: int, row: Sequence[str]) -> Fault:
    got = len(row)
    hint = "Give every row one cell per column, empty where a value is missing"
    width = len(sheet.header)
    if sheet.separator == "," and got > width:
        hint = "Decimal commas need semicolons between the columns"
    others = [mark for mark in (",", ";", "\t") if mark != sheet.separator and mark in row[0]]
    if got == 1 and others:
        names = {",": "commas", ";": "semicolons", "\t": "tabs"}
        hint = f"Separate all cells by {names[sheet.separator]}, as in the header, not by {names[others[0]]}"
        return _row_fault(sheet, line, got, hint)
    if height > 1:
        hint = "Close the quotation mark that the row opens"
    if got < width and sheet.header[got]:
        hint += f"; this one ends before {sheet.header[got]}"
    return _row_fault(sheet, line, got, hint)


def _row_fault(sheet: Sheet, line: int, got: int, hint: str) -> Fault:
    expected = f"{len(sheet.header)} cells long, as the header is"
    return Fault("a row", expected, f"{got}", Place(sheet.file, "line", (line,)), hint)


def _printable(cell: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in cell)

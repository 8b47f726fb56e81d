"""Text exports of scanning vibrometers: blocks of ``Name: value`` lines, a line of column names, numbers."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.text import lines_of, shown
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all

T = TypeVar("T")
EXPORT_ENDINGS = (".txt", ".asc", ".csv", ".dat")
# Characters of the name in a line ``Name: value``.
_NAME = range(2, 41)
_UNIT = re.compile(r"\[([^\]]*)\]")
# Text exports are read whole; 1 GB of text holds 10^7 readings.
_MAX_FILE = 1 << 30
# Files of a folder: a point and axis each of 30 000 points. A home folder has more.
_MOST_FILES = 100_000
# No table has more columns than these, and no number more characters: what is longer is no measurement, and
# splitting it takes twenty times the file's size in memory.
_MOST_CELLS, _LONGEST_NUMBER = 10_000, 400


@dataclass(frozen=True)
class Block:
    """One table of an export.

    Attributes
    ----------
    line : int
        Of the column names, from 1.
    fields : mapping of str to str
        The lines above it, names in lower case.
    columns, units : tuple of str
        Names without units, and the units.
    numbers : ndarray, (rows, columns)
    """

    file: str
    line: int
    fields: Mapping[str, str]
    columns: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array

    @property
    def where(self) -> Place:
        """Place for messages."""
        return Place(self.file, "line", (self.line,))


def decoded(content: bytes) -> str:
    """Decode UTF-8, UTF-16 with its mark, or Latin-1."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _field(line: str) -> tuple[str, str] | None:
    """Return name, in lower case, and value of a line ``Name: value``; None for another line."""
    before, colon, value = line.partition(":")
    name = before.strip()
    if not colon or len(name) not in _NAME or "\t" in name:
        return None
    return name.lower(), value.strip(" \t\r;")


def fields_of(text: str) -> dict[str, str]:
    """Return the ``Name: value`` lines at the top of a text, names in lower case."""
    fields = {}
    for line in lines_of(text)[:40]:
        field = _field(line)
        if field is not None:
            fields[field[0]] = field[1]
        elif _is_numbers(line):
            break
    return fields


def read_blocks(path: Path, read: Callable[[Block], T], deep: bool = False) -> list[T]:
    """Read every table of a file, or of the text exports in a folder.

    Parameters
    ----------
    read : callable
        What to make of one table.
    deep : bool
        Whether folders of the folder count.

    Raises
    ------
    KinematicsError
        Every fault of every file together, or there is no text export.
    """
    files = export_files(path, deep) if path.is_dir() else [path]
    entries: list[T] = []
    faults: list[Fault] = []
    for file in files:
        for block in blocks(file, faults):
            with collect_faults(faults):
                entries.append(read(block))
    raise_all(KinematicsError, faults)
    if not entries:
        step = "Give the folder of the exported text files"
        raise KinematicsError.of("the folder", "one with text exports", "none", path.name, step)
    return entries


def export_files(folder: Path, deep: bool = True, endings: tuple[str, ...] = EXPORT_ENDINGS) -> list[Path]:
    """Return the files of a folder, perhaps with its folders, that may be exports: not hidden, by ending.

    Raises
    ------
    KinematicsError
        It holds more files than a measurement has.
    """
    entries = list(islice(folder.rglob("*") if deep else folder.iterdir(), _MOST_FILES + 1))
    if len(entries) > _MOST_FILES:
        step = "Give the folder of the exported text files"
        got, name = f"more than {_MOST_FILES}", folder.name
        raise KinematicsError.of("the folder", "one with the files of a measurement", got, name, step)
    return sorted(
        path
        for path in entries
        if path.suffix.lower() in endings and not path.name.startswith(".") and path.is_file()
    )


def blocks(path: Path, faults: list[Fault]) -> list[Block]:
    """Read every table of a file.

    Parameters
    ----------
    faults : list of str
        What is wrong is added to it: a file without table, a header that does not fit its table, rows that
        are not as long as it, and cells that are no number.
    """
    if path.stat().st_size > _MAX_FILE:
        faults.append(Fault("a text export", "smaller than 1 GB", "a larger one", path.name))
        return []
    lines = lines_of(decoded(path.read_bytes()))
    tables: list[Block] = []
    start, before = 0, len(faults)
    while (first := _first_row(lines, start)) is not None:
        start, named = _find_table_end(lines, first), start
        with collect_faults(faults):
            tables.append(_block(lines, named, (first, start), path.name, faults))
    if not tables and len(faults) == before:
        step = "Export it again as ASCII, or take it out of the folder"
        faults.append(Fault("a text export", "a header and a table of numbers", "no table", path.name, step))
    return tables


def _first_row(lines: list[str], start: int) -> int | None:
    """Return the first line that is a row: half of its cells at least are numbers."""
    return next((n for n in range(start, len(lines)) if _is_row(lines[n])), None)


def _is_row(line: str) -> bool:
    if not line.strip() or _field(line) is not None:
        return False
    cells = _cells(line)
    return 2 * sum(bool(cell) and value_of(cell) is not None for cell in cells) >= max(len(cells), 1)


def _find_table_end(lines: list[str], first: int) -> int:
    """Return where a table ends: at an empty line or at the header of the next one."""
    last = first
    while last < len(lines) and lines[last].strip() and _field(lines[last]) is None:
        last += 1
    return last


def _block(lines: list[str], start: int, rows: tuple[int, int], file: str, faults: list[Fault]) -> Block:
    """Read the table with the lines ``rows``, and the header above it."""
    first = rows[0]
    fields, names, units, named = {}, "", "", start
    for number in range(start, first):
        line = lines[number]
        field = _field(line)
        if field is not None:
            fields[field[0]] = field[1]
        elif line.strip():
            if names and _only_units(line):
                units = line
            else:
                names, units, named = line, "", number
    columns, inline = _split_names(names)
    below = _split_units(units) if units else inline
    table = lines[slice(*rows)]
    width = Counter(len(_cells(line)) for line in table).most_common(1)[0][0]
    if not columns or len(columns) != width or len(below) != width:
        got = f"{len(columns)} names and {len(below)} units over {width} numbers"
        raise KinematicsError.of(
            "the table", "one name and one unit to each column", got, Place(file, "line", (named + 1,))
        )
    numbers = _parse_numbers(table, first + 1, columns, file, faults)
    return Block(file, named + 1, fields, columns, below, numbers)


def _cells(line: str) -> list[str]:
    """Split a line of numbers, into ``_MOST_CELLS`` and a rest at most."""
    for mark in ("\t", ";"):
        if mark in line:
            return [cell.strip() for cell in line.strip().strip(mark).split(mark, _MOST_CELLS)]
    return line.split(maxsplit=_MOST_CELLS)


def _is_numbers(line: str) -> bool:
    """Return whether a line holds numbers only, two at least or one alone."""
    cells = _cells(line) if line.strip() else []
    return (
        bool(cells) and value_of(cells[0]) is not None and all(value_of(cell) is not None for cell in cells)
    )


def value_of(cell: str) -> float | None:
    """Read a number with decimal point or comma: NaN of an empty cell, None of what is no number."""
    if not cell:
        return np.nan
    if len(cell) > _LONGEST_NUMBER:
        return None
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        return None
    return value if cell.isascii() and "_" not in cell else None


def _parse_numbers(
    table: list[str], line: int, columns: tuple[str, ...], file: str, faults: list[Fault]
) -> Array:
    """Return the numbers of the rows with a cell for every column; report the other rows."""
    step = "It may be cut short: export it again"
    good = array("d")
    for number, row in enumerate(table, line):
        cells = _cells(row)
        values = [value_of(cell) for cell in cells]
        whole = [value for value in values if value is not None]
        if len(whole) == len(values) == len(columns):
            good.extend(whole)
            continue
        where = Place(file, "line", (number,))
        if len(values) != len(columns):
            got = len(values) if len(whole) == len(values) else shown(" ".join(cells[:100]))
            faults.append(Fault("a row", f"of {len(columns)} numbers", got, where, step))
            continue
        for name, cell, value in zip(columns, cells, values, strict=True):
            if value is None:
                place = replace(where, detail=f"column {shown(name)}")
                faults.append(Fault("a row", "of numbers", shown(cell), place, step))
    return np.asarray(good).reshape(-1, len(columns))


def _only_units(line: str) -> bool:
    cells = [cell for cell in re.split(r"\t|;", line) if cell.strip()]
    return all(_UNIT.fullmatch(cell.strip()) for cell in cells) and bool(cells)


def _split_names(line: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    cells = re.split(r"\t|;", line.strip("\r\n\t "))
    if len(cells) == 1:
        cells = re.split(r"\s{2,}", line.strip())
    units = [match[1].strip() if (match := _UNIT.search(cell)) else "" for cell in cells]
    return tuple(_UNIT.sub("", cell).strip() for cell in cells), tuple(units)


def _split_units(line: str) -> tuple[str, ...]:
    cells = re.split(r"\t|;", line.strip("\r\n\t "))
    if len(cells) == 1:
        cells = _UNIT.findall(line)
    return tuple(cell.strip().strip("[]").strip() for cell in cells)

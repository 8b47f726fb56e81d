"""Tables of text exports of scanning vibrometers: ``Name: value`` lines, names and units of columns, numbers.

The layouts are known from programs that read them; no such file of the vendor was available.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from kinematics.readers.columns import Sheet, name_and_unit
from kinematics.readers.text import cells_of, is_row, read_rows, read_text
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults

_UNIT = re.compile(r"\[([^\]]*)\]")
_FIELD = re.compile(r"\s*([^:\t]{2,40}):(.*)")
_LARGEST_FILE = 1 << 30  # 1 GB of text holds 10^7 readings


def names_above(lines: Sequence[str]) -> set[str]:
    """Return the names of the ``Name: value`` lines, in small letters."""
    return {match[1].strip().lower() for line in lines if (match := _FIELD.match(line))}


def blocks_of(path: Path, faults: list[Fault]) -> list[Sheet]:
    """Read every table of a file; what is wrong is added to the faults."""
    if path.stat().st_size > _LARGEST_FILE:
        faults.append(Fault("a text export", "smaller than 1 GB", "a larger one", path.name))
        return []
    lines = read_text(path).split("\n")
    rows = [bool(line.strip()) and not _FIELD.match(line) and is_row(_cells(line)) for line in lines]
    blocks: list[Sheet] = []
    start, before = 0, len(faults)
    while True in rows[start:]:
        first = rows.index(True, start)
        end = first
        while end < len(lines) and lines[end].strip() and not _FIELD.match(lines[end]):
            end += 1
        with collect_faults(faults):
            blocks.append(_block(lines[start:first], start, lines[first:end], path.name, faults))
        start = end
    if not blocks and len(faults) == before:
        step = "Export it again as ASCII, or take it out of the folder"
        faults.append(Fault("a text export", "a header and a table of numbers", "no table", path.name, step))
    return blocks


def _block(header: Sequence[str], start: int, rows: Sequence[str], file: str, faults: list[Fault]) -> Sheet:
    """Read one table: the lines above it, which begin at line ``start`` from 0, and its rows."""
    fields, cells, below, at = dict[str, str](), list[str](), list[str](), start
    for number, line in enumerate(header, start):
        if match := _FIELD.match(line):
            fields[match[1].strip().lower()] = match[2].strip(" \t;")
        elif line.strip() and cells and all(_UNIT.fullmatch(cell) for cell in _split(line) if cell):
            below = [cell.strip("[]").strip() for cell in _split(line)]
        elif line.strip():
            cells, below, at = _split(line), [], number
    named = [name_and_unit(cell) for cell in cells]
    units = below or [unit for _, unit in named]
    width = Counter(len(_cells(line)) for line in rows).most_common(1)[0][0]
    where = Place(file, "line", (at + 1,))
    if not len(named) == len(units) == width:
        got = f"{len(named)} names and {len(units)} units over {width} numbers"
        raise StapeskitError.of("the table", "one name and one unit to each column", got, where)
    names, stripped = tuple(name for name, _ in named), [line.strip() for line in rows]
    numbers = read_rows(stripped, start + len(header) + 1, _separator(rows[0]), names, file, faults)
    return Sheet(where, names, tuple(units), numbers, fields)


def _separator(line: str) -> str:
    return next((mark for mark in "\t;" if mark in line), " ")


def _cells(line: str) -> list[str]:
    return cells_of(line.strip(), _separator(line))


def _split(line: str) -> list[str]:
    """Split a line of names or units: at tabs or semicolons, else at two blanks or at brackets."""
    cells = re.split(r"[\t;]", line.strip())
    if len(cells) == 1:
        cells = (
            re.findall(r"\[[^\]]*\]", line) if line.strip().startswith("[") else re.split(r"\s{2,}", cells[0])
        )
    return [cell.strip() for cell in cells]

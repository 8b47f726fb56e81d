"""Read a CSV table fast, and report every malformed row.

Commas, semicolons or tabs between columns; decimal commas with the latter two; UTF-8 and UTF-16, byte order
marks, any line ends, quoted cells, ``#`` comments and the ``sep=;`` line of spreadsheets are fine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, StapeskitError
from legacy.stapeskit.tables.csv_cells import read_cells
from legacy.stapeskit.tables.csv_fast import read_fast
from legacy.stapeskit.tables.csv_text import no_rows, open_sheet


@dataclass(frozen=True)
class TextColumn:
    """Texts stored once: ``names[codes]``; code -1 is an empty cell."""

    codes: NDArray[np.intp]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """The wanted columns of a file.

    Attributes
    ----------
    file : str
        Name of the file, for messages.
    numbers : mapping of str to ndarray, (rows,)
        NaN where a cell is empty.
    lines : ndarray, (rows,)
        Line of each row in the file, counted from 1.
    faults : tuple of str
        Sentences on cells that are no numbers and rows of wrong length.
    comments : int
        Lines below the header that begin with ``#`` and were passed over.
    """

    file: str
    numbers: Mapping[str, Array]
    texts: Mapping[str, TextColumn]
    lines: NDArray[np.int64]
    faults: tuple[Fault, ...] = ()
    comments: int = 0

    def __len__(self) -> int:
        return len(self.lines)

    def invalid_rows(self, column: str = "") -> NDArray[np.bool_]:
        """Return which rows (rows,) have a cell, in one column or in any, that was reported as no number."""
        if not self.faults:
            return np.zeros(len(self), dtype=bool)
        lines = [
            line
            for fault in self.faults
            if isinstance(fault.where, Place) and (not column or fault.thing == column)
            for line in fault.where.numbers
        ]
        return np.isin(self.lines, lines)

    def where(self, row: int, column: str = "") -> Place:
        """Return the place of a row for a message."""
        return Place(self.file, "line", (int(self.lines[row]),), column)


def read_table(path: Path, choose: Callable[[Sequence[str], str], tuple[set[str], set[str]]]) -> Table:
    """Read a table.

    Parameters
    ----------
    choose : callable
        Takes the column names and the file's name, returns the names of the number columns and of the text
        columns to read, and raises when the header is not as it must be.

    Raises
    ------
    StapeskitError
        The file is missing, empty, no text in UTF-8 or UTF-16, or has two columns of one name.
    """
    sheet = open_sheet(path)
    try:
        numbers, texts = choose(sheet.header, sheet.file)
    except StapeskitError as fault:
        in_header = Place(sheet.file, "line", (1,))
        raise type(fault)(
            *(
                replace(entry, where=sheet.header_place) if entry.where == in_header else entry
                for entry in fault.faults
            )
        ) from fault
    if sheet.start >= sheet.stop:
        empty = sheet.data[sheet.start :].strip() == b""
        raise StapeskitError(no_rows(sheet.file, "the header alone" if empty else "empty rows"))
    read = read_fast(sheet, numbers, texts)
    if read is not None:
        words = {name: _number(*column) for name, column in read.texts.items()}
        return _without_empty(Table(sheet.file, read.numbers, words, read.lines, (), read.comments))
    cells = read_cells(sheet, numbers, texts)
    words = {name: _number(*_encode(column)) for name, column in cells.texts.items()}
    return Table(sheet.file, cells.numbers, words, cells.lines, cells.faults, cells.comments)


def _encode(column: Sequence[str]) -> tuple[NDArray[np.intp], list[str]]:
    """Store every text once."""
    unique = {word: place for place, word in enumerate(dict.fromkeys(column))}
    return np.array([unique[word] for word in column], dtype=np.intp), list(unique)


def _number(codes: NDArray[np.intp], names: list[str]) -> TextColumn:
    """Number texts in the order of first appearance, the empty one as -1."""
    first = np.full(len(names) + 1, len(codes), dtype=np.intp)
    new_text = np.ones(len(codes), dtype=bool)
    new_text[1:] = codes[1:] != codes[:-1]
    changes = np.flatnonzero(new_text)
    first[codes[changes][::-1]] = changes[::-1]
    code_of: dict[str, int] = {}
    for code in np.argsort(first[:-1], kind="stable").tolist():
        if names[code] and first[code] < len(codes):
            code_of.setdefault(names[code], len(code_of))
    new = np.full(len(names) + 1, -1, dtype=np.intp)
    for code, word in enumerate(names):
        new[code] = code_of.get(word, -1)
    return TextColumn(new[codes], tuple(code_of))


def _without_empty(table: Table) -> Table:
    """Drop rows whose cells are all empty."""
    empty = np.ones(len(table), dtype=bool)
    for column in table.texts.values():
        empty &= column.codes < 0
    if not np.any(empty):
        return table
    for values in table.numbers.values():
        empty &= np.isnan(values)
    keep = ~empty
    return Table(
        table.file,
        {name: values[keep] for name, values in table.numbers.items()},
        {name: TextColumn(column.codes[keep], column.names) for name, column in table.texts.items()},
        table.lines[keep],
        table.faults,
        table.comments,
    )

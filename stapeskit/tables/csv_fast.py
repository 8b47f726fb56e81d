"""Read the rows of a regular CSV file piece by piece, on a few threads."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.tables.csv_text import Sheet

Array = NDArray[np.float64]
MISSING = ("", "nan", "NaN", "NAN", "Nan", "-nan", "+nan", "-NaN")
Piece = tuple[dict[str, Array], dict[str, tuple[NDArray[np.intp], list[str]]]]
_PIECE = 4 << 20
_STRETCH = 1 << 18
_MOST_THREADS = 4
_SHORT = 1 << 15
_MOST_IRREGULAR = 0.2
_MARKS = (b"#", b"\x00", b'"')


@dataclass(frozen=True)
class Stretch:
    """Rows between two offsets, and their columns; None when they must be read cell by cell."""

    start: int
    stop: int
    piece: Piece | None


def read_fast(sheet: Sheet, numbers: set[str], texts: set[str]) -> Piece | list[Stretch] | None:
    """Read the wanted columns with the C parser of pandas.

    Parameters
    ----------
    sheet : Sheet
    numbers, texts : set of str
        Names of the columns.

    Returns
    -------
    tuple, list or None
        Numbers (rows,) by column, and codes (rows,) with their texts by column. Where some rows are not as
        the header says or hold cells that are no numbers: stretches of rows, the short ones around these not
        read. None when the file has many such rows, or quoted cells, which may go on over line ends.

    Notes
    -----
    pandas >= 3 parses numbers to the nearest double, earlier ones to within one unit in the last place.
    """
    parse = _Parse(sheet, decimal_of(sheet), numbers, texts)
    pieces = list(pairwise(_cuts(sheet)))
    threads = min(len(pieces), _processors(), _MOST_THREADS)
    if threads < 2:
        return _together([parse.stretches(*piece) for piece in pieces], numbers, texts, map)
    from concurrent.futures import ThreadPoolExecutor

    import pandas as pd

    del pd
    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(lambda piece: parse.stretches(*piece), pieces))
        return _together(found, numbers, texts, pool.map)


def decimal_of(sheet: Sheet) -> str:
    """Return the mark of the decimals of a regular file."""
    return "," if sheet.separator != "," and sheet.data.find(b",", sheet.start) >= 0 else "."


def _together(
    found: list[list[Stretch] | None], numbers: set[str], texts: set[str], apply: Callable[..., Iterable[Any]]
) -> Piece | list[Stretch] | None:
    """Join the columns of all pieces when all of them are regular."""
    stretches = [stretch for some in found if some is not None for stretch in some]
    if any(some is None for some in found) or not any(stretch.piece for stretch in stretches):
        return None
    whole = [stretch.piece for stretch in stretches if stretch.piece is not None]
    if len(whole) < len(stretches):
        return stretches
    names, words = sorted(numbers), sorted(texts)
    columns = apply(lambda name: np.concatenate([frame[0][name] for frame in whole]), names)
    coded = apply(lambda name: joined([frame[1][name] for frame in whole]), words)
    return dict(zip(names, columns, strict=True)), dict(zip(words, coded, strict=True))


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cuts(sheet: Sheet) -> list[int]:
    """Return offsets that part the rows at line ends."""
    size = sheet.stop - sheet.start
    count = max(1, round(size / _PIECE))
    cuts = [sheet.start]
    for k in range(1, count):
        cut = sheet.data.find(b"\n", sheet.start + size * k // count, sheet.stop) + 1
        if cut > cuts[-1]:
            cuts.append(cut)
    return [*cuts, sheet.stop]


class _Parse:
    """Reads pieces of one file; remembers that one had empty cells or blanks, which cost time to look for."""

    def __init__(self, sheet: Sheet, decimal: str, numbers: set[str], texts: set[str]) -> None:
        self.sheet, self.decimal, self.numbers, self.texts = sheet, decimal, numbers, texts
        self.careful = False
        self.irregular = 0
        self.all_columns = numbers | texts == set(sheet.header)

    def stretches(self, start: int, stop: int) -> list[Stretch] | None:
        """Read the rows between two offsets, halving what is not regular; None to read no more."""
        if self.irregular > _MOST_IRREGULAR * (self.sheet.stop - self.sheet.start):
            return None
        body = self.sheet.data[start:stop]
        piece = self.piece(body)
        if piece is not None:
            return [Stretch(start, stop, piece)]
        if b'"' in body or b"\x00" in body:
            return None
        middle = body.find(b"\n", len(body) // 2) + 1
        if len(body) <= _SHORT or not 0 < middle < len(body):
            self.irregular += len(body)
            return [Stretch(start, stop, None)]
        first = self.stretches(start, start + middle)
        second = None if first is None else self.stretches(start + middle, stop)
        return None if first is None or second is None else first + second

    def piece(self, body: bytes) -> Piece | None:
        """Return numbers and coded texts of some rows; None when they are not regular."""
        sheet = self.sheet
        newlines, marks = _scanned(body)
        rows = newlines + (not body.endswith(b"\n"))
        quoted = b'"' in marks
        if b"#" in marks or b"\x00" in marks or not self._wide_enough(body, rows, quoted):
            return None
        frame = None if self.careful else self._frame(body, quoted, False)
        if frame is None:
            frame = self._frame(body, quoted, True)
            self.careful = frame is not None
        if frame is None or len(frame) != rows or not _every_row_complete(sheet, body, frame, quoted):
            return None
        values = {column: np.ascontiguousarray(frame[column].to_numpy()) for column in self.numbers}
        if any(self._is_word(body, name, values[name]) for name in self.numbers):
            return None
        return values, {column: _coded(frame[column]) for column in self.texts}

    def _wide_enough(self, body: bytes, rows: int, quoted: bool) -> bool:
        """Tell whether no row has too many cells, which pandas notices itself when it reads all columns."""
        mark, width = self.sheet.separator.encode(), len(self.sheet.header)
        if self.all_columns and not quoted:
            return body.count(mark, 0, body.find(b"\n") % (len(body) + 1)) == width - 1
        return _count(body, mark) == rows * (width - 1)

    def _is_word(self, body: bytes, name: str, values: Array) -> bool:
        """Tell whether a column of zeros and ones was read from the words true and false."""
        few = values[:64]
        if not np.all(np.isnan(few) | (few == 0.0) | (few == 1.0)):
            return False
        known = np.flatnonzero(~np.isnan(values))
        if not known.size or not np.all((values[known] == 0.0) | (values[known] == 1.0)):
            return False
        row = int(known[0])
        line = body.split(b"\n", row + 1)[row].decode("utf-8", "replace")
        cells = next(csv.reader([line], delimiter=self.sheet.separator, skipinitialspace=True))
        return cells[self.sheet.header.index(name)].strip().lower() in ("true", "false")

    def _frame(self, body: bytes, quoted: bool, careful: bool) -> Any:
        import pandas as pd

        kinds: dict[str, Any] = dict.fromkeys(self.numbers, np.float64)
        kinds |= dict.fromkeys(self.texts, "category")
        try:
            return pd.read_csv(
                io.BytesIO(body),
                sep=self.sheet.separator,
                decimal=self.decimal,
                names=list(self.sheet.header),
                header=None,
                usecols=None if self.all_columns and not quoted else list(kinds),
                dtype=kinds,
                engine="c",
                keep_default_na=False,
                na_values={column: list(MISSING) for column in self.numbers} if careful else {},
                skip_blank_lines=False,
                skipinitialspace=careful or quoted,
                quoting=csv.QUOTE_MINIMAL if quoted else csv.QUOTE_NONE,
                index_col=False,
                low_memory=False,
            )
        except ValueError:
            return None


def _scanned(body: bytes) -> tuple[int, set[bytes]]:
    """Count the line ends, and tell which of the marks that need care stand in the text."""
    text = np.frombuffer(body, np.uint8)
    newlines, marks = 0, set()
    for start in range(0, len(body), _STRETCH):
        stop = start + _STRETCH
        newlines += int(np.count_nonzero(text[start:stop] == 10))
        marks |= {mark for mark in _MARKS if body.find(mark, start, stop) >= 0}
    return newlines, marks


def _count(body: bytes, mark: bytes) -> int:
    """Count a character, a stretch at a time so that it stays in the processor's cache."""
    text, wanted = np.frombuffer(body, np.uint8), mark[0]
    starts = range(0, len(text), _STRETCH)
    return sum(int(np.count_nonzero(text[start : start + _STRETCH] == wanted)) for start in starts)


def _every_row_complete(sheet: Sheet, body: bytes, frame: Any, quoted: bool) -> bool:
    """Tell whether each row has the header's number of cells, knowing that none or all together have more.

    A row that ends too early then shows by its last cell, which reads empty.
    """
    last = sheet.header[-1]
    if last in frame.columns and not frame[last].isna().any() and not quoted:
        return True
    text = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero((text == sheet.separator.encode()[0]) | (text == 10))
    width = len(sheet.header)
    newline = text[ends] == 10
    return bool(np.all(newline[width - 1 :: width])) and int(np.sum(newline)) == len(ends) // width


def _coded(series: Any) -> tuple[NDArray[np.intp], list[str]]:
    codes = np.asarray(series.cat.codes, dtype=np.intp)
    return codes, [str(name).strip() for name in series.cat.categories]


def joined(parts: Sequence[tuple[NDArray[np.intp], list[str]]]) -> tuple[NDArray[np.intp], list[str]]:
    """Give the same texts of several pieces the same code."""
    if len(parts) == 1:
        return parts[0]
    known: dict[str, int] = {}
    columns = []
    for codes, names in parts:
        new = np.array([known.setdefault(name, len(known)) for name in names] + [-1], dtype=np.intp)
        columns.append(new[codes])
    return np.concatenate(columns), list(known)

"""Read the rows of a regular CSV file piece by piece, on a few threads."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.tables.csv_text import Sheet

MISSING = ("", "nan", "NaN", "NAN", "Nan", "-nan", "+nan", "-NaN")
Coded = tuple[NDArray[np.intp], list[str]]
_PIECE_BYTES = 4 << 20  # small enough that the pieces of an ordinary file keep every thread busy
_CACHED_BYTES = 1 << 18  # counted at once: fits into the processor's second-level cache
_MOST_THREADS = 4  # more of them wait for the memory
_MARKS = (b"#", b"\x00", b'"')
_SKIPPED = re.compile(rb"^[ \t]*(#[^\n]*|\r?)\n", re.MULTILINE)


@dataclass(frozen=True)
class Columns:
    """Columns of some rows: numbers (rows,); codes (rows,) with their texts; lines (rows,) of the file.

    ``height`` is the number of lines with the comments, of which there are ``comments``, and blank lines.
    """

    numbers: dict[str, Array]
    texts: dict[str, Coded]
    lines: NDArray[np.int64]
    height: int
    comments: int = 0


def read_fast(sheet: Sheet, numbers: set[str], texts: set[str]) -> Columns | None:
    """Read the wanted columns with the C parser of pandas.

    Parameters
    ----------
    numbers, texts : set of str
        Names of the columns.

    Returns
    -------
    Columns or None
        None when a row is not as the header says, a cell is not a number, or a comment is among quoted
        cells: `read_cells` then reads the file.

    Notes
    -----
    pandas >= 3 parses numbers to the nearest double, earlier ones to within one unit in the last place.
    """
    parse = _Parser(sheet, decimal_of(sheet), numbers, texts)
    bodies = [sheet.data[start:stop] for start, stop in pairwise(_cuts(sheet))]
    threads = min(len(bodies), _processors(), _MOST_THREADS)
    if threads < 2:
        return _join([parse(body) for body in bodies], sheet.line)
    from concurrent.futures import ThreadPoolExecutor

    import pandas  # noqa: F401  before the threads, which must not import it at the same time

    with ThreadPoolExecutor(threads) as pool:
        return _join(list(pool.map(parse, bodies)), sheet.line)


def decimal_of(sheet: Sheet) -> str:
    """Return the mark of the decimals of a regular file."""
    return "," if sheet.separator != "," and sheet.data.find(b",", sheet.start) >= 0 else "."


def _join(parts: Sequence[Columns | None], line: int) -> Columns | None:
    """Join the columns of all pieces, the first of which begins at a line, when all of them are regular."""
    regular = [part for part in parts if part is not None]
    if len(regular) < len(parts):
        return None
    starts = line + np.cumsum([0, *(part.height for part in regular)])
    return Columns(
        {name: np.concatenate([part.numbers[name] for part in regular]) for name in regular[0].numbers},
        {name: _same_codes([part.texts[name] for part in regular]) for name in regular[0].texts},
        np.concatenate([start + part.lines for start, part in zip(starts, regular, strict=False)]),
        int(starts[-1]) - line,
        sum(part.comments for part in regular),
    )


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cuts(sheet: Sheet) -> list[int]:
    """Return offsets at line ends that divide the rows into pieces."""
    size = sheet.stop - sheet.start
    count = max(1, round(size / _PIECE_BYTES))
    cuts = [sheet.start]
    for k in range(1, count):
        cut = sheet.data.find(b"\n", sheet.start + size * k // count, sheet.stop) + 1
        if cut > cuts[-1]:
            cuts.append(cut)
    return [*cuts, sheet.stop]


class _Parser:
    """Reads pieces of one file; remembers that one had empty cells or blanks, which take time to look for."""

    def __init__(self, sheet: Sheet, decimal: str, numbers: set[str], texts: set[str]) -> None:
        self.sheet, self.decimal, self.numbers, self.texts = sheet, decimal, numbers, texts
        self.careful = False
        self.irregular = False
        self.all_columns = numbers | texts == set(sheet.header)

    def __call__(self, body: bytes) -> Columns | None:
        """Return numbers and coded texts of some rows; None when these or earlier ones are not regular."""
        columns = None if self.irregular else self._columns(body)
        self.irregular |= columns is None
        return columns

    def _columns(self, body: bytes) -> Columns | None:
        sheet = self.sheet
        newlines, marks = _newlines_and_marks(body)
        height = rows = newlines + (not body.endswith(b"\n"))
        lines, comments, quoted = np.arange(rows), 0, b'"' in marks
        if not quoted and (b"#" in marks or not self._wide_enough(body, rows, quoted)):
            body, lines, comments = _without_skipped(body, rows)
            rows = len(lines)
        if (b"#" in marks and quoted) or b"\x00" in marks or not self._wide_enough(body, rows, quoted):
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
        texts = {column: _encode(frame[column]) for column in self.texts}
        return Columns(values, texts, lines, height, comments)

    def _wide_enough(self, body: bytes, rows: int, quoted: bool) -> bool:
        """Return whether no row has too many cells, which pandas notices itself when it reads all columns."""
        mark, width = self.sheet.separator.encode(), len(self.sheet.header)
        if self.all_columns and not quoted:
            return body.count(mark, 0, body.find(b"\n") % (len(body) + 1)) == width - 1
        return _count(body, mark) == rows * (width - 1)

    def _is_word(self, body: bytes, name: str, values: Array) -> bool:
        """Return whether a column of zeros and ones was read from the words true and false."""
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
        except (ValueError, OverflowError):  # the latter for a whole number that no float holds
            return None


def _newlines_and_marks(body: bytes) -> tuple[int, set[bytes]]:
    """Count the line ends, and return which of the characters that need care occur."""
    text = np.frombuffer(body, np.uint8)
    newlines, marks = 0, set()
    for start in range(0, len(body), _CACHED_BYTES):
        stop = start + _CACHED_BYTES
        newlines += int(np.count_nonzero(text[start:stop] == 10))
        marks |= {mark for mark in _MARKS if body.find(mark, start, stop) >= 0}
    return newlines, marks


def _without_skipped(body: bytes, height: int) -> tuple[bytes, NDArray[np.int64], int]:
    """Remove comments and blank lines; return the rest, the lines of its rows, and the number of comments."""
    remaining, skipped, comments, end, line = [], [], 0, 0, 0
    for match in _SKIPPED.finditer(body):
        line += body.count(b"\n", end, match.start())
        remaining.append(body[end : match.start()])
        skipped.append(line)
        comments += match[1].startswith(b"#")
        end, line = match.end(), line + 1
    return b"".join([*remaining, body[end:]]), np.delete(np.arange(height), skipped), comments


def _count(body: bytes, mark: bytes) -> int:
    """Count a character, a stretch at a time so that it stays in the processor's cache."""
    text, wanted = np.frombuffer(body, np.uint8), mark[0]
    starts = range(0, len(text), _CACHED_BYTES)
    return sum(int(np.count_nonzero(text[start : start + _CACHED_BYTES] == wanted)) for start in starts)


def _every_row_complete(sheet: Sheet, body: bytes, frame: Any, quoted: bool) -> bool:
    """Return whether each row has as many cells as the header, when no row or not all rows can have more.

    The last cell of a row that ends too early reads empty.
    """
    last = sheet.header[-1]
    if last in frame.columns and not frame[last].isna().any() and not quoted:
        return True
    text = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero((text == sheet.separator.encode()[0]) | (text == 10))
    width = len(sheet.header)
    newline = text[ends] == 10
    return bool(np.all(newline[width - 1 :: width])) and int(np.sum(newline)) == len(ends) // width


def _encode(series: Any) -> Coded:
    codes = np.asarray(series.cat.codes, dtype=np.intp)
    return codes, [str(name).strip() for name in series.cat.categories]


def _same_codes(parts: Sequence[Coded]) -> Coded:
    """Give the same texts of several pieces the same code."""
    if len(parts) == 1:
        return parts[0]
    known: dict[str, int] = {}
    columns = []
    for codes, names in parts:
        new = np.array([known.setdefault(name, len(known)) for name in names] + [-1], dtype=np.intp)
        columns.append(new[codes])
    return np.concatenate(columns), list(known)

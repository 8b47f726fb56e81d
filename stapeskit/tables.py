"""Read CSV tables as laboratories write them, and report every malformed row with its line.

Commas, semicolons or tabs between columns; decimal commas with the latter two; UTF-8 and UTF-16, byte order
marks, any line ends, quoted cells, ``#`` comments and the ``sep=;`` line of spreadsheets are fine.
pandas reads large tables whose rows are all alike; the others are read cell by cell, to find what is odd.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError

Choose = Callable[[Sequence[str], str], tuple[set[str], set[str]]]
"""Takes the column names and the file's name and returns the number columns and the text columns to read;
raises when the header is not as it must be."""

MISSING = ("", "nan", "NaN", "NAN", "Nan", "-nan", "+nan", "-NaN")
"""Number cells without a value."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_LARGE = 2_000_000  # bytes from which pandas takes less time, with that of loading it, than cell by cell


@dataclass(frozen=True)
class TextColumn:
    """Texts stored once: ``names[codes]``, in the order of their first row; code -1 is an empty cell."""

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
    texts : mapping of str to TextColumn
    lines : ndarray, (rows,)
        Line of each row in the file, counted from 1.
    faults : tuple of Fault
        Cells that are no numbers and rows of another length.
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


@dataclass(frozen=True)
class _Sheet:
    """A CSV file whose header was found: UTF-8 bytes below the header, and the line at which they begin."""

    file: str
    header: tuple[str, ...]
    separator: str
    body: bytes
    line: int


def read_table(path: Path, choose: Choose) -> Table:
    """Read the wanted columns of a table.

    Parameters
    ----------
    path : Path
    choose : callable
        See `Choose`. A fault that it places in line 1 is placed in the line of the header.

    Raises
    ------
    StapeskitError
        The file is missing, empty, no text in UTF-8 or UTF-16, or has two columns of one name; and what
        ``choose`` raises.
    """
    sheet = _open(Path(path))
    try:
        numbers, texts = choose(sheet.header, sheet.file)
    except StapeskitError as error:
        assumed, there = Place(sheet.file, "line", (1,)), Place(sheet.file, "line", (sheet.line - 1,))
        faults = (replace(fault, where=there) if fault.where == assumed else fault for fault in error.faults)
        raise StapeskitError(*faults) from error
    if not sheet.body:
        step, want = "Export it again", "a table with rows below its header"
        raise StapeskitError.of(sheet.file, want, "the header alone", next_step=step)
    read = _read_alike(sheet, numbers, texts) if len(sheet.body) > _LARGE else None
    return _read_cells(sheet, numbers, texts) if read is None else read


def write_columns(path: Path, columns: Mapping[str, Iterable[object]]) -> None:
    """Write columns of equal length by their names as a CSV file; NaN is an empty cell."""
    with Path(path).open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(["" if cell != cell else cell for cell in row])


def _open(path: Path) -> _Sheet:
    """Read a file and find its header, below blank lines, comments and the line ``sep=;``."""
    whole, file = _bytes(path), path.name
    begin = whole.rfind(b"\n", 0, len(whole) - len(whole.lstrip())) + 1  # below blank lines
    rest, line, marked, head = whole[begin:], 1 + whole.count(b"\n", 0, begin), "", ""
    while True:
        first, _, rest = rest.partition(b"\n")
        head, line = first.decode("utf-8").rstrip("\r"), line + 1
        if found := re.fullmatch(r'\s*"?sep=(.)"?[,;\s]*', head, re.IGNORECASE):
            marked = found[1]
        elif head.strip() and not head.lstrip().startswith("#"):
            break
        elif not rest:
            raise StapeskitError.of("a CSV file", "a header and rows", "no header", file, "Export it again")
    bare = re.sub(r'"[^"]*"', "", head)
    separator = marked if marked in _SEPARATORS and marked in head else max(_SEPARATORS, key=bare.count)
    where = Place(file, "line", (line - 1,))
    try:
        header = [_column_name(cell) for cell in next(csv.reader([head], delimiter=separator))]
    except csv.Error as error:
        got, step = str(error), "End lines with a line feed, and put quotes around whole names only"
        raise StapeskitError.of("the header", "one line of names", got, where, step) from error
    while header and not header[-1]:
        header.pop()
    if sum(bool(_NUMBER.fullmatch(name)) for name in header) > len(header) // 2:
        step = "Put the names of the columns above the rows"
        raise StapeskitError.of("the first line", "the header", "numbers", where, step)
    if twice := sorted(name for name, times in Counter(header).items() if name and times > 1):
        got, step = f"{', '.join(twice)} twice", "Rename or remove one of them"
        raise StapeskitError.of("column names", "different", got, where, step)
    return _Sheet(file, tuple(header), separator, _without_empty_end(rest), line)


def _bytes(path: Path) -> bytes:
    """Return the content of a file as UTF-8 with line feeds."""
    if not path.is_file():
        raise StapeskitError.of("the table", "an existing CSV file", path, "", "Check its name and folder")
    data, step = path.read_bytes(), "Save it as CSV UTF-8"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        with suppress(UnicodeDecodeError):
            data = data.decode("utf-16").encode("utf-8")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\x00" in data:
        got = "UTF-16 or binary data without a byte order mark"
        raise StapeskitError.of("a CSV file", "text in UTF-8", got, path.name, step)
    if not data or data.isspace():
        got, step = "an empty file", "Export it again"
        raise StapeskitError.of("a CSV file", "a header and rows", got, path.name, step)
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    try:
        if not data.isascii():
            data.decode("utf-8")
    except UnicodeDecodeError as error:
        where = Place(path.name, "line", (1 + data.count(b"\n", 0, error.start),))
        raise StapeskitError.of("a CSV file", "text in UTF-8", "another encoding", where, step) from error
    return data


def _without_empty_end(body: bytes) -> bytes:
    """Drop the last lines when they hold nothing but separators."""
    stop = len(body)
    while stop:
        begin = body.rfind(b"\n", 0, stop - 1) + 1
        if body[begin:stop].strip(b" \t\r\n;,"):
            break
        stop = begin
    return body[:stop]


def _column_name(cell: str) -> str:
    """Write a column's name in lower case with underscores: ``Re [µm/s]`` is ``re_um_s``."""
    name = cell.strip().strip('"').lower()
    for odd, even in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^2", "2")):
        name = name.replace(odd, even)
    return re.sub(r"[\s()\[\]/_]+", "_", name).strip("_")


def _read_alike(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table | None:
    """Read a table whose rows all have as many plain cells; None for another one, and for odd numbers."""
    import pandas as pd

    body = sheet.body if sheet.body.endswith(b"\n") else sheet.body + b"\n"
    if b'"' in body or b"#" in body:
        return None
    letters = np.frombuffer(body, dtype=np.uint8)
    ends = letters == ord("\n")
    marks = np.flatnonzero(ends | (letters == ord(sheet.separator)))
    last_of_row = np.flatnonzero(ends[marks])
    width = len(sheet.header)
    if np.any(np.diff(last_of_row, prepend=-1) != width):
        return None
    commas = sheet.separator != "," and body.count(b",") > body.count(b".")
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            sep=sheet.separator,
            header=None,
            names=[name or f"column {place}" for place, name in enumerate(sheet.header)],
            usecols=[*numbers, *texts],
            dtype={**dict.fromkeys(numbers, float), **dict.fromkeys(texts, str)},
            decimal="," if commas else ".",
            keep_default_na=False,
            na_values={name: list(MISSING) for name in numbers},
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
        )
    except ValueError:
        return None
    values = {name: frame[name].to_numpy(float) for name in sheet.header if name in numbers}
    empty = np.all([np.isnan(column) for column in values.values()], axis=0)
    if len(frame) != len(last_of_row) or np.any(empty):  # a return within a row; perhaps an empty row
        return None
    words = {}
    for name in texts:
        codes, different = pd.factorize(frame[name])
        encoded = _encode(different)
        words[name] = TextColumn(encoded.codes[codes], encoded.names)
    return Table(sheet.file, values, words, sheet.line + np.arange(len(frame), dtype=np.int64))


def _encode(column: Iterable[str]) -> TextColumn:
    """Store every text once, without blanks around it."""
    places: dict[str, int] = {"": -1}
    codes = [places.setdefault(text.strip(), len(places) - 1) for text in column]
    del places[""]
    return TextColumn(np.array(codes, dtype=np.intp), tuple(places))


def _read_cells(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table:
    """Read every row cell by cell; blank lines and comments are passed over."""
    text = io.StringIO(sheet.body.decode("utf-8"), newline="")
    rows = csv.reader(text, delimiter=sheet.separator, skipinitialspace=True)
    width, comments, below = len(sheet.header), 0, sheet.line
    kept: list[list[str]] = []
    lines: list[int] = []
    faults: list[Fault] = []
    while True:
        line = below
        try:
            row = next(rows)
        except StopIteration:
            break
        except csv.Error as error:
            where = Place(sheet.file, "line", (line,))
            faults.append(Fault("a row", "text that can be split into cells", error, where, "Correct it"))
            break
        below = sheet.line + rows.line_num
        cells = [cell.strip() for cell in row]
        if not any(cells):
            continue
        if cells[0].startswith("#"):
            comments += 1
        elif len(cells) < width or any(cells[width:]):
            faults.append(_length_fault(sheet, line, below - line, cells))
        else:
            kept.append(cells)
            lines.append(line)
    columns = {name: [cells[sheet.header.index(name)] for cells in kept] for name in (*numbers, *texts)}
    comma = sum("," in cell for name in numbers for cell in columns[name])
    point = sum("." in cell for name in numbers for cell in columns[name])
    decimal = "," if sheet.separator != "," and comma > point else "."
    values = {
        name: _parse(columns[name], name, decimal, sheet.file, lines, faults)
        for name in sheet.header
        if name in numbers
    }
    faults.sort(key=lambda fault: fault.where.numbers[0] if isinstance(fault.where, Place) else 0)
    words = {name: _encode(columns[name]) for name in texts}
    return Table(sheet.file, values, words, np.array(lines, dtype=np.int64), tuple(faults), comments)


def _parse(
    cells: Sequence[str], column: str, decimal: str, file: str, lines: Sequence[int], faults: list[Fault]
) -> Array:
    """Return the numbers of a column, NaN with a fault noted where a cell holds none."""
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        plain = cell.replace(".", " ").replace(",", ".") if decimal == "," else cell
        if _NUMBER.fullmatch(plain):
            values[row] = float(plain)
        elif cell not in MISSING:
            shown = "".join(letter if letter.isprintable() else "?" for letter in cell)
            where = Place(file, "line", (lines[row],))
            faults.append(Fault(column, "a number", f'"{shown}"', where, _hint(cell, decimal)))
    return values


def _hint(cell: str, decimal: str) -> str:
    if "," in cell and decimal == ".":
        return "Write a point for decimals and nothing between thousands, or semicolons between the columns"
    if "." in cell and decimal == ",":
        return "Write decimal commas or decimal points throughout, and nothing between thousands"
    if not any(letter.isdigit() for letter in cell):
        return "Leave the cell empty where the value is missing; units belong in the names of the columns"
    return "Write a plain number such as 1000 or 1e-6, without marks between thousands"


def _length_fault(sheet: _Sheet, line: int, height: int, cells: Sequence[str]) -> Fault:
    """Return the fault of a row of another length, with its likely cause."""
    got, width = len(cells), len(sheet.header)
    step = "Give every row one cell per column, empty where a value is missing"
    if got == 1 and any(mark in cells[0] for mark in _SEPARATORS if mark != sheet.separator):
        step = f"Separate all cells by {_SEPARATORS[sheet.separator]}, as in the header"
    elif height > 1:
        step = "Close the quotation mark that the row opens"
    elif sheet.separator == "," and got > width:
        step = "Decimal commas need semicolons between the columns"
    where = Place(sheet.file, "line", (line,))
    return Fault("a row", f"{width} cells long, as the header is", got, where, step)

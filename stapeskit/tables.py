"""Read CSV tables as laboratories write them, and report every malformed row with its line.

Commas, semicolons or tabs between columns; decimal commas with the latter two; UTF-8 and UTF-16, byte order
marks, any line ends, quoted cells, ``#`` comments and the ``sep=;`` line of spreadsheets are fine.
numpy reads tables whose rows are all alike; the others are read cell by cell, to find what is odd.
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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError

Choose = Callable[[Sequence[str], str], tuple[set[str], set[str]]]
"""Takes the column names and the file's name and returns the number columns and the text columns to read;
raises when the header is not as it must be."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)
_MISSING = re.compile(r"([+-]?nan)?", re.IGNORECASE)
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_DECIMAL_COMMAS = str.maketrans(",.", ".\0")  # a decimal point among them is no number


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
    numbers, texts
        Columns by name, (rows,); numbers are NaN where a cell is empty.
    lines : ndarray, (rows,)
        Line of each row in the file, counted from 1.
    faults : tuple of Fault
        Cells that are no numbers and rows of another length.
    left_out : tuple of int
        Lines of whole rows that begin with ``#``.
    """

    file: str
    numbers: Mapping[str, Array]
    texts: Mapping[str, TextColumn]
    lines: NDArray[np.int64]
    faults: tuple[Fault, ...] = ()
    left_out: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)

    def invalid_rows(self, column: str = "") -> NDArray[np.bool_]:
        """Return which rows (rows,) have a cell, in one column or in any, that was reported as no number."""
        chosen = [fault.where for fault in self.faults if not column or fault.thing == column]
        places = [place.numbers for place in chosen if isinstance(place, Place)]
        return np.isin(self.lines, [line for numbers in places for line in numbers])

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
    table = _read_alike(sheet, numbers, texts) or _read_cells(sheet, numbers, texts)
    if not (len(table) or table.faults):
        want, got, step = "a table with rows below its header", "the header alone", "Export it again"
        if table.left_out:
            got, step = "rows that begin with # alone", "Remove that mark, or rename what begins with it"
        raise StapeskitError.of(sheet.file, want, got, next_step=step)
    return table


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
    full = len(rest.rstrip(b" \t\r\n;,"))  # without empty rows at the end, which spreadsheets write
    last = rest.find(b"\n", full)
    return _Sheet(file, tuple(header), separator, rest[: last + 1 or None] if full else b"", line)


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


def _column_name(cell: str) -> str:
    """Write a column's name in lower case with underscores: ``Re [µm/s]`` is ``re_um_s``."""
    name = cell.strip().strip('"').lower()
    for odd, even in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^2", "2")):
        name = name.replace(odd, even)
    return re.sub(r"[\s()\[\]/_]+", "_", name).strip("_")


def _read_alike(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table | None:
    """Read a table whose rows all have as many plain cells, no number missing; None for another one."""
    text = sheet.body.decode("utf-8")
    lines = text.removesuffix("\n").split("\n")
    alike = {line.count(sheet.separator) for line in lines} == {len(sheet.header) - 1}
    if not alike or '"' in text or "#" in text:
        return None
    commas = sheet.separator != "," and text.count(",") > text.count(".")
    plain = [line.translate(_DECIMAL_COMMAS) for line in lines] if commas else lines
    columns = [place for place, name in enumerate(sheet.header) if name in numbers]

    def cells(rows: list[str], kind: type, wanted: list[int]) -> NDArray[Any]:
        return np.loadtxt(rows, kind, None, sheet.separator, usecols=wanted, ndmin=2, quotechar=None)

    try:
        found = cells(plain, float, columns)
        listed = sorted(texts)
        words: Iterable[NDArray[Any]] = (
            cells(lines, str, [sheet.header.index(name) for name in listed]).T if listed else []
        )
    except ValueError:
        return None
    if len(found) != len(lines):  # a return within a row
        return None
    values = {sheet.header[place]: found[:, k] for k, place in enumerate(columns)}
    encoded = {name: _encode(column) for name, column in zip(listed, words, strict=True)}
    return Table(sheet.file, values, encoded, sheet.line + np.arange(len(lines), dtype=np.int64))


def _encode(column: NDArray[Any]) -> TextColumn:
    """Store every text once, without blanks around it; rows of one text mostly follow each other."""
    begins = np.flatnonzero(np.concatenate([column[:1] == column[:1], column[1:] != column[:-1]]))
    places: dict[str, int] = {"": -1}
    codes = [places.setdefault(text.strip(), len(places) - 1) for text in column[begins].tolist()]
    del places[""]
    length = np.diff(begins, append=len(column))
    return TextColumn(np.repeat(np.array(codes, dtype=np.intp), length), tuple(places))


def _read_cells(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table:
    """Read every row cell by cell; blank lines and comments are passed over."""
    text = io.StringIO(sheet.body.decode("utf-8"), newline="")
    rows = csv.reader(text, delimiter=sheet.separator, skipinitialspace=True)
    width, below = len(sheet.header), sheet.line
    kept: list[list[str]] = []
    lines: list[int] = []
    left_out: list[int] = []
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
        if not any(cells) or cells[0].startswith("#"):
            left_out += [line] if len(cells) >= width > 1 else []
            continue
        if len(cells) < width or any(cells[width:]):
            faults.append(_length_fault(sheet, line, below - line, cells))
        else:
            kept.append(cells)
            lines.append(line)
    columns = {name: [row[sheet.header.index(name)] for row in kept] for name in (*numbers, *texts)}
    comma, point = (sum(mark in cell for name in numbers for cell in columns[name]) for mark in ",.")
    commas, values = sheet.separator != "," and comma > point, {}
    for name in sorted(numbers, key=sheet.header.index):
        values[name] = np.full(len(kept), np.nan)
        for place, cell in enumerate(columns[name]):
            plain = cell.translate(_DECIMAL_COMMAS) if commas else cell
            if _NUMBER.fullmatch(plain):
                values[name][place] = float(plain)
            elif not _MISSING.fullmatch(cell):
                shown = "".join(letter if letter.isprintable() else "?" for letter in cell)
                where = Place(sheet.file, "line", (lines[place],))
                faults.append(Fault(name, "a number", f'"{shown}"', where, _hint(cell, commas)))
    faults.sort(key=lambda fault: fault.where.numbers[0] if isinstance(fault.where, Place) else 0)
    words = {name: _encode(np.array(columns[name], dtype=object)) for name in texts}
    return Table(sheet.file, values, words, np.array(lines, dtype=np.int64), tuple(faults), tuple(left_out))


def _hint(cell: str, commas: bool) -> str:
    if "," in cell and not commas:
        return "Write a point for decimals and nothing between thousands, or semicolons between the columns"
    if "." in cell and commas:
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

"""Read CSV tables as laboratories write them, and report every malformed row with its line.

Commas, semicolons or tabs between columns; decimal commas with the latter two; UTF-8, UTF-16 and Latin-1,
byte order marks, any line ends, quoted cells, ``#`` comments and the ``sep=;`` line of spreadsheets are fine.
numpy reads tables whose rows are all alike; the others are read cell by cell, to find what is odd.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    """The wanted columns of a file by name, (rows,)."""

    file: str
    numbers: Mapping[str, Array]  # NaN where a cell is empty
    texts: Mapping[str, TextColumn]
    lines: NDArray[np.int64]  # of each row in the file, counted from 1
    faults: tuple[Fault, ...] = ()  # cells that are no numbers, and rows of another length
    left_out: tuple[int, ...] = ()  # lines of whole rows that begin with #

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
    """A CSV file whose header was found, and the line at which what is below it begins."""

    file: str
    header: tuple[str, ...]
    separator: str
    body: str
    line: int

    def where(self, line: int) -> Place:
        return Place(self.file, "line", (line,))


def read_table(path: Path, choose: Choose) -> Table:
    """Read the wanted columns of a table.

    A fault that ``choose`` places in line 1 is placed in the line of the header.

    Raises
    ------
    StapeskitError
        The file is missing, empty, no text, or has two columns of one name; and what ``choose`` raises.
    """
    sheet = _open(Path(path))
    try:
        numbers, texts = choose(sheet.header, sheet.file)
    except StapeskitError as error:
        assumed, there = sheet.where(1), sheet.where(sheet.line - 1)
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
    rest, file, line, marked = _text(path), path.name, 1, ""
    while True:
        (head, _, rest), line = rest.partition("\n"), line + 1
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
    full = len(rest.rstrip(" \t\n;,"))  # without empty rows at the end, which spreadsheets write
    body = rest[: rest.find("\n", full) + 1 or None] if full else ""
    return _Sheet(file, tuple(header), separator, body, line)


def _text(path: Path) -> str:
    if not path.is_file():
        raise StapeskitError.of("the table", "an existing CSV file", path, "", "Check its name and folder")
    content = path.read_bytes()
    text, want, got, step = decoded(content), "a header and rows", "", "Export it again"
    if "\0" in text:
        want, got, step = "text", "binary data, or UTF-16 without a byte order mark", "Save it as CSV UTF-8"
    elif not text.strip():
        got = "an empty file"
    if got:
        raise StapeskitError.of("a CSV file", want, got, path.name, step)
    return text


def decoded(content: bytes) -> str:
    """Decode UTF-16 with its mark, UTF-8 or Latin-1, with line feeds at the ends of lines."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = content[: len(content) // 2 * 2].decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _column_name(cell: str) -> str:
    """Write a column's name in lower case with underscores: ``Re [µm/s]`` is ``re_um_s``."""
    name = cell.strip().strip('"').lower()
    for odd, even in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^2", "2")):
        name = name.replace(odd, even)
    return re.sub(r"[\s()\[\]/_]+", "_", name).strip("_")


def _read_alike(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table | None:
    """Read a table whose rows all have as many plain cells, no number missing; None for another one."""
    text = sheet.body.rstrip("\n")
    lines, width = text.split("\n"), len(sheet.header)
    alike = {line.count(sheet.separator) for line in lines} == {width - 1}
    if not alike or '"' in text or "#" in text:
        return None
    commas = sheet.separator != "," and text.count(",") > text.count(".")
    plain = [line.translate(_DECIMAL_COMMAS) for line in lines] if commas else lines
    found = sheet.line + np.arange(len(lines), dtype=np.int64)

    def columns(rows: list[str], kind: type, wanted: set[str]) -> dict[str, NDArray[Any]]:
        places = [place for place, name in enumerate(sheet.header) if name in wanted]
        read: NDArray[Any] = np.loadtxt(
            rows, kind, None, sheet.separator, usecols=places, ndmin=2, quotechar=None
        )
        if len(read) != len(rows):
            raise ValueError("rows that are empty")
        return {sheet.header[place]: column for place, column in zip(places, read.T, strict=True)}

    try:
        values = columns(plain, float, numbers) if numbers else {}
        words = columns(lines, str, texts) if texts else {}
    except ValueError:
        return None
    return Table(sheet.file, values, {name: _encode(words[name].tolist()) for name in words}, found)


def _read_cells(sheet: _Sheet, numbers: set[str], texts: set[str]) -> Table:
    """Read every row cell by cell; blank lines and comments are passed over."""
    rows = csv.reader(io.StringIO(sheet.body, newline=""), delimiter=sheet.separator, skipinitialspace=True)
    width, below, faults = len(sheet.header), sheet.line, list[Fault]()
    kept, lines, left_out = list[list[str]](), list[int](), list[int]()
    while True:
        line = below
        try:
            row = next(rows)
        except StopIteration:
            break
        except csv.Error as error:
            want = "text that can be split into cells"
            faults.append(Fault("a row", want, error, sheet.where(line), "Correct it"))
            break
        below = sheet.line + rows.line_num
        cells = [cell.strip() for cell in row]
        if not "".join(cells).strip(",;") or cells[0].startswith("#"):
            left_out += [line] if len(cells) >= width > 1 and cells[0].startswith("#") else []
        elif len(cells) < width or any(cells[width:]):
            faults.append(_length_fault(sheet, line, below - line, cells))
        else:
            kept.append(cells)
            lines.append(line)
    columns = {name: [row[sheet.header.index(name)] for row in kept] for name in (*numbers, *texts)}
    joined = "".join(cell for name in numbers for cell in columns[name])
    commas, values = sheet.separator != "," and joined.count(",") > joined.count("."), {}
    for name in sorted(numbers, key=sheet.header.index):
        values[name] = np.full(len(kept), np.nan)
        for place, cell in enumerate(columns[name]):
            plain = cell.translate(_DECIMAL_COMMAS) if commas else cell
            if _NUMBER.fullmatch(plain):
                values[name][place] = float(plain)
            elif not _MISSING.fullmatch(cell):
                shown = "".join(letter if letter.isprintable() else "?" for letter in cell)
                where = sheet.where(lines[place])
                faults.append(Fault(name, "a number", f'"{shown}"', where, _hint(cell, commas)))
    faults.sort(key=lambda fault: fault.where.numbers[0] if isinstance(fault.where, Place) else 0)
    words = {name: _encode(columns[name]) for name in texts}
    return Table(sheet.file, values, words, np.array(lines, dtype=np.int64), tuple(faults), tuple(left_out))


def _encode(cells: Sequence[str]) -> TextColumn:
    """Store every text once, without blanks around it."""
    places = {"": -1}
    codes = {cell: places.setdefault(cell.strip(), len(places) - 1) for cell in dict.fromkeys(cells)}
    del places[""]
    return TextColumn(np.array([codes[cell] for cell in cells], dtype=np.intp), tuple(places))


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
    return Fault("a row", f"{width} cells long, as the header is", got, sheet.where(line), step)

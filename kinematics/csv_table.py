"""Read a CSV table fast, and name every malformed row when it is not as it should be.

Commas, semicolons or tabs between columns; decimal commas with the latter two; BOM and CRLF are fine.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError, sentence

Array = NDArray[np.float64]
_MISSING = ("", "nan", "NaN", "NAN", "Nan", "NA", "N/A", "n/a", "null", "-nan")


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
    texts : mapping of str to TextColumn
    lines : ndarray, (rows,)
        Line of each row in the file, counted from 1 with the header.
    faults : tuple of str
        Sentences on cells that are no numbers and rows of wrong length.
    """

    file: str
    numbers: Mapping[str, Array]
    texts: Mapping[str, TextColumn]
    lines: NDArray[np.int64]
    faults: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def told(self) -> set[str]:
        """Places (file and line) of the rows with a cell that is no number."""
        return {fault.rsplit("(", 1)[-1].split(")")[0] for fault in self.faults}

    def where(self, row: int, column: str = "") -> str:
        """Return the place of a row for a message."""
        return f"{self.file}, line {int(self.lines[row])}" + (f", {column}" if column else "")


def read_table(path: Path, choose: Callable[[Sequence[str], str], tuple[set[str], set[str]]]) -> Table:
    """Read a table.

    Parameters
    ----------
    path : Path
    choose : callable
        Takes the column names and the file's name, returns the names of the number columns and of the text
        columns to read, and raises when the header is not as it must be.

    Raises
    ------
    KinematicsError
        The file is missing, empty, no text in UTF-8, or has two columns of one name.
    """
    path = Path(path)
    data = _bytes(path)
    head, _, body = data.partition(b"\n")
    header_text = _decoded(head, path.name)
    separator = _separator(header_text)
    header = [name.strip().lower() for name in next(csv.reader([header_text], delimiter=separator))]
    while header and not header[-1]:
        header.pop()
    twice = sorted({name for name in header if name and header.count(name) > 1})
    if twice:
        raise KinematicsError(
            sentence(
                "column names",
                "different",
                ", ".join(twice) + " twice",
                f"{path.name}, line 1",
                "Rename or remove one of them",
            )
        )
    numbers, texts = choose(header, path.name)
    if not body[:4096].strip() and not body.strip():
        raise KinematicsError(
            sentence(
                path.name, "a table with rows below its header", "the header alone", "", "Export it again"
            )
        )
    decimal = "," if separator != "," and b"," in body else "."
    table = _fast(path.name, body, header, separator, decimal, numbers, texts)
    return table or _slow(path.name, _decoded(data, path.name), header, separator, decimal, numbers, texts)


def _bytes(path: Path) -> bytes:
    if not path.is_file():
        raise KinematicsError(
            sentence("the table", "an existing CSV file", path, "", "Check its name and folder")
        )
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\x00" in data[:4096]:
        raise KinematicsError(
            sentence(
                "a CSV file", "text in UTF-8", "UTF-16 or binary data", path.name, "Save it as CSV UTF-8"
            )
        )
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data and b"\r" in data:
        data = data.replace(b"\r", b"\n")
    if not data.strip():
        raise KinematicsError(
            sentence("a CSV file", "a header and rows", "an empty file", path.name, "Export it again")
        )
    return data


def _decoded(data: bytes, name: str) -> str:
    try:
        return data.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError as fault:
        line = data[: fault.start].count(b"\n") + 1
        raise KinematicsError(
            sentence(
                "a CSV file", "text in UTF-8", "another encoding", f"{name}, line {line}", "Save it as UTF-8"
            )
        ) from fault


def _separator(header: str) -> str:
    return max((",", ";", "\t"), key=lambda mark: (header.count(mark), mark == ","))


def _fast(
    name: str,
    body: bytes,
    header: list[str],
    separator: str,
    decimal: str,
    numbers: set[str],
    texts: set[str],
) -> Table | None:
    """Read with pandas' C parser; None when a row is not as the header says."""
    rows = body.count(b"\n") + (not body.endswith(b"\n"))
    if b'"' in body or body.count(separator.encode()) != rows * (len(header) - 1):
        return None
    import pandas as pd

    kinds: dict[str, Any] = dict.fromkeys(numbers, np.float64) | dict.fromkeys(texts, "category")
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            sep=separator,
            decimal=decimal,
            names=header,
            header=None,
            usecols=lambda column: column in kinds,
            dtype=kinds,
            engine="c",
            keep_default_na=False,
            na_values={column: list(_MISSING) for column in numbers},
            skip_blank_lines=False,
            skipinitialspace=True,
            quoting=csv.QUOTE_NONE,
            index_col=False,
            low_memory=False,
        )
    except ValueError:
        return None
    if len(frame) != rows:
        return None
    columns = {column: np.ascontiguousarray(frame[column].to_numpy()) for column in numbers}
    words = {column: _text_column(frame[column]) for column in texts}
    return _without_empty(Table(name, columns, words, np.arange(2, len(frame) + 2)))


def _text_column(series: Any) -> TextColumn:
    codes = np.asarray(series.cat.codes, dtype=np.intp)
    names = [str(name).strip() for name in series.cat.categories]
    return _merged(codes, names)


def _merged(codes: NDArray[np.intp], names: list[str]) -> TextColumn:
    """Number texts in the order of first appearance, the empty one as -1."""
    kept: dict[str, int] = {}
    used, first = np.unique(codes[codes >= 0], return_index=True)
    for code in used[np.argsort(first)]:
        if names[code]:
            kept.setdefault(names[code], len(kept))
    new = np.full(len(names) + 1, -1, dtype=np.intp)
    for code, word in enumerate(names):
        new[code] = kept.get(word, -1)
    return TextColumn(new[codes], tuple(kept))


def _slow(
    name: str, text: str, header: list[str], separator: str, decimal: str, numbers: set[str], texts: set[str]
) -> Table:
    """Read cell by cell and say what is wrong where."""
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
    next(reader)
    cells: dict[str, list[str]] = {column: [] for column in (*numbers, *texts)}
    lines: list[int] = []
    faults: list[str] = []
    places = [(column, header.index(column)) for column in cells]
    for row in reader:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header) and not (
            len(row) > len(header) and not "".join(row[len(header) :]).strip()
        ):
            faults.append(_length_fault(name, reader.line_num, len(row), len(header), separator))
            continue
        lines.append(reader.line_num)
        for column, place in places:
            cells[column].append(row[place].strip())
    values: dict[str, Array] = {}
    for column in numbers:
        values[column] = _parsed(cells[column], column, decimal, name, lines, faults)
    words = {}
    for column in texts:
        unique = {word: place for place, word in enumerate(dict.fromkeys(cells[column]))}
        codes = np.array([unique[word] for word in cells[column]], dtype=np.intp)
        words[column] = _merged(codes, list(unique))
    return Table(name, values, words, np.array(lines, dtype=np.int64), tuple(faults))


def _parsed(
    cells: list[str], column: str, decimal: str, name: str, lines: list[int], faults: list[str]
) -> Array:
    values = np.full(len(cells), np.nan)
    for place, cell in enumerate(cells):
        if cell in _MISSING:
            continue
        try:
            if "_" in cell or (decimal == "," and "." in cell and "," in cell):
                raise ValueError
            values[place] = float(cell.replace(",", ".") if decimal == "," else cell)
        except ValueError:
            hint = "Write a plain number such as 1000 or 1e-6"
            if "," in cell:
                hint = "Write a point for the decimals, or semicolons between the columns"
            faults.append(sentence(column, "a number", f'"{cell}"', f"{name}, line {lines[place]}", hint))
    return values


def _length_fault(name: str, line: int, got: int, wanted: int, separator: str) -> str:
    hint = "Give every row one cell per column, empty where a value is missing"
    if separator == "," and got > wanted:
        hint = "Decimal commas need semicolons between the columns"
    return sentence("a row", f"{wanted} cells long, as the header is", f"{got}", f"{name}, line {line}", hint)


def _without_empty(table: Table) -> Table:
    """Drop rows in which nothing stands."""
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
    )

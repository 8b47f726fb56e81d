"""The bytes of a CSV file: encoding, line ends, separator, and the line of its header."""

from __future__ import annotations

import csv
import mmap
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from legacy.stapeskit.faults import Fault, Place, StapeskitError

_UTF16 = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}
_MARK = b"\xef\xbb\xbf"
# Bytes in which the encoding is recognised; files above 8 MB are read in pieces.
_HEAD = 1 << 16
_LARGE = 8 << 20
_BLANK = b" \t\r;,"


@dataclass(frozen=True)
class Sheet:
    """A CSV file whose header was found.

    Attributes
    ----------
    file : str
        Name of the file, for messages.
    data : bytes or mmap
        UTF-8, without byte order mark, lines ended by ``\\n`` or ``\\r\\n``.
    header : tuple of str
        Column names: lower case, blanks and brackets as underscores (``x (mm)`` is ``x_mm``).
    separator : str
        ``,``, ``;`` or tab.
    start : int
        Offset of the first byte below the header.
    stop : int
        Offset behind the last line that holds something.
    line : int
        Line of the file, from 1, that begins at ``start``.
    """

    file: str
    data: bytes | mmap.mmap
    header: tuple[str, ...]
    separator: str
    start: int
    stop: int
    line: int

    @property
    def header_place(self) -> Place:
        """Return file and line of the header."""
        return Place(self.file, "line", (self.line - 1,))


def open_sheet(path: Path) -> Sheet:
    """Read a file and find its header.

    Blank lines, lines that begin with ``#`` and the line ``sep=;`` of spreadsheets may precede it.

    Raises
    ------
    StapeskitError
        The file is missing, empty, not in UTF-8 or UTF-16, or has two columns of one name.
    """
    path = Path(path)
    data = _bytes(path)
    start, line, separator = 0, 1, ""
    while True:
        if start >= len(data):
            raise _empty(path.name, "no header")
        end = data.find(b"\n", start)
        end = len(data) if end < 0 else end
        text = decoded(data[start:end], path.name, line)
        start, line = end + 1, line + 1
        marked = re.fullmatch(r'\s*"?sep=(.)"?[,;\s]*', text, re.IGNORECASE)
        if marked:
            separator = marked.group(1)
        elif text.strip() and not text.lstrip().startswith("#"):
            break
    separator = separator if separator in (",", ";", "\t") and separator in text else _separator(text)
    try:
        header = [_normalise_name(name) for name in next(csv.reader([text], delimiter=separator))]
    except csv.Error as fault:
        where = Place(path.name, "line", (line - 1,))
        step = "End lines with a line feed, and put quotes around whole names only"
        raise StapeskitError.of(
            "the header", "one line of names", str(fault).split(" - ")[0], where, step
        ) from fault
    while header and not header[-1]:
        header.pop()
    if sum(_is_number(name) for name in header) > len(header) // 2:
        where = Place(path.name, "line", (line - 1,))
        step = "Put the names of the columns above the rows"
        raise StapeskitError.of("the first line", "the header", "numbers", where, step)
    twice = sorted(name for name, times in Counter(header).items() if name and times > 1)
    if twice:
        got = ", ".join(twice) + " twice"
        where = Place(path.name, "line", (line - 1,))
        raise StapeskitError.of("column names", "different", got, where, "Rename or remove one of them")
    return Sheet(path.name, data, tuple(header), separator, start, _end(data), line)


def decoded(data: bytes, name: str, line: int = 1) -> str:
    """Decode UTF-8 that begins at a line of a file.

    Raises
    ------
    StapeskitError
        Names the line that holds other bytes.
    """
    try:
        return data.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError as fault:
        where = Place(name, "line", (line + data.count(bytes([10]), 0, fault.start),))
        raise StapeskitError.of(
            "a CSV file", "text in UTF-8", "another encoding", where, "Save it as UTF-8"
        ) from fault


def no_rows(name: str, got: str = "the header alone") -> Fault:
    """Return the fault of a table without rows."""
    return Fault(name, "a table with rows below its header", got, "", "Export it again")


def _empty(name: str, got: str) -> StapeskitError:
    return StapeskitError.of("a CSV file", "a header and rows", got, name, "Export it again")


def _bytes(path: Path) -> bytes | mmap.mmap:
    if not path.is_file():
        raise StapeskitError.of("the table", "an existing CSV file", path, "", "Check its name and folder")
    if path.stat().st_size > _LARGE:
        mapped = _map(path)
        if mapped is not None:
            return mapped
    data = path.read_bytes()
    if data[:2] in _UTF16:
        try:
            data = data[2:].decode(_UTF16[data[:2]]).encode("utf-8")
        except UnicodeDecodeError as fault:
            raise no_text(path.name) from fault
    if b"\x00" in data:
        raise no_text(path.name)
    data = data.removeprefix(_MARK)
    if b"\n" not in data and b"\r" in data:
        data = data.replace(b"\r", b"\n")
    if not data or data.isspace():
        raise _empty(path.name, "an empty file")
    return data


def _map(path: Path) -> mmap.mmap | None:
    """Map a large file of plain UTF-8 into memory; None for one that must be converted first."""
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    head = data[:_HEAD]
    plain = not head.startswith((*_UTF16, _MARK)) and b"\n" in head and b"\x00" not in head
    if plain and not head.isspace():
        return data
    data.close()
    return None


def no_text(name: str) -> StapeskitError:
    """Return the error on a file that is no text."""
    got = "UTF-16 or binary data without a byte order mark"
    return StapeskitError.of("a CSV file", "text in UTF-8", got, name, "Save it as CSV UTF-8")


def _separator(header: str) -> str:
    bare = re.sub(r'"[^"]*"', "", header)
    return max((",", ";", "\t"), key=lambda mark: (bare.count(mark), mark == ","))


def _normalise_name(name: str) -> str:
    """Write a column's name in lower case with underscores: ``Re [µm/s]`` is ``re_um_s``."""
    name = name.strip().strip('"').lower()
    for odd, even in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^2", "2")):
        name = name.replace(odd, even)
    return re.sub(r"[\s()\[\]/_]+", "_", name).strip("_")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _end(data: bytes | mmap.mmap) -> int:
    """Return the offset behind the last line with more in it than separators."""
    stop = len(data)
    while stop:
        begin = data.rfind(b"\n", 0, stop - 1) + 1
        if data[begin:stop].rstrip(b"\n").strip(_BLANK):
            break
        stop = begin
    return stop

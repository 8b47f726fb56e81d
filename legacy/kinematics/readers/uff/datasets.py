"""The datasets of a universal file: where each begins and ends, text or binary, whole or cut short."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.text import lines_of, shown
from legacy.stapeskit.faults import Fault, collect_faults, raise_all

_RULE = re.compile(rb"^ {4}-1[ \t]*\r?$", re.MULTILINE)
_FIRST = re.compile(rb"[ \t]*\d{1,6}(?:[ \t]*|[bB][ \t]+\d[^\r\n]*)\r?\n")
_LOOSE = re.compile(rb"[ \t]*-1[ \t]*\r?\n")
_NUMBER = re.compile(rb"[ \t]*(\d{1,6})(b?)([^\r\n]*)\r?\n", re.IGNORECASE)
_BINARY_TAIL = re.compile(rb"\r?\n? {4}-1[ \t]*(\r?\n|$)")
# Records before the data of dataset 58 (SDRC universal file format, dataset 58).
_HEADER_LINES = 11
CUT = "It looks cut short: export or copy it again"


@dataclass(frozen=True)
class Dataset:
    """One dataset.

    Attributes
    ----------
    number : int
        Type, 58 for functions.
    place : int
        Which one of the file it is, from 1.
    lines : tuple of str
        The text below the identifier line; of a binary dataset its header alone.
    data : bytes
        The numbers of a function: text, or binary from the end of the header on.
    line : int
        Of the identifier, from 1.
    """

    number: int
    place: int
    lines: tuple[str, ...]
    data: bytes = b""
    binary: bool = False
    big_endian: bool = False
    line: int = 0

    def at(self, file: str, record: int) -> str:
        """Return the place of a line below the identifier, from 1, for messages.

        Lines of a file with binary parts cannot be counted: there it is the record of the dataset.
        """
        counted = f"record {record}" if self.binary else f"line {self.line + record}"
        return f"{file}, dataset {self.place}, {counted}"


def looks_like_uff(head: bytes) -> bool:
    """Return whether a file begins as a universal file."""
    match = _LOOSE.match(head.lstrip(b"\r\n"))
    return match is not None and _NUMBER.match(head.lstrip(b"\r\n"), match.end()) is not None


def plain_content(content: bytes) -> bytes:
    """Return a text in UTF-16 with its mark, or with carriage returns alone, as the format has it."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", errors="replace").encode("latin-1", errors="replace")
    content = content.removeprefix(b"\xef\xbb\xbf")
    return content if b"\n" in content[:4096] else content.replace(b"\r", b"\n")


def datasets(content: bytes, file: str, faults: list[Fault] | None = None) -> Iterator[Dataset]:
    """Go through the datasets of a universal file.

    Parameters
    ----------
    faults : list of str, optional
        What is wrong is added to it, and the reading goes on behind it; without it the faults are raised at
        the end.

    Notes
    -----
    Universal file format of SDRC as kept by the University of Cincinnati: records of 80 characters, each
    dataset between two lines that hold -1 in columns 5 and 6. In 58b the values follow 11 lines of header as
    IEEE numbers, and only their count shows where they end: bytes that look like a line of -1 may be
    among them.

    Raises
    ------
    KinematicsError
        A dataset has no end, no number, or a binary one holds fewer bytes than its header says.
    """
    collected = [] if faults is None else faults
    position, place, counted, line = 0, 0, 0, 1
    while (start := _RULE.search(content, position)) is not None:
        place += 1
        line += content.count(b"\n", counted, start.end()) + 1
        counted = min(start.end() + 1, len(content))
        position = counted
        with collect_faults(collected):
            dataset, position = _dataset(content, counted, (place, line), file)
            yield dataset
            continue
        position = _next_start(content, position)
    tail = content[position:].strip(b" \t\r\n\x00\x1a")
    if tail and not collected:
        got = shown(lines_of(tail.decode("latin-1"))[0])
        collected.append(Fault("the last line of a universal file", "-1", got, file, CUT))
    if faults is None:
        raise_all(KinematicsError, collected)


def _next_start(content: bytes, position: int) -> int:
    """Return the offset of the next line of -1 before the number of a dataset; else the end."""
    while (rule := _RULE.search(content, position)) is not None:
        if _FIRST.match(content, min(rule.end() + 1, len(content))):
            return rule.start()
        position = min(rule.end() + 1, len(content))
        if rule.end() == len(content):
            break
    return len(content)


def _dataset(content: bytes, start: int, place: tuple[int, int], file: str) -> tuple[Dataset, int]:
    """Read the dataset whose number is at ``start``; return it and the offset from which to seek the next."""
    where = f"{file}, dataset {place[0]}, line {place[1]}"
    number = _NUMBER.match(content, start)
    if number is None:
        rest = content[start : start + 80].strip().split(b"\n")[0][:40].decode("latin-1").strip()
        got = shown(rest) if rest else "the end of the file"
        raise KinematicsError.of("the line after -1", "the number of a dataset", got, where, CUT)
    if number[2] and int(number[1]) == 58:
        return _binary(content, number, place, f"{file}, dataset {place[0]}")
    end = _RULE.search(content, number.end())
    follows = None if end is None else _FIRST.match(content, min(end.end() + 1, len(content)))
    if end is None or follows is not None:
        got = "the end of the file" if end is None else "the beginning of the next one"
        raise KinematicsError.of("a dataset", "closed by a line that holds -1", got, where, CUT)
    return _text(int(number[1]), place, content[number.end() : end.start()]), end.end()


def _text(number: int, place: tuple[int, int], body: bytes) -> Dataset:
    if number != 58:
        return Dataset(number, place[0], tuple(lines_of(body.decode("latin-1"))), line=place[1])
    head, data = _take_lines(body, 0, _HEADER_LINES)
    return Dataset(58, place[0], head, body[data:], line=place[1])


def _take_lines(content: bytes, start: int, count: int) -> tuple[tuple[str, ...], int]:
    """Return ``count`` lines from ``start`` on, and where the next one begins."""
    lines, position = [], start
    for _ in range(count):
        end = content.find(b"\n", position)
        if end < 0:
            break
        lines.append(content[position:end].decode("latin-1").rstrip("\r"))
        position = end + 1
    return tuple(lines), position


def _binary(
    content: bytes, number: re.Match[bytes], place: tuple[int, int], where: str
) -> tuple[Dataset, int]:
    """Read a 58b dataset: header as text, values as bytes counted by the header."""
    fields = number[3].split()
    if len(fields) < 4 or not all(re.fullmatch(rb"\d+", field) for field in fields[:4]):
        got = shown(number[0].decode("latin-1"))
        raise KinematicsError.of(
            "the line of a dataset 58b", "byte order, format, lines and bytes", got, where
        )
    order, form, count, size = (int(field) for field in fields[:4])
    faults = []
    step = "Export the file again, as ASCII if there is a choice"
    if order not in (1, 2):
        expected = "1 (little endian) or 2 (big endian)"
        faults.append(Fault("the byte order of a dataset 58b", expected, order, where, step))
    if form != 2:
        thing = "the floating point format of a dataset 58b"
        faults.append(Fault(thing, "2 (IEEE 754)", form, where, step))
    if not _HEADER_LINES <= count <= 100:
        faults.append(Fault("the header of a dataset 58b", "11 lines long", f"{count} lines", where, step))
    raise_all(KinematicsError, faults)
    head, start = _take_lines(content, number.end(), count)
    if len(head) < count:
        raise KinematicsError.of("a dataset 58b", f"of {count} lines of header", len(head), where, CUT)
    needed = values_size(head, f"{where}, record 7")
    # The stated number of bytes only decides between possible ones: some writers state half of it.
    for length in sorted(needed, key=lambda length: (length != size, -length)):
        end = start + length
        tail = _BINARY_TAIL.match(content, end)
        if tail is not None:
            dataset = Dataset(58, place[0], head, content[start:end], True, order == 2, place[1])
            return dataset, tail.end()
    got = f"{len(content) - start} bytes up to the end of the file"
    if len(content) - start >= min(needed):
        got = f"no line of -1 behind so many, and {size} bytes by its first line"
    expected = f"of {' or '.join(map(str, needed))} bytes of values, as its header says"
    raise KinematicsError.of("a dataset 58b", expected, got, where, CUT)


def values_size(head: tuple[str, ...], where: str) -> tuple[int, ...]:
    """Return the possible sizes of the values of a 58b, bytes: two where double values have uneven steps.

    Notes
    -----
    The format calls the abscissa single precision always; writers differ.
    """
    kind, count, even = data_form(head, where)
    single = kind in (2, 5)
    width = (4 if single else 8) * (2 if kind in (5, 6) else 1)
    if even:
        return (count * width,)
    return (count * (width + 4),) if single else (count * (width + 8), count * (width + 4))


def data_form(head: tuple[str, ...], where: str) -> tuple[int, int, bool]:
    """Return type of the values (2, 4, 5, 6), their number, and whether the abscissa is even.

    Raises
    ------
    KinematicsError
        The record is cut short or holds an impossible value.
    """
    record = head[6] if len(head) > 6 else ""
    fields = [record[0:10], record[10:20], record[20:30]]
    if not all(re.fullmatch(r"\s*\d+\s*", field) for field in fields):
        fields = record.split()[:3]
    if len(fields) < 3 or not all(re.fullmatch(r"\s*\d+\s*", field) for field in fields):
        step = "Export it again"
        raise KinematicsError.of(
            "record 7 of a function", "type, number and spacing", shown(record), where, step
        )
    kind, count, spacing = (int(field.strip()) for field in fields)
    if kind not in (2, 4, 5, 6) or spacing not in (0, 1) or count < 1:
        got = f"type {kind}, {count} values, spacing {spacing}"
        expected = "of type 2, 4, 5 or 6, with at least one value and spacing 0 or 1"
        raise KinematicsError.of("the data of a function", expected, got, where, "Export it again")
    return kind, count, spacing == 1

"""Text of measuring programs and spreadsheets: encodings, decimal commas, rows of numbers."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place

UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
CUT = "It looks cut short: export or copy it again"

_NUMBER = re.compile(
    r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE
)
_WITH_COMMA = re.compile(r"[+-]?\d[\d.,]*")
_LONGEST_NUMBER = 400  # letters; longer ones are no numbers of a measurement


def decoded(content: bytes) -> str:
    """Decode UTF-16 with its mark, UTF-8 or Latin-1, with line feeds at the ends of lines."""
    if content[:2] in UTF16_MARKS:
        text = content[: len(content) // 2 * 2].decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: Path) -> str:
    """Return the text of a file; see `decoded`."""
    return decoded(Path(path).read_bytes())


def shown(text: str, most: int = 60) -> str:
    """Return text from a file as messages quote it: printable and short."""
    printable = "".join(letter if letter.isprintable() else "?" for letter in text.strip())
    return printable if len(printable) <= most else f"{printable[:most]}..."


def plain_name(name: str) -> str:
    """Return the name of a point or body; ``1.0``, which a spreadsheet made of ``1``, is ``1``."""
    name = name.strip()
    match = re.fullmatch(r"(\d+)[.,]0+", name)
    return match[1] if match else name


def number_of(cell: str, comma: bool = True) -> float | None:
    """Read a number with a decimal point, or comma where allowed: NaN of an empty cell, None of text."""
    cell = cell.strip()
    if not cell:
        return np.nan
    if len(cell) > _LONGEST_NUMBER or not _NUMBER.fullmatch(cell) or ("," in cell and not comma):
        return None
    return float(cell.replace(",", "."))


def cells_of(line: str, separator: str) -> list[str]:
    """Split a line; a blank as separator stands for any number of them."""
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def is_row(cells: Sequence[str]) -> bool:
    """Return whether at least half of two cells or more are numbers."""
    numbers = sum(bool(cell) and number_of(cell) is not None for cell in cells)
    return len(cells) > 1 and 2 * numbers >= len(cells)


def read_rows(
    lines: Sequence[str], first: int, separator: str, names: Sequence[str], file: str, faults: list[Fault]
) -> Array:
    """Read rows of numbers.

    Parameters
    ----------
    lines : sequence of str
        The rows; blank ones are left out.
    first : int
        Number of the first of them in the file, for messages.
    separator : str
        Tab, semicolon, comma or blank; all but the comma allow decimal commas.
    names : sequence of str
        One a column.
    faults : list of Fault
        Rows of another length and cells that are no number are added to it.

    Returns
    -------
    ndarray, (rows, columns)
        Of the sound rows.
    """
    joined = "".join(lines)
    comma = separator != "," and "," in joined and "." not in joined
    numbers = _all_at_once(lines, separator, comma, len(names))
    if numbers is not None:
        return numbers
    sound = []
    for place, line in enumerate(lines, first):
        if not line.strip():
            continue
        cells = cells_of(line, separator)
        cells = cells[:-1] if len(cells) == len(names) + 1 and not cells[-1] else cells
        values = [number_of(cell, comma) for cell in cells]
        where = Place(file, "line", (place,))
        if len(values) != len(names):
            faults.append(Fault("a row", f"of {len(names)} numbers", len(values), where, CUT))
        elif None in values:
            bad = values.index(None)
            step = "Correct the cell, or empty it where the value is missing"
            if _WITH_COMMA.fullmatch(cells[bad]):
                step = "Write decimal points alone, without separators of thousands"
            faults.append(Fault(f"column {shown(names[bad])}", "a number", shown(cells[bad]), where, step))
        else:
            sound.append([value for value in values if value is not None])
    return np.array(sound, dtype=float).reshape(-1, len(names))


def _all_at_once(lines: Sequence[str], separator: str, comma: bool, columns: int) -> Array | None:
    """Read rows by numpy, exactly rounded; None where one has another length or no plain number."""
    text = "\n".join(lines)
    if not text.strip() or '"' in text or "_" in text:
        return None
    text = text.replace(",", ".") if comma else text
    delimiter = None if separator == " " else separator
    try:
        with np.errstate(over="ignore"):
            numbers = np.loadtxt(io.StringIO(text), delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return numbers if numbers.shape[1] == columns else None

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

CUT = "It looks cut short: export or copy it again"

_NUMBER = re.compile(
    r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE
)
_LONGEST_NUMBER = 400  # letters; longer ones are no numbers of a measurement


def decoded(content: bytes) -> str:
    """Decode UTF-16 with its mark, UTF-8 or Latin-1, with line feeds at the ends of lines."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
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
    match = re.fullmatch(r"(\d+)[.,]0+", name.strip())
    return match[1] if match else name.strip()


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
    try:
        cells = next(csv.reader([line], delimiter=separator), []) if '"' in line else line.split(separator)
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def is_row(cells: Sequence[str]) -> bool:
    """Return whether at least half of two cells or more are numbers."""
    numbers = sum(bool(cell) and number_of(cell) is not None for cell in cells)
    return len(cells) > 1 and 2 * numbers >= len(cells)


def read_rows(
    lines: Sequence[str], first: int, separator: str, names: Sequence[str], file: str, faults: list[Fault]
) -> Array:
    """Read rows of numbers; rows of another length and cells that are no number are added to the faults.

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

    Returns
    -------
    ndarray, (rows, columns)
        Of the sound rows.
    """
    joined = "\n".join(lines)
    comma = separator != "," and "," in joined and "." not in joined
    if joined.strip() and '"' not in joined and "_" not in joined:
        try:  # by numpy, which knows no empty cells
            text = io.StringIO(joined.replace(",", ".") if comma else joined)
            delimiter = None if separator == " " else separator
            with np.errstate(over="ignore"):
                numbers = np.loadtxt(text, delimiter=delimiter, comments=None, ndmin=2)
            if numbers.shape[1] == len(names):
                return numbers
        except ValueError:
            pass
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
            step = "Write a plain number without separators of thousands, or leave the cell empty"
            faults.append(Fault(f"column {shown(names[bad])}", "a number", shown(cells[bad]), where, step))
        else:
            sound.append([value for value in values if value is not None])
    return np.array(sound, dtype=float).reshape(-1, len(names))

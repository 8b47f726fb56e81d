"""Text exports of scanning vibrometers: blocks of ``Name: value`` lines, a line of column names, numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError, raise_all, sentence
from kinematics.readers.recording import scaled
from kinematics.readers.text import lines_of, shown
from kinematics.readers.unit_labels import MotionUnit, is_none, motion_unit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
T = TypeVar("T")
_SUFFIXES = (".txt", ".asc", ".csv", ".dat")
_FIELD = re.compile(r"^\s*([^\t:]{2,40}?)\s*:\s*(.*)$")
_PARTS = {
    "re": re.compile(r"^(real|re|realteil|réel|réelle)\b", re.IGNORECASE),
    "im": re.compile(r"^(imag|imaginary|im|imaginär|imaginärteil|imaginaire)\b", re.IGNORECASE),
    "amp": re.compile(r"^(magnitude|amplitude|betrag|mag|module)\b", re.IGNORECASE),
    "phase": re.compile(r"^phase\b", re.IGNORECASE),
}
_AXIS = re.compile(r"(?:^|[\s(_])([+-]?)([XYZ])\s*$", re.IGNORECASE)
_UNIT = re.compile(r"\[([^\]]*)\]")
_MAX_FILE = 1 << 30


@dataclass(frozen=True)
class Block:
    """One table of an export.

    Attributes
    ----------
    file : str
    line : int
        Of the column names, from 1.
    fields : mapping of str to str
        The lines above it, names in lower case.
    columns, units : tuple of str
        Names without units, and the units.
    numbers : ndarray, (rows, columns)
    """

    file: str
    line: int
    fields: Mapping[str, str]
    columns: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array

    @property
    def where(self) -> str:
        """Place for messages."""
        return f"{self.file}, line {self.line}"


def decoded(content: bytes) -> str:
    """Decode UTF-8, UTF-16 with its mark, or Latin-1."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def fields_of(text: str) -> dict[str, str]:
    """Return the ``Name: value`` lines at the top of a text, names in lower case."""
    found = {}
    for line in lines_of(text)[:40]:
        match = _FIELD.match(line)
        if match is not None:
            found[match[1].lower()] = match[2].strip()
        elif _is_numbers(line):
            break
    return found


def read_blocks(path: Path, read: Callable[[Block], T], deep: bool = False) -> list[T]:
    """Read every table of a file, or of the text exports in a folder.

    Parameters
    ----------
    path : Path
    read : callable
        What to make of one table.
    deep : bool
        Whether folders of the folder count.

    Raises
    ------
    KinematicsError
        The faults of all files together, or there is no text export.
    """
    files = [path]
    if path.is_dir():
        found = path.rglob("*") if deep else path.iterdir()
        files = sorted(one for one in found if one.is_file() and one.suffix.lower() in _SUFFIXES)
    made: list[T] = []
    faults: list[str] = []
    for file in files:
        try:
            made += [read(block) for block in blocks(file)]
        except KinematicsError as fault:
            faults.append(str(fault))
    raise_all(KinematicsError, faults)
    if not made:
        step = "Give the folder of the exported text files"
        raise KinematicsError(sentence("the folder", "one with text exports", "none", path.name, step))
    return made


def blocks(path: Path) -> list[Block]:
    """Read every table of a file.

    Raises
    ------
    KinematicsError
        The file is empty, has no table, or a row of it is not as long as its header or holds no number.
    """
    if path.stat().st_size > _MAX_FILE:
        raise KinematicsError(sentence("a text export", "smaller than 1 GB", "a larger one", path.name))
    lines = lines_of(decoded(path.read_bytes()))
    found: list[Block] = []
    start = 0
    while (made := _block(lines, start, path.name)) is not None:
        block, start = made
        found.append(block)
    if not found:
        raise KinematicsError(
            sentence(
                "a text export",
                "a header and a table of numbers",
                "no table",
                path.name,
                "Export it again as ASCII",
            )
        )
    return found


def _block(lines: list[str], start: int, file: str) -> tuple[Block, int] | None:
    """Read the table that follows, and say where the next one may begin."""
    first = next((n for n in range(start, len(lines)) if _is_numbers(lines[n])), None)
    if first is None:
        return None
    fields, names, units, named = {}, "", "", start
    for number in range(start, first):
        line = lines[number]
        match = _FIELD.match(line)
        if match is not None and "\t" not in match[1]:
            fields[match[1].lower()] = match[2].strip()
        elif line.strip():
            if names and _only_units(line):
                units = line
            else:
                names, units, named = line, "", number
    last = first
    while last < len(lines) and _is_numbers(lines[last]):
        last += 1
    if last < len(lines) and lines[last].strip() and _FIELD.match(lines[last]) is None:
        step = "It may be cut short: export it again"
        got = shown(lines[last])
        raise KinematicsError(sentence("a row", "of numbers", got, f"{file}, line {last + 1}", step))
    columns, inline = _split_names(names)
    below = _split_units(units) if units else inline
    width = len(_cells(lines[first]))
    if not columns or len(columns) != width or len(below) != width:
        got = f"{len(columns)} names and {len(below)} units over {width} numbers"
        raise KinematicsError(
            sentence("the table", "one name and one unit to each column", got, f"{file}, line {named + 1}")
        )
    return Block(
        file, named + 1, fields, columns, below, _numbers(lines[first:last], first, width, file)
    ), last


def _cells(line: str) -> list[str]:
    """Split a line of numbers."""
    for mark in ("\t", ";"):
        if mark in line:
            return [cell.strip() for cell in line.strip().strip(mark).split(mark)]
    return line.split()


def _is_numbers(line: str) -> bool:
    """Tell whether a line holds numbers only, two at least or one alone."""
    cells = _cells(line) if line.strip() else []
    return bool(cells) and _value(cells[0]) is not None and all(_value(cell) is not None for cell in cells)


def _value(cell: str) -> float | None:
    if not cell:
        return np.nan
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        return None


def _numbers(lines: list[str], first: int, width: int, file: str) -> Array:
    rows = np.empty((len(lines), width))
    for number, line in enumerate(lines):
        cells = _cells(line)
        if len(cells) != width:
            place = f"{file}, line {first + number + 1}"
            step = "It may be cut short: export it again"
            raise KinematicsError(sentence("a row", f"of {width} numbers", len(cells), place, step))
        rows[number] = [_value(cell) for cell in cells]
    return rows


def _only_units(line: str) -> bool:
    cells = [cell for cell in re.split(r"\t|;", line) if cell.strip()]
    return all(_UNIT.fullmatch(cell.strip()) for cell in cells) and bool(cells)


def _split_names(line: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    cells = re.split(r"\t|;", line.strip("\r\n\t "))
    if len(cells) == 1:
        cells = re.split(r"\s{2,}", line.strip())
    units = [match[1].strip() if (match := _UNIT.search(cell)) else "" for cell in cells]
    return tuple(_UNIT.sub("", cell).strip() for cell in cells), tuple(units)


def _split_units(line: str) -> tuple[str, ...]:
    cells = re.split(r"\t|;", line.strip("\r\n\t "))
    if len(cells) == 1:
        cells = _UNIT.findall(line)
    return tuple(cell.strip().strip("[]").strip() for cell in cells)


@dataclass(frozen=True)
class Signal:
    """Complex values of one axis of a block: axis ``x``, ``-y`` ... or empty, unit, values (rows,) in SI."""

    axis: str
    unit: MotionUnit
    value: ComplexArray


def signals(block: Block) -> list[Signal]:
    """Pair the columns of a block to complex values.

    Raises
    ------
    KinematicsError
        Amplitudes without phase, amplitudes in dB, a real part without an imaginary part, a unit that is no
        motion, or no column of values at all.
    """
    pairs: dict[str, dict[str, int]] = {}
    for place, name in enumerate(block.columns):
        part = next((part for part, pattern in _PARTS.items() if pattern.match(name)), None)
        if part is not None:
            match = _AXIS.search(name)
            axis = "" if match is None else match[1].replace("+", "") + match[2].lower()
            pairs.setdefault(axis, {})[part] = place
    made = []
    for axis, parts in pairs.items():
        made.append(_signal(block, axis, parts))
    if not made:
        step = "Export Real & Imag., or Magnitude & Phase"
        expected = "columns of real and imaginary part, or magnitude and phase"
        raise KinematicsError(
            sentence(
                "the table",
                expected,
                shown(", ".join(block.columns)) if block.columns else "no names",
                block.where,
                step,
            )
        )
    return made


def _signal(block: Block, axis: str, parts: Mapping[str, int]) -> Signal:
    of_axis = f" of axis {axis}" if axis else ""
    if {"re", "im"} <= set(parts):
        first, second = parts["re"], parts["im"]
        value = np.empty(len(block.numbers), dtype=complex)
        value.real, value.imag = block.numbers[:, first], block.numbers[:, second]
        if block.units[first] != block.units[second]:
            got = f"{shown(block.units[first])} and {shown(block.units[second])}"
            raise KinematicsError(
                sentence(f"the values{of_axis}", "in one unit", got, block.where, "Export it again")
            )
    elif {"amp", "phase"} <= set(parts):
        first, second = parts["amp"], parts["phase"]
        turn = _phase_factor(block.units[second], block.where)
        with np.errstate(invalid="ignore", over="ignore"):
            value = np.asarray(block.numbers[:, first] * np.exp(1j * turn * block.numbers[:, second]))
    else:
        names = {"re": "real part", "im": "imaginary part", "amp": "magnitude", "phase": "phase"}
        got = " and ".join(names[part] for part in parts) + " alone"
        step = "Export Real & Imag., or Magnitude & Phase: motion cannot be told without its phase"
        expected = "real and imaginary part, or magnitude and phase"
        raise KinematicsError(sentence(f"the values{of_axis}", expected, got, block.where, step))
    unit = motion_unit(block.units[first]) if not is_none(block.units[first]) else None
    if unit is None:
        got = shown(block.units[first]) if block.units[first] else "none"
        expected = "m, mm, um, nm, m/s, mm/s, um/s, m/s2, g [per unit of a reference]"
        step = "Export velocity or displacement on a linear scale, not in dB"
        raise KinematicsError(sentence(f"the unit{of_axis}", expected, got, block.where, step))
    return Signal(axis, unit, scaled(value, unit.scale))


def _phase_factor(unit: str, where: str) -> float:
    if unit.strip().lower() in ("°", "deg", "degree", "degrees", "grad", "\ufffd"):
        return float(np.pi / 180.0)
    if unit.strip().lower() in ("rad", "radian", "radians"):
        return 1.0
    got = shown(unit) if unit else "none"
    raise KinematicsError(sentence("the unit of the phase", "degrees or rad", got, where, "Export it again"))


def frequency_hz(text: str, where: str) -> float:
    """Read ``1000 Hz`` or ``1,5 kHz``.

    Raises
    ------
    KinematicsError
        Another unit or no number.
    """
    match = re.fullmatch(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(m|k|M)?Hz\s*", text)
    value = None if match is None else _value(match[1])
    if match is None or value is None:
        raise KinematicsError(
            sentence("the frequency", "a number in Hz", shown(text), where, "Export it again")
        )
    return float(value) * {"m": 1e-3, None: 1.0, "k": 1e3, "M": 1e6}[match[2]]

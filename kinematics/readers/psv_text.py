"""Blocks of text exports of scanning vibrometers: ``Name: value`` lines, names and units of columns, numbers.

The layouts are known from programs that read them; no such file of the vendor was available.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from kinematics.readers.recording import from_polar, scaled, unknown_vector
from kinematics.readers.text import cells_of, is_row, read_rows, read_text, shown
from kinematics.readers.units import PHASES, MotionUnit, is_none, motion_unit, unit_fault
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, raise_all
from stapeskit.frames import axis_vector

_PARTS = {
    "re": re.compile(r"^(real|re|realteil|réel|réelle)\b", re.IGNORECASE),
    "im": re.compile(r"^(imag|imaginary|im|imaginär|imaginärteil|imaginaire)\b", re.IGNORECASE),
    "amp": re.compile(r"^(magnitude|amplitude|betrag|mag|module)\b", re.IGNORECASE),
    "phase": re.compile(r"^phase\b", re.IGNORECASE),
}
_AXIS_IN_NAME = re.compile(r"(?:^|[\s(_])([+-]?)([XYZ])\s*$", re.IGNORECASE)
_UNIT = re.compile(r"\[([^\]]*)\]")
_FIELD = re.compile(r"\s*([^:\t]{2,40}):(.*)")
_LARGEST_FILE = 1 << 30  # 1 GB of text holds 10^7 readings


@dataclass(frozen=True)
class Block:
    """One table: its ``Name: value`` lines, names and units of its columns, numbers (row, column)."""

    where: Place
    fields: Mapping[str, str]
    columns: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array

    def field(self, names: Sequence[str]) -> str:
        """Return the value of the first name that is there; empty without one."""
        return next((self.fields[name] for name in names if name in self.fields), "")

    def column(self, *names: str) -> int | None:
        """Return the place of the first of some columns; None without one."""
        low = [column.lower() for column in self.columns]
        return next((low.index(name) for name in names if name in low), None)


@dataclass(frozen=True)
class Signal:
    """Complex values (row,) in SI of one axis (``x``, ``-y`` ... or empty) of a block."""

    axis: str
    unit: MotionUnit
    value: ComplexArray

    @property
    def direction(self) -> Array:
        """Unit vector (3,) of the axis; NaN without one."""
        vector = axis_vector(self.axis)
        return unknown_vector() if vector is None else vector


def signals_of(block: Block) -> list[Signal]:
    """Pair the columns of a block to complex values.

    Raises
    ------
    StapeskitError
        Amplitudes without phase, a real part without an imaginary part, a unit that is no motion, or no
        column of values at all; all faults of the block.
    """
    pairs: dict[str, dict[str, int]] = {}
    for place, name in enumerate(block.columns):
        part = next((part for part, pattern in _PARTS.items() if pattern.match(name)), "")
        if part:
            match = _AXIS_IN_NAME.search(name)
            axis = match[1].replace("+", "") + match[2].lower() if match else ""
            pairs.setdefault(axis, {})[part] = place
    signals: list[Signal] = []
    faults: list[Fault] = []
    unknown: dict[str, list[str]] = {}
    for axis, parts in pairs.items():
        with collect_faults(faults):
            first, value = _complex(block, parts)
            label = block.units[first]
            unit = None if is_none(label) else motion_unit(label)
            if unit is None:
                unknown.setdefault(label, []).append(block.columns[first])
            else:
                signals.append(Signal(axis, unit, scaled(value, unit.scale)))
    step = "Export velocity or displacement on a linear scale"
    faults += [unit_fault(shown(label), columns, block.where, step) for label, columns in unknown.items()]
    if not pairs:
        want, got = (
            "columns of real and imaginary part, or magnitude and phase",
            shown(", ".join(block.columns)),
        )
        faults.append(Fault("the table", want, got, block.where, "Export Real & Imag., or Magnitude & Phase"))
    raise_all(faults)
    return signals


def _complex(block: Block, parts: Mapping[str, int]) -> tuple[int, ComplexArray]:
    """Return the column that gives the unit of an axis, and its complex values in that unit."""
    if {"re", "im"} <= set(parts):
        value = block.numbers[:, parts["re"]].astype(complex)
        value.imag = block.numbers[:, parts["im"]]
        if block.units[parts["re"]] != block.units[parts["im"]]:
            got = " and ".join(shown(block.units[parts[part]]) for part in ("re", "im"))
            raise StapeskitError.of(
                "real and imaginary part", "in one unit", got, block.where, "Export it again"
            )
        return parts["re"], value
    if {"amp", "phase"} <= set(parts):
        label = block.units[parts["phase"]].strip().lower()
        if label not in PHASES:
            got = shown(label) or "none"
            raise StapeskitError.of(
                "the unit of the phase", "degrees or rad", got, block.where, "Export it again"
            )
        columns = block.numbers[:, parts["amp"]], block.numbers[:, parts["phase"]]
        return parts["amp"], from_polar(*columns, PHASES[label])
    names = {"re": "a real part", "im": "an imaginary part", "amp": "a magnitude", "phase": "a phase"}
    got = " and ".join(names[part] for part in parts) + " alone"
    step = "Export Real & Imag., or Magnitude & Phase: motion cannot be computed without its phase"
    want = "real and imaginary part, or magnitude and phase"
    raise StapeskitError.of("the values", want, got, block.where, step)


def names_above(lines: Sequence[str]) -> set[str]:
    """Return the names of the ``Name: value`` lines, in small letters."""
    return {match[1].strip().lower() for line in lines if (match := _FIELD.match(line))}


def blocks_of(path: Path, faults: list[Fault]) -> list[Block]:
    """Read every table of a file; what is wrong is added to the faults."""
    if path.stat().st_size > _LARGEST_FILE:
        faults.append(Fault("a text export", "smaller than 1 GB", "a larger one", path.name))
        return []
    lines = read_text(path).split("\n")
    rows = [bool(line.strip()) and not _FIELD.match(line) and is_row(_cells(line)) for line in lines]
    blocks: list[Block] = []
    start, before = 0, len(faults)
    while (first := next((n for n in range(start, len(lines)) if rows[n]), None)) is not None:
        end = first
        while end < len(lines) and lines[end].strip() and not _FIELD.match(lines[end]):
            end += 1
        with collect_faults(faults):
            blocks.append(_block(lines, (start, first, end), path.name, faults))
        start = end
    if not blocks and len(faults) == before:
        step = "Export it again as ASCII, or take it out of the folder"
        faults.append(Fault("a text export", "a header and a table of numbers", "no table", path.name, step))
    return blocks


def _block(lines: Sequence[str], place: tuple[int, int, int], file: str, faults: list[Fault]) -> Block:
    """Read the table in lines ``first`` to ``end``, and the header above it from ``start`` on."""
    start, first, end = place
    fields, names, units, at = dict[str, str](), "", "", start
    for number in range(start, first):
        line = lines[number]
        match = _FIELD.match(line)
        if match:
            fields[match[1].strip().lower()] = match[2].strip(" \t;")
        elif line.strip():
            if names and all(_UNIT.fullmatch(cell.strip()) for cell in _split(line) if cell.strip()):
                units = line
            else:
                names, units, at = line, "", number
    cells = _split(names) if names.strip() else []
    columns = tuple(_UNIT.sub("", cell).strip() for cell in cells)
    inline = tuple(match[1].strip() if (match := _UNIT.search(cell)) else "" for cell in cells)
    below = tuple(cell.strip().strip("[]").strip() for cell in _split(units)) if units else inline
    width = Counter(len(_cells(line)) for line in lines[first:end]).most_common(1)[0][0]
    where = Place(file, "line", (at + 1,))
    if not columns or len(columns) != width or len(below) != width:
        got = f"{len(columns)} names and {len(below)} units over {width} numbers"
        raise StapeskitError.of("the table", "one name and one unit to each column", got, where)
    separator = next((mark for mark in "\t;" if mark in lines[first]), " ")
    stripped = [line.strip() for line in lines[first:end]]
    return Block(
        where, fields, columns, below, read_rows(stripped, first + 1, separator, columns, file, faults)
    )


def _cells(line: str) -> list[str]:
    return cells_of(line.strip(), next((mark for mark in "\t;" if mark in line), " "))


def _split(line: str) -> list[str]:
    """Split a line of names or units: at tabs or semicolons, else at two blanks or at brackets."""
    cells = re.split(r"[\t;]", line.strip())
    if len(cells) == 1:
        cells = _UNIT.findall(line) if line.strip().startswith("[") else re.split(r"\s{2,}", line.strip())
    return cells

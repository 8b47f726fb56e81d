"""Read text exports of scanning vibrometers: FastScan (one block a frequency) and per-point blocks.

A block is some ``Name: value`` lines, a line of column names (units in brackets, or on a line of their own),
and rows of numbers. The layouts are known from programs that read them; no such file of the vendor was
available.

FastScan: ``Source File Name``, ``Signal``, ``Frequency: <f> Hz``, ``Interpolated``, ``Filtered``; columns
Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s], or Real and Imaginary of a single head.
Per point: ``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``, ``Signal``;
columns Frequency, Real, Imaginary. Positions without a unit are in metres.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.formats import export_files
from kinematics.readers.recording import (
    QUANTITY_OF_ORDER,
    Channel,
    Recording,
    Row,
    recording_of,
    unknown_vector,
)
from kinematics.readers.text import cells_of, is_row, number_of, read_rows, read_text, shown
from kinematics.readers.units import (
    HERTZ,
    LENGTHS,
    PHASES,
    MotionUnit,
    is_none,
    motion_unit,
    plain,
    unit_fault,
)
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

_FREQUENCY = ("frequency", "frequenz", "fréquence")
_POINT = ("point index", "punktindex", "punkt-index")
_COMPONENT = ("component", "komponente", "composante")
_TIME = ("time", "zeit", "temps")
_PARTS = {
    "re": re.compile(r"^(real|re|realteil|réel|réelle)\b", re.IGNORECASE),
    "im": re.compile(r"^(imag|imaginary|im|imaginär|imaginärteil|imaginaire)\b", re.IGNORECASE),
    "amp": re.compile(r"^(magnitude|amplitude|betrag|mag|module)\b", re.IGNORECASE),
    "phase": re.compile(r"^phase\b", re.IGNORECASE),
}
_AXIS_IN_NAME = re.compile(r"(?:^|[\s(_])([+-]?)([XYZ])\s*$", re.IGNORECASE)
_AXIS_ALONE = re.compile(r"^\s*(?:vib\s*)?([+-]?)([xyz])\s*$", re.IGNORECASE)
_AXIS_IN_SIGNAL = re.compile(r"\bvib\s+([+-]?)([xyz])\b", re.IGNORECASE)
_COORDINATE = r"{axis}\s*=?\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![A-Za-z])"
_HERTZ = re.compile(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(k|M)?Hz\s*")
_UNIT = re.compile(r"\[([^\]]*)\]")
_FIELD = re.compile(r"\s*([^:\t]{2,40}):(.*)")
_LARGEST_FILE = 1 << 30  # 1 GB of text holds 10^7 readings
_SAME_PLACE_M = 1e-6  # positions written with four digits


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


@dataclass(frozen=True)
class Reading:
    """Values (line,) of one signal of one block at the points and frequencies that the block holds."""

    signal: Signal
    point: str
    position_m: Array
    freq_hz: Array
    value: ComplexArray
    block: Block

    @property
    def key(self) -> tuple[str, str]:
        """Point and axis."""
        return self.point, self.signal.axis


def looks_like_fastscan(text: str) -> bool:
    """Return whether a text begins as one frequency of a FastScan export."""
    lines = text.split("\n", 40)[:40]
    return any(line.lower().startswith("index") for line in lines) and bool(
        _names_above(lines) & {*_FREQUENCY}
    )


def looks_like_points(text: str) -> bool:
    """Return whether a text begins as a per-point export."""
    return bool(_names_above(text.split("\n", 40)[:40]) & {*_POINT})


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a file, or a folder (with its folders) of files; the first block says which layout it is.

    Raises
    ------
    StapeskitError
        A file is cut short or holds no table, amplitudes without phase, a time series or another unit than
        motion; a point has two positions; a frequency or a signal is there twice, or sources are mixed.
    """
    path = Path(path)
    files = export_files(path) if path.is_dir() else [path]
    faults: list[Fault] = []
    blocks = [block for file in files for block in _blocks(file, faults)]
    raise_all(faults)
    if not blocks:
        step = "Give the folder of the exported text files"
        raise StapeskitError.of("the folder", "one with text exports", "none", path.name, step)
    fastscan = not blocks[0].field(_POINT)
    readings, stated = _fastscan(blocks, path.name) if fastscan else _per_point(blocks)
    readings, notices = _one_quantity(readings, path.name)
    if len({reading.key for reading in readings}) > len({reading.point for reading in readings}):
        notices.append(_axes_notice(path.name))
    treated = [
        name for name in ("interpolated", "filtered") if any(_yes(block.fields.get(name)) for block in blocks)
    ]
    if treated:
        text = (
            f"{path.name} was exported {' and '.join(treated)}: values were mixed between points, so that "
            "points "
            "do not err independently. Export the measured values."
        )
        notices.append(Notice("values_smoothed", text))
    rows = _by_line(readings) if fastscan else _by_point(readings, path.name, notices)
    units = "positions in stated units" if stated else "positions without unit, as metres"
    statement = f"coordinates of the scan, {units}"
    return recording_of(path.name, rows, notices=tuple(notices), statement=statement, length_stated=stated)


def _fastscan(blocks: Sequence[Block], name: str) -> tuple[list[Reading], bool]:
    """Return the readings of FastScan blocks, and whether the unit of positions is stated."""
    readings, faults, stated = list[Reading](), list[Fault](), True
    at_frequency: dict[float, Place] = {}
    for block in blocks:
        with collect_faults(faults):
            text = block.field(_FREQUENCY)
            match = _HERTZ.fullmatch(text)
            number = number_of(match[1]) if match else None
            if match is None or number is None:
                step = "Export the bands of a FastScan with their header"
                got = shown(text) or "none"
                raise StapeskitError.of(
                    "the header", "one with a line Frequency: <f> Hz", got, block.where, step
                )
            freq = number * HERTZ[f"{(match[2] or '').lower()}hz"]
            if freq in at_frequency:
                step = "Put every excitation into a folder of its own, and give all folders"
                got = f"{at_frequency[freq]} and {block.where}"
                raise StapeskitError.of(f"the frequency {freq:g} Hz", "there once", got, "", step)
            at_frequency[freq] = block.where
            points = _indices(block)
            positions, known = _positions(block)
            stated &= known
            for signal in _signals(block):
                readings += [
                    Reading(
                        signal, point, positions[row], np.array([freq]), signal.value[row : row + 1], block
                    )
                    for row, point in enumerate(points)
                ]
    sources = list(dict.fromkeys(block.fields.get("source file name", "") for block in blocks))
    if len(sources) > 1:
        step = "Put the files of every measurement into a folder of its own"
        got = list_some(map(shown, sources), 4, " and ")
        faults.append(Fault("the source of the files", "one measurement", got, name, step))
    raise_all(faults)
    return readings, stated


def _indices(block: Block) -> list[str]:
    """Return the names of the points of a FastScan block."""
    column = block.column("index", "point index")
    numbers = np.empty(0) if column is None else block.numbers[:, column]
    whole = np.isfinite(numbers) & (numbers == np.round(numbers))
    if column is None or not np.all(whole) or len(np.unique(numbers)) < len(numbers):
        got = shown(", ".join(block.columns)) if column is None else "others, or one of them twice"
        want, step = "one with a column Index of different whole numbers", "Export it again"
        raise StapeskitError.of("the table", want, got, block.where, step)
    return [f"{number:.0f}" for number in numbers]


def _positions(block: Block) -> tuple[Array, bool]:
    """Return positions (row, 3), m, NaN without columns of them, and whether their unit is stated."""
    columns = [block.column(axis) for axis in "xyz"]
    if None in columns:
        return np.full((len(block.numbers), 3), np.nan), True
    places = [column for column in columns if column is not None]
    labels = {block.units[column] for column in places}
    label = min(labels)
    if len(labels) > 1 or not (is_none(label) or plain(label) in LENGTHS):
        got = shown(", ".join(sorted(labels)))
        raise StapeskitError.of(
            "the unit of X, Y, Z", "one length unit", got, block.where, "Export them in metres"
        )
    return block.numbers[:, places] * (1.0 if is_none(label) else LENGTHS[plain(label)]), not is_none(label)


def _per_point(blocks: Sequence[Block]) -> tuple[list[Reading], bool]:
    """Return the readings of per-point blocks, and whether the unit of positions is stated."""
    readings, faults, stated = list[Reading](), list[Fault](), True
    for block in blocks:
        text = block.field(_POINT)
        number = re.match(r"\s*(\d+)", text)
        with collect_faults(faults):
            if number is None:
                want, step = "one with a line Point Index: <n>", "Leave other files out of the folder"
                raise StapeskitError.of("the header", want, shown(text) or "none", block.where, step)
            freq = _frequencies(block)
            position, known = _position(text[number.end() :], block.where)
            stated &= known
            axis = _AXIS_ALONE.match(block.field(_COMPONENT)) or _AXIS_IN_SIGNAL.search(
                block.field(("signal",))
            )
            for signal in _signals(block):
                if not signal.axis and axis:
                    signal = replace(signal, axis=axis[1].replace("+", "") + axis[2].lower())
                readings.append(Reading(signal, number[1], position, freq, signal.value, block))
    raise_all(faults)
    return readings, stated


def _frequencies(block: Block) -> Array:
    """Return the first column of a per-point block, Hz."""
    first, unit = block.columns[0].lower(), block.units[0].lower() or "hz"
    if first.startswith(_TIME):
        step = (
            "Export spectra or frequency responses, or give the time series as a table with a column time_s"
        )
        raise StapeskitError.of("the export", "over frequency", "a time series", block.where, step)
    if not first.startswith(_FREQUENCY) or unit not in HERTZ:
        got, step = shown(f"{block.columns[0]} [{block.units[0]}]"), "Export spectra or frequency responses"
        raise StapeskitError.of("the first column", "Frequency [Hz]", got, block.where, step)
    freq = block.numbers[:, 0] * HERTZ[unit]
    if not np.all(freq >= 0.0) or np.any(np.diff(freq) <= 0.0) or np.any(np.isinf(freq)):
        raise StapeskitError.of(
            "the frequencies", "ascending and not negative", "others", block.where, "Sort them"
        )
    return np.asarray(freq)


def _position(text: str, where: Place) -> tuple[Array, bool]:
    """Read x, y, z behind the point index, m, and whether their unit is stated."""
    matches = [re.search(_COORDINATE.format(axis=axis), text, re.IGNORECASE) for axis in "xyz"]
    if any(match is None for match in matches):
        return unknown_vector(), True
    numbers = [number_of(match[1].rstrip(",.")) for match in matches if match is not None]
    units = {match[2] for match in matches if match is not None and match[2]}
    if None in numbers or len(units) > 1:
        want = "three numbers, x = .. y = .. z = .."
        raise StapeskitError.of("the position of a point", want, shown(text), where, "Export it again")
    scale = LENGTHS[plain(min(units))] if units else 1.0
    return np.array(numbers, dtype=float) * scale, bool(units)


def _signals(block: Block) -> list[Signal]:
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
                signals.append(Signal(axis, unit, value * unit.scale))
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
        turned = np.exp(1j * PHASES[label] * block.numbers[:, parts["phase"]])
        return parts["amp"], np.asarray(block.numbers[:, parts["amp"]] * turned)
    names = {"re": "a real part", "im": "an imaginary part", "amp": "a magnitude", "phase": "a phase"}
    got = " and ".join(names[part] for part in parts) + " alone"
    step = "Export Real & Imag., or Magnitude & Phase: motion cannot be computed without its phase"
    want = "real and imaginary part, or magnitude and phase"
    raise StapeskitError.of("the values", want, got, block.where, step)


def _one_quantity(readings: Sequence[Reading], name: str) -> tuple[list[Reading], list[Notice]]:
    """Keep one quantity, velocity first, and one kind of reference, responses first."""
    notices = []
    ranked = sorted(
        {reading.signal.unit.order for reading in readings}, key=lambda order: (order != 1, order)
    )
    if len(ranked) > 1:
        listed = " and ".join(QUANTITY_OF_ORDER[order] for order in ranked)
        text = f"{name} holds {listed}: {QUANTITY_OF_ORDER[ranked[0]]} is used."
        notices.append(Notice("quantity_chosen", text))
    chosen = [reading for reading in readings if reading.signal.unit.order == ranked[0]]
    if len({bool(reading.signal.unit.per) for reading in chosen}) > 1:
        text = f"{name} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("function_chosen", text))
        chosen = [reading for reading in chosen if reading.signal.unit.per]
    pers = {reading.signal.unit.per for reading in chosen}
    if len(pers) > 1:
        got = ", ".join(sorted(pers))
        raise StapeskitError.of("the unit of the values", "one in all blocks", got, name, "Export it again")
    return chosen, notices


def _axes_notice(name: str) -> Notice:
    text = (
        f"{name} holds x, y, z computed from several beams: their noise is correlated, and larger across the "
        "beams than along them; sd and verdicts, which take channels as independent, are approximate. Export "
        "the single heads with their directions where possible."
    )
    return Notice("axes_from_beams", text)


def _by_line(readings: Sequence[Reading]) -> list[Row]:
    """Gather readings at single frequencies to one row a point and axis; refuse points that move."""
    groups: dict[tuple[str, str], list[Reading]] = {}
    for reading in readings:
        groups.setdefault(reading.key, []).append(reading)
    faults, rows = [], []
    rank = {point: number for number, point in enumerate(dict.fromkeys(point for point, _ in groups))}
    for _, group in sorted(groups.items(), key=lambda item: rank[item[0][0]]):
        group = sorted(group, key=lambda reading: float(reading.freq_hz[0]))
        first = group[0].position_m
        for other in group[1:]:
            if np.any(np.abs(other.position_m - first) > _SAME_PLACE_M + 1e-5 * np.abs(first)):
                got = f"{first.tolist()} and {other.position_m.tolist()} m"
                thing, step = f"the position of point {other.point}", "Export all frequencies of one scan"
                faults.append(Fault(thing, "one", got, other.block.where, step))
                break
        freq, value = (np.concatenate([getattr(one, name) for one in group]) for name in ("freq_hz", "value"))
        rows.append(Row(_channel(group[0]), freq, value))
    raise_all(faults)
    return rows


def _by_point(readings: Sequence[Reading], name: str, notices: list[Notice]) -> list[Row]:
    """Return one row a reading; name runs after the source where a point was measured in several."""

    def source(reading: Reading) -> str:
        return reading.block.fields.get("source file name", "") or reading.block.where.file

    again = Counter(reading.key for reading in readings).most_common(1)[0][1] > 1
    twice = [key for key, times in Counter((one.key, source(one)) for one in readings).items() if times > 1]
    if twice:
        step = "Put every excitation into a folder of its own, and give all folders"
        listed = list_some((point for (point, _), _ in twice), 6)
        raise StapeskitError.of(f"the signal of points {listed}", "there once", "two or more", name, step)
    sources = list(dict.fromkeys(map(source, readings)))
    if not again and 1 < len(sources) < len({reading.block.where for reading in readings}):
        listed = list_some(sources, 4)
        text = f"{name} holds points of {len(sources)} measurements ({listed}), taken as one run."
        notices.append(Notice("sources_joined", text))
    return [
        Row(_channel(one, Path(source(one).replace("\\", "/")).stem if again else ""), one.freq_hz, one.value)
        for one in readings
    ]


def _channel(reading: Reading, run: str = "") -> Channel:
    unit, signal = reading.signal.unit, reading.signal
    return Channel(
        reading.point, run=run, order=unit.order, per=unit.per, position_m=reading.position_m,
        direction=signal.direction, where=reading.block.where,
    )  # fmt: skip


def _yes(value: str | None) -> bool:
    return value is not None and value.strip().lower() in ("yes", "ja", "oui", "1", "true")


def _names_above(lines: Sequence[str]) -> set[str]:
    """Return the names of the ``Name: value`` lines, in small letters."""
    return {match[1].strip().lower() for line in lines if (match := _FIELD.match(line))}


def _blocks(path: Path, faults: list[Fault]) -> list[Block]:
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

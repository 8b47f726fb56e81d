"""Read text exports of scanning vibrometers: FastScan (one block a frequency) and per-point blocks.

FastScan: ``Source File Name``, ``Signal``, ``Frequency: <f> Hz``, ``Interpolated``, ``Filtered``; columns
Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s], or Real and Imaginary of a single head. Per point:
``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``, ``Signal``; columns
Frequency, Real, Imaginary. Positions without a unit are in metres.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.formats import export_files
from kinematics.readers.psv_text import Block, Signal, blocks_of, names_above, signals_of
from kinematics.readers.recording import (
    QUANTITY_OF_ORDER,
    Channel,
    Recording,
    Row,
    recording_of,
    unknown_vector,
)
from kinematics.readers.text import number_of, shown
from kinematics.readers.units import HERTZ, LENGTHS, is_none, plain
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice

_FREQUENCY = ("frequency", "frequenz", "fréquence")
_POINT = ("point index", "punktindex", "punkt-index")
_COMPONENT = ("component", "komponente", "composante")
_TIME = ("time", "zeit", "temps")
_AXIS_ALONE = re.compile(r"^\s*(?:vib\s*)?([+-]?)([xyz])\s*$", re.IGNORECASE)
_AXIS_IN_SIGNAL = re.compile(r"\bvib\s+([+-]?)([xyz])\b", re.IGNORECASE)
_COORDINATE = r"{axis}\s*=?\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![A-Za-z])"
_HERTZ = re.compile(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(k|M)?Hz\s*")
_SAME_PLACE_M = 1e-6  # positions written with four digits

_Unit = tuple[int, str]
"""Order and reference of a signal."""


def looks_like_fastscan(text: str) -> bool:
    """Return whether a text begins as one frequency of a FastScan export."""
    lines = text.split("\n", 40)[:40]
    return any(line.lower().startswith("index") for line in lines) and bool(
        names_above(lines) & {*_FREQUENCY}
    )


def looks_like_points(text: str) -> bool:
    """Return whether a text begins as a per-point export."""
    return bool(names_above(text.split("\n", 40)[:40]) & {*_POINT})


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
    blocks = [block for file in files for block in blocks_of(file, faults)]
    raise_all(faults)
    if not blocks:
        step = "Give the folder of the exported text files"
        raise StapeskitError.of("the folder", "one with text exports", "none", path.name, step)
    layout = _per_point if blocks[0].field(_POINT) else _fastscan
    rows, notices, stated = layout(blocks, path.name)
    if len({(row.channel.point, row.channel.beam_key) for row in rows}) > len(
        {row.channel.point for row in rows}
    ):
        text = (
            f"{path.name} holds x, y, z computed from several beams: their noise is correlated, and larger "
            "across the beams than along them; sd and verdicts, which take channels as independent, are "
            "approximate. Export the single heads with their directions where possible."
        )
        notices.append(Notice("axes_from_beams", text))
    marks = [
        mark for mark in ("interpolated", "filtered") if any(_yes(block.fields.get(mark)) for block in blocks)
    ]
    if marks:
        text = (
            f"{path.name} was exported {' and '.join(marks)}: values were mixed between points, so that "
            "points do not err independently. Export the measured values."
        )
        notices.append(Notice("values_smoothed", text))
    units = "positions in stated units" if stated else "positions without unit, as metres"
    statement = f"coordinates of the scan, {units}"
    return recording_of(path.name, rows, notices=tuple(notices), statement=statement, length_stated=stated)


def _fastscan(blocks: Sequence[Block], name: str) -> tuple[list[Row], list[Notice], bool]:
    """Return one row a point and axis of blocks at one frequency each, and whether positions have a unit."""
    faults: list[Fault] = []
    tables: dict[float, tuple[Block, list[str], Array, list[Signal]]] = {}
    stated = True
    for block in blocks:
        with collect_faults(faults):
            freq = _frequency(block)
            if freq in tables:
                step = "Put every excitation into a folder of its own, and give all folders"
                got = f"{tables[freq][0].where} and {block.where}"
                raise StapeskitError.of(f"the frequency {freq:g} Hz", "there once", got, "", step)
            positions, known = _positions(block)
            tables[freq] = (block, _indices(block), positions, signals_of(block))
            stated &= known
    sources = list(dict.fromkeys(block.fields.get("source file name", "") for block in blocks))
    if len(sources) > 1:
        step = "Put the files of every measurement into a folder of its own"
        got = list_some(map(shown, sources), 4, " and ")
        faults.append(Fault("the source of the files", "one measurement", got, name, step))
    raise_all(faults)
    unit, notices = _one_unit(
        ((s.unit.order, s.unit.per) for *_, signals in tables.values() for s in signals), name
    )
    freq_hz = np.array(sorted(tables))
    places: dict[str, Array] = {}
    values: dict[tuple[str, str], ComplexArray] = {}
    first: dict[tuple[str, str], tuple[Signal, Place]] = {}
    for line, freq in enumerate(freq_hz.tolist()):
        block, points, positions, signals = tables[freq]
        for point, place in zip(points, positions, strict=True):
            known_place = places.setdefault(point, place)
            if np.any(np.abs(place - known_place) > _SAME_PLACE_M + 1e-5 * np.abs(known_place)):
                got, step = (
                    f"{known_place.tolist()} and {place.tolist()} m",
                    "Export all frequencies of one scan",
                )
                faults.append(Fault(f"the position of point {point}", "one", got, block.where, step))
        for signal in signals:
            if (signal.unit.order, signal.unit.per) != unit:
                continue
            for row, point in enumerate(points):
                key = (point, signal.axis)
                if key not in values:
                    values[key] = np.full(len(freq_hz), np.nan + 1j * np.nan)
                    first[key] = (signal, block.where)
                values[key][line] = signal.value[row]
    raise_all(faults)
    rank = {point: number for number, point in enumerate(places)}
    keys = sorted(values, key=lambda key: rank[key[0]])
    return [_row(key[0], *first[key], places[key[0]], freq_hz, values[key]) for key in keys], notices, stated


def _per_point(blocks: Sequence[Block], name: str) -> tuple[list[Row], list[Notice], bool]:
    """Return one row a signal of per-point blocks; runs have the names of sources where points repeat."""
    rows: list[tuple[Row, str]] = []
    faults: list[Fault] = []
    stated = True
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
            match = _AXIS_ALONE.match(block.field(_COMPONENT)) or _AXIS_IN_SIGNAL.search(
                block.field(("signal",))
            )
            axis = match[1].replace("+", "") + match[2].lower() if match else ""
            source = block.fields.get("source file name", "") or block.where.file
            for signal in signals_of(block):
                signal = replace(signal, axis=signal.axis or axis)
                rows.append((_row(number[1], signal, block.where, position, freq, signal.value), source))
    raise_all(faults)
    unit, notices = _one_unit(((row.channel.order, row.channel.per) for row, _ in rows), name)
    rows = [(row, source) for row, source in rows if (row.channel.order, row.channel.per) == unit]
    keys = [(row.channel.point, row.channel.beam_key) for row, _ in rows]
    again = len(set(keys)) < len(keys)
    whole = Counter((*key, source) for key, (_, source) in zip(keys, rows, strict=True))
    twice = [str(key[0]) for key, times in whole.items() if times > 1]
    if twice:
        step = "Put every excitation into a folder of its own, and give all folders"
        thing = f"the signal of points {list_some(twice, 6)}"
        raise StapeskitError.of(thing, "there once", "two or more", name, step)
    sources = list(dict.fromkeys(source for _, source in rows))
    if not again and 1 < len(sources) < len({row.channel.where for row, _ in rows}):
        text = (
            f"{name} holds points of {len(sources)} measurements ({list_some(sources, 4)}), taken as one run."
        )
        notices.append(Notice("runs_by_file", text))
    if not again:
        return [row for row, _ in rows], notices, stated
    runs = [(row, Path(source.replace("\\", "/")).stem) for row, source in rows]
    return [replace(row, channel=replace(row.channel, run=run)) for row, run in runs], notices, stated


def _row(point: str, signal: Signal, where: Place, position: Array, freq: Array, value: ComplexArray) -> Row:
    channel = Channel(
        point,
        order=signal.unit.order,
        per=signal.unit.per,
        position_m=position,
        direction=signal.direction,
        where=where,
    )
    return Row(channel, freq, value)


def _one_unit(units: Iterable[_Unit], name: str) -> tuple[_Unit, list[Notice]]:
    """Choose one quantity, velocity first, and one kind of reference, responses first."""
    notices = []
    found = sorted(set(units), key=lambda unit: (unit[0] != 1, *unit))
    orders = list(dict.fromkeys(order for order, _ in found))
    if len(orders) > 1:
        listed = " and ".join(QUANTITY_OF_ORDER[order] for order in orders)
        notices.append(
            Notice("quantity_chosen", f"{name} holds {listed}: {QUANTITY_OF_ORDER[orders[0]]} is used.")
        )
    pers = [per for order, per in found if order == orders[0]]
    references = [per for per in pers if per]
    if len(references) > 1:
        got = ", ".join(references)
        raise StapeskitError.of("the unit of the values", "one in all blocks", got, name, "Export it again")
    if references and len(pers) > 1:
        text = f"{name} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("quantity_chosen", text))
    return (orders[0], references[0] if references else ""), notices


def _frequency(block: Block) -> float:
    """Return the frequency of a FastScan block, Hz."""
    text = block.field(_FREQUENCY)
    match = _HERTZ.fullmatch(text)
    number = number_of(match[1]) if match else None
    if match is None or number is None:
        want, step = "one with a line Frequency: <f> Hz", "Export the bands of a FastScan with their header"
        raise StapeskitError.of("the header", want, shown(text) or "none", block.where, step)
    return number * HERTZ[f"{(match[2] or '').lower()}hz"]


def _indices(block: Block) -> list[str]:
    """Return the names of the points of a FastScan block."""
    column = block.column("index", "point index")
    numbers = np.empty(0) if column is None else block.numbers[:, column]
    whole = np.isfinite(numbers) & (numbers == np.round(numbers))
    if column is None or not np.all(whole) or len(np.unique(numbers)) < len(numbers):
        got = shown(", ".join(block.columns)) if column is None else "others, or one of them twice"
        want, step = "one with a column Index of different whole numbers", "Export it again"
        raise StapeskitError.of("the table", want, got, block.where, step)
    return [f"{number:.0f}" for number in numbers.tolist()]


def _positions(block: Block) -> tuple[Array, bool]:
    """Return positions (row, 3), m, NaN without columns of them, and whether their unit is stated."""
    places = [column for axis in "xyz" if (column := block.column(axis)) is not None]
    if len(places) < 3:
        return np.full((len(block.numbers), 3), np.nan), True
    labels = {block.units[column] for column in places}
    label = min(labels)
    if len(labels) > 1 or not (is_none(label) or plain(label) in LENGTHS):
        got, step = shown(", ".join(sorted(labels))), "Export them in metres"
        raise StapeskitError.of("the unit of X, Y, Z", "one length unit", got, block.where, step)
    return block.numbers[:, places] * (1.0 if is_none(label) else LENGTHS[plain(label)]), not is_none(label)


def _frequencies(block: Block) -> Array:
    """Return the first column of a per-point block, Hz."""
    first, unit = block.columns[0].lower(), block.units[0].lower() or "hz"
    if first.startswith(_TIME):
        step = "Export spectra or frequency responses, or a table of the time series with a column time_s"
        raise StapeskitError.of("the export", "over frequency", "a time series", block.where, step)
    if not first.startswith(_FREQUENCY) or unit not in HERTZ:
        got, step = shown(f"{block.columns[0]} [{block.units[0]}]"), "Export spectra or frequency responses"
        raise StapeskitError.of("the first column", "Frequency [Hz]", got, block.where, step)
    freq = block.numbers[:, 0] * HERTZ[unit]
    if not np.all(freq >= 0.0) or np.any(np.diff(freq) <= 0.0) or np.any(np.isinf(freq)):
        want = "ascending and not negative"
        raise StapeskitError.of("the frequencies", want, "others", block.where, "Sort them")
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


def _yes(value: str | None) -> bool:
    return value is not None and value.strip().lower() in ("yes", "ja", "oui", "1", "true")

"""Read text exports of scanning vibrometers: FastScan (one block a frequency) and per-point blocks.

FastScan: ``Source File Name``, ``Signal``, ``Frequency: <f> Hz``, ``Interpolated``, ``Filtered``; columns
Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s], or Real and Imaginary of a single head. Per point:
``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``, ``Signal``; columns
Frequency, Real, Imaginary. Positions without a unit are in metres.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.columns import BeamValues, Sheet, beams_of, values_of
from kinematics.readers.facts import FileFacts
from kinematics.readers.formats import export_files
from kinematics.readers.psv_text import blocks_of, names_above
from kinematics.readers.recording import (
    Channel,
    Recording,
    Row,
    best_quantity,
    recording_of,
    unknown_vector,
)
from kinematics.readers.text import number_of, shown
from kinematics.readers.units import HERTZ, LENGTHS, is_none, plain
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

_FREQUENCY = ("frequency", "frequenz", "fréquence")
_POINT = ("point index", "punktindex", "punkt-index")
_COMPONENT = ("component", "komponente", "composante")
_SOURCE = ("source file name",)
_AXIS = re.compile(r"(?:^|\bvib)\s*(?:vib\s*)?([+-]?)([xyz])\b", re.IGNORECASE)
_COORDINATE = r"{axis}\s*=?\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![A-Za-z])"
_HERTZ = re.compile(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(k|M)?Hz\s*")
_SAME_PLACE_M = 1e-6  # positions written with four digits
_APART = "Put the files of every measurement and excitation into a folder of its own"


def looks_like_fastscan(text: str) -> bool:
    """Return whether a text begins as one frequency of a FastScan export."""
    lines = text.split("\n", 40)[:40]
    return any(line.lower().startswith("index") for line in lines) and not names_above(lines).isdisjoint(
        _FREQUENCY
    )


def looks_like_points(text: str) -> bool:
    """Return whether a text begins as a per-point export."""
    return not names_above(text.split("\n", 40)[:40]).isdisjoint(_POINT)


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
    raise_all(faults or ([] if blocks else [Fault("the folder", "one with text exports", "none", path.name)]))
    layout = _per_point if blocks[0].field_of(_POINT) else _fastscan
    rows, notices, stated = layout(blocks, path.name)
    keep, chosen = best_quantity(
        [((row.channel.point, row.channel.run), row.channel.order, row.channel.per) for row in rows],
        path.name,
    )
    rows = [row for row, kept in zip(rows, keep, strict=True) if kept]
    notices += chosen
    keys = Counter((row.channel.point, row.channel.run, row.channel.beam_key) for row in rows)
    if twice := [point for (point, *_), times in keys.items() if times > 1]:
        thing = f"the signal of points {list_some(twice, 6)}"
        raise StapeskitError.of(thing, "there once", "two or more", path.name, _APART)
    if len({(point, beam) for point, _, beam in keys}) > len({point for point, *_ in keys}):
        text = (
            f"{path.name} holds x, y, z computed from several beams: their noise is correlated, and larger "
            "across the beams than along them; sd and verdicts, which take channels as independent, are "
            "approximate. Export the single heads with their directions where possible."
        )
        notices.append(Notice("axes_from_beams", text))
    marks = [
        mark
        for mark in ("interpolated", "filtered")
        if any(block.fields.get(mark, "").strip().lower() in ("yes", "ja", "oui", "1") for block in blocks)
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


def _fastscan(blocks: Sequence[Sheet], name: str) -> tuple[list[Row], list[Notice], bool]:
    """Return one row a point and axis of blocks at one frequency each, and whether positions have a unit."""
    faults: list[Fault] = []
    sources = list(dict.fromkeys(block.field_of(_SOURCE) for block in blocks))
    if len(sources) > 1:
        got = list_some(map(shown, sources), 4, " and ")
        faults.append(Fault("the source of the files", "one measurement", got, name, _APART))
    tables: dict[float, Sheet] = {}
    places: dict[str, Array] = {}
    readings: dict[tuple[str, str, int, str], tuple[Row, dict[float, complex]]] = {}
    stated = True
    for block in blocks:
        with collect_faults(faults):
            freq = _frequency(block)
            if freq in tables:
                got = f"{tables[freq].where} and {block.where}"
                raise StapeskitError.of(f"the frequency {freq:g} Hz", "there once", got, "", _APART)
            tables[freq] = block
            positions, known = _positions(block)
            stated &= known
            points = _indices(block)
            for point, place in zip(points, positions, strict=True):
                first = places.setdefault(point, place)
                if np.any(np.abs(place - first) > _SAME_PLACE_M + 1e-5 * np.abs(first)):
                    got, step = f"{first.tolist()} and {place.tolist()} m", "Export one scan"
                    faults.append(Fault(f"the position of point {point}", "one", got, block.where, step))
            for one in _values(block):
                for row, point in enumerate(points):
                    key = (point, one.beam.direction, one.unit.order, one.unit.per)
                    if key not in readings:
                        made = _row(point, one, block.where, places[point], np.empty(0), one.value[:0])
                        readings[key] = (made, {})
                    readings[key][1][freq] = complex(one.value[row])
    raise_all(faults)
    rank = {point: number for number, point in enumerate(places)}
    rows = []
    for key in sorted(readings, key=lambda key: rank[key[0]]):
        made, values = readings[key]
        freq_hz = np.array(sorted(values))
        rows.append(
            replace(made, freq_hz=freq_hz, value=np.array([values[freq] for freq in freq_hz.tolist()]))
        )
    return rows, [], stated


def _per_point(blocks: Sequence[Sheet], name: str) -> tuple[list[Row], list[Notice], bool]:
    """Return one row a signal of per-point blocks; runs have the names of sources where points repeat."""
    rows: list[tuple[Row, str]] = []
    faults: list[Fault] = []
    stated = True
    for block in blocks:
        text = block.field_of(_POINT)
        number = re.match(r"\s*(\d+)", text)
        with collect_faults(faults):
            if number is None:
                want, step = "one with a line Point Index: <n>", "Leave other files out of the folder"
                raise StapeskitError.of("the header", want, shown(text) or "none", block.where, step)
            freq = _frequencies(block)
            position, known = _position(text[number.end() :], block.where)
            stated &= known
            match = _AXIS.search(block.field_of(_COMPONENT)) or _AXIS.search(block.field_of(("signal",)))
            axis = match[1].replace("+", "") + match[2].lower() if match else ""
            source = block.field_of(_SOURCE) or block.where.file
            for one in _values(block):
                beam = replace(one.beam, direction=one.beam.direction or axis)
                made = _row(number[1], replace(one, beam=beam), block.where, position, freq, one.value)
                rows.append((made, source))
    raise_all(faults)
    kinds = [(row.channel.point, row.channel.beam_key, row.channel.order, row.channel.per) for row, _ in rows]
    sources = list(dict.fromkeys(source for _, source in rows))
    if len(set(kinds)) < len(kinds) and len(sources) > 1:
        runs = [Path(source.replace("\\", "/")).stem for _, source in rows]
        apart = zip(rows, runs, strict=True)
        return [replace(row, channel=replace(row.channel, run=run)) for (row, _), run in apart], [], stated
    notices = []
    if 1 < len(sources) < len(blocks):
        text = (
            f"{name} holds points of {len(sources)} measurements ({list_some(sources, 4)}), taken as one run."
        )
        notices.append(Notice("runs_by_file", text))
    return [row for row, _ in rows], notices, stated


def _row(point: str, one: BeamValues, where: Place, position: Array, freq: Array, value: ComplexArray) -> Row:
    axis = axis_vector(one.beam.direction)
    beam = unknown_vector() if axis is None else axis
    unit = one.unit
    channel = Channel(point, order=unit.order, per=unit.per, position_m=position, direction=beam, where=where)
    return Row(channel, freq, value)


def _values(block: Sheet) -> list[BeamValues]:
    """Return the complex values of a block; as `values_of`, and refused without any."""
    found = values_of(block, beams_of(block.names)[0])
    if not found:
        want, got = "real and imaginary part, or magnitude and phase", shown(", ".join(block.names))
        step = "Export Real & Imag., or Magnitude & Phase"
        raise StapeskitError.of("the columns", want, got, block.where, step)
    return found


def _frequency(block: Sheet) -> float:
    """Return the frequency of a FastScan block, Hz."""
    text = block.field_of(_FREQUENCY)
    match = _HERTZ.fullmatch(text)
    number = number_of(match[1]) if match else None
    if match is None or number is None:
        want, step = "one with a line Frequency: <f> Hz", "Export the bands of a FastScan with their header"
        raise StapeskitError.of("the header", want, shown(text) or "none", block.where, step)
    return number * HERTZ[f"{(match[2] or '').lower()}hz"]


def _indices(block: Sheet) -> list[str]:
    """Return the names of the points of a FastScan block."""
    low = [name.lower() for name in block.names]
    column = next((low.index(name) for name in ("index", *_POINT) if name in low), None)
    numbers = np.array([np.nan]) if column is None else block.numbers[:, column]
    if not np.all(numbers == np.round(numbers)) or len(np.unique(numbers)) < len(numbers):
        want, step = "one with a column Index of different whole numbers", "Export it again"
        raise StapeskitError.of("the table", want, shown(", ".join(block.names)), block.where, step)
    return [f"{number:.0f}" for number in numbers.tolist()]


def _positions(block: Sheet) -> tuple[Array, bool]:
    """Return positions (row, 3), m, NaN without columns of them, and whether their unit is stated."""
    low = [name.lower() for name in block.names]
    if not {"x", "y", "z"} <= set(low):
        return np.full((len(block.numbers), 3), np.nan), True
    places = [low.index(axis) for axis in "xyz"]
    labels = {plain(block.units[column]) for column in places}
    label = min(labels)
    if len(labels) > 1 or not (is_none(label) or label in LENGTHS):
        got, step = shown(", ".join(sorted(labels))), "Export them in metres"
        raise StapeskitError.of("the unit of X, Y, Z", "one length unit", got, block.where, step)
    return block.numbers[:, places] * (1.0 if is_none(label) else LENGTHS[label]), not is_none(label)


def _frequencies(block: Sheet) -> Array:
    """Return the first column of a per-point block, Hz."""
    unit = block.units[0].lower() or "hz"
    if not block.names[0].lower().startswith(_FREQUENCY) or unit not in HERTZ:
        got, step = shown(f"{block.names[0]} [{block.units[0]}]"), "Export spectra or frequency responses"
        raise StapeskitError.of("the first column", "Frequency [Hz]", got, block.where, step)
    freq = block.numbers[:, 0] * HERTZ[unit]
    if not np.all(freq >= 0.0) or np.any(np.diff(freq) <= 0.0) or np.any(np.isinf(freq)):
        want = "ascending and not negative"
        raise StapeskitError.of("the frequencies", want, "others", block.where, "Sort them")
    return np.asarray(freq)


def _position(text: str, where: Place) -> tuple[Array, bool]:
    """Read x, y, z behind the point index, m, and whether their unit is stated."""
    matches = [re.search(_COORDINATE.format(axis=axis), text, re.IGNORECASE) for axis in "xyz"]
    found = [match for match in matches if match]
    if len(found) < 3:
        return unknown_vector(), True
    numbers = [number_of(match[1].rstrip(",.")) for match in found]
    units = {match[2] for match in found if match[2]}
    if None in numbers or len(units) > 1:
        want = "three numbers, x = .. y = .. z = .."
        raise StapeskitError.of("the position of a point", want, shown(text), where, "Export it again")
    scale = LENGTHS[plain(min(units))] if units else 1.0
    return np.array(numbers, dtype=float) * scale, bool(units)

"""Read FastScan text exports of a scanning vibrometer: one file per frequency, one row per point.

The layout is known from programs that read it; no file of the vendor was available.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.psv.signals import (
    Signal,
    axes_notice,
    beam_of,
    chosen_order,
    frequency_hz,
    signals,
)
from legacy.kinematics.readers.psv.text_blocks import Block, fields_of, read_blocks
from legacy.kinematics.readers.recording import Recording, Recordings
from legacy.kinematics.readers.text import lines_of, shown
from legacy.kinematics.readers.unit_labels import is_none, length_scale
from legacy.kinematics.readers.value_checks import in_mm
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all
from legacy.stapeskit.warnings import Notice

_FREQUENCY = ("frequency", "frequenz", "fréquence")
# Positions written with four digits agree to this.
_SAME_PLACE_MM = 1e-3


@dataclass(frozen=True)
class _Line:
    """One file: frequency, points with positions (points, 3) in mm, and the signals of its axes."""

    freq_hz: float
    block: Block
    names: tuple[str, ...]
    positions_mm: Array
    signals: tuple[Signal, ...]
    stated: bool


def looks_like_fastscan(text: str) -> bool:
    """Return whether a text begins as one frequency of a FastScan export."""
    fields = fields_of(text)
    lines = [line for line in lines_of(text)[:40] if line.lower().startswith("index")]
    return bool(lines) and any(name in fields for name in _FREQUENCY)


def read(path: Path) -> Recordings:
    """Read a folder with one file per frequency, or one such file.

    Raises
    ------
    KinematicsError
        A file is cut short, has no frequency, no real and imaginary parts or another unit than motion; a
        frequency is there twice; a point has two positions.

    Notes
    -----
    Layout of a file: ``Source File Name``, ``Signal``, ``Band No.``, ``Frequency: <f> Hz``,
    ``Interpolated``, ``Filtered``; then the columns Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s]
    (or Real and Imaginary of a single head). Positions are in metres unless their column names a unit.
    """
    path = Path(path)
    lines = read_blocks(path, _line)
    order, notices = chosen_order((line.signals[0].unit.order for line in lines), path.name)
    lines = [line for line in lines if line.signals[0].unit.order == order]
    lines.sort(key=lambda line: line.freq_hz)
    faults = [*_find_duplicates(lines), *_several_scans(lines, path.name)]
    recordings = _recordings(lines, path.name, faults)
    notices += _treated_notices(lines, path.name)
    if any(len(line.signals) > 1 for line in lines):
        notices.append(axes_notice(path.name))
    stated = all(line.stated for line in lines)
    units = "positions as their columns say" if stated else "positions without unit, as metres"
    return Recordings(recordings, tuple(notices), f"coordinates of the scan, {units}", length_stated=stated)


def _line(block: Block) -> _Line:
    faults: list[Fault] = []
    freq = float("nan")
    name = next((name for name in _FREQUENCY if name in block.fields), None)
    if name is None:
        step = "Export the bands of a FastScan with their header"
        faults.append(Fault("the header", "one with a line Frequency: <f> Hz", "none", block.where, step))
    else:
        with collect_faults(faults):
            freq = frequency_hz(block.fields[name], block.where)
    places = {column.lower(): place for place, column in enumerate(block.columns)}
    numbers, positions, stated = np.empty(0), np.empty((0, 3)), True
    signals_read: tuple[Signal, ...] = ()
    with collect_faults(faults):
        numbers = _indices(block, places)
    with collect_faults(faults):
        positions, stated = _positions(block, places)
    with collect_faults(faults):
        signals_read = tuple(signals(block))
    raise_all(KinematicsError, faults)
    return _Line(freq, block, tuple(f"{n:.0f}" for n in numbers), positions, signals_read, stated)


def _indices(block: Block, places: dict[str, int]) -> Array:
    """Return the numbers of the points."""
    index = places.get("index", places.get("point index"))
    if index is None:
        step = "Export it again with the index of the points"
        got = shown(", ".join(block.columns))
        raise KinematicsError.of("the table", "one with a column Index", got, block.where, step)
    numbers = block.numbers[:, index]
    whole = np.isfinite(numbers) & (numbers == np.round(numbers))
    if not np.all(whole):
        got = ", ".join(f"{n:g}" for n in numbers[~whole][:5])
        raise KinematicsError.of("Index", "whole numbers", got, block.where, "Export it again")
    if len(np.unique(numbers)) < len(numbers):
        twice = [f"{n:g}" for n in np.unique(numbers) if np.sum(numbers == n) > 1][:5]
        got = ", ".join(twice) + " twice"
        raise KinematicsError.of("Index", "different in each row", got, block.where, "Keep one row")
    return np.asarray(numbers)


def _positions(block: Block, places: dict[str, int]) -> tuple[Array, bool]:
    """Return positions, mm, NaN without columns of them, and whether their unit is stated."""
    if not {"x", "y", "z"} <= set(places):
        return np.full((len(block.numbers), 3), np.nan), True
    columns = [places[axis] for axis in "xyz"]
    labels = {block.units[column] for column in columns}
    if len(labels) > 1 or (not is_none(min(labels)) and length_scale(min(labels)) is None):
        got = shown(", ".join(sorted(labels)))
        step = "Export the coordinates in metres"
        raise KinematicsError.of("the unit of X, Y, Z", "one length unit", got, block.where, step)
    label = min(labels)
    scale = 1.0 if is_none(label) else length_scale(label)
    return in_mm(block.numbers[:, columns], scale or 1.0), not is_none(label)


def _find_duplicates(lines: Sequence[_Line]) -> list[Fault]:
    """List the frequencies that two files hold."""
    faults = []
    for before, after in pairwise(lines):
        if after.freq_hz - before.freq_hz <= 1e-9 * after.freq_hz:
            step = "Put every excitation into a separate folder, and give all folders"
            thing = f"the frequency {after.freq_hz:g} Hz"
            faults.append(Fault(thing, "there once", f"{before.block.file} and {after.block.file}", "", step))
    return faults


def _several_scans(lines: Sequence[_Line], name: str) -> list[Fault]:
    """Refuse the frequencies of several measurements mixed in one folder."""
    scans: dict[str, str] = {}
    for line in lines:
        scans.setdefault(line.block.fields.get("source file name", ""), line.block.file)
    scans.pop("", None)
    if len(scans) < 2:
        return []
    got = " and ".join(f"{shown(scan)} ({file})" for scan, file in list(scans.items())[:4])
    step = "Put the files of every measurement into a separate folder"
    return [Fault("the source of the files", "one measurement", got, name, step)]


def _treated_notices(lines: Sequence[_Line], name: str) -> list[Notice]:
    """Warn of values that were interpolated or filtered, not measured."""
    marks = [
        key for key in ("interpolated", "filtered") if any(_yes(line.block.fields.get(key)) for line in lines)
    ]
    if not marks:
        return []
    text = (
        f"{name} was exported {' and '.join(marks)}: values were mixed between points, so that points do not "
        "err independently. Export the measured values."
    )
    return [Notice("values_smoothed", text)]


def _yes(value: str | None) -> bool:
    return value is not None and value.strip().lower() in ("yes", "ja", "oui", "1", "true")


def _recordings(lines: Sequence[_Line], name: str, faults: list[Fault]) -> tuple[Recording, ...]:
    """Turn rows at frequencies into spectra at points; report faults known before with those found here."""
    freq = np.array([line.freq_hz for line in lines])
    positions: dict[str, Array] = {}
    values: dict[tuple[str, str], NDArray[np.complex128]] = {}
    pers = {signal.unit.per for line in lines for signal in line.signals}
    if len(pers) > 1:
        step = "Export it again"
        faults.append(Fault("the unit", "one for all frequencies", ", ".join(sorted(pers)), name, step))
    for number, line in enumerate(lines):
        for row, point in enumerate(line.names):
            place = line.positions_mm[row]
            known = positions.setdefault(point, place)
            with np.errstate(invalid="ignore"):
                moved = np.any(np.abs(known - place) > _SAME_PLACE_MM + 1e-5 * np.abs(known))
            if moved:
                step = "Export all frequencies of one scan"
                got = f"{known.tolist()} and {place.tolist()} mm"
                thing = f"the position of point {point}"
                faults.append(Fault(thing, "one", got, line.block.where, step))
        for signal in line.signals:
            for row, point in enumerate(line.names):
                key = (point, signal.axis)
                if key not in values:
                    values[key] = np.full(len(lines), np.nan + 1j * np.nan)
                values[key][number] = signal.value[row]
    raise_all(KinematicsError, faults)
    order = lines[0].signals[0].unit.order
    rank = {point: place for place, point in enumerate(positions)}
    return tuple(
        Recording(
            point,
            freq,
            value,
            order,
            Place(name, detail=f"point {point}"),
            position_mm=positions[point],
            direction=beam_of(axis),
            per=min(pers),
        )
        for (point, axis), value in sorted(values.items(), key=lambda entry: rank[entry[0][0]])
    )

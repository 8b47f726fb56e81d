"""Read per-point text exports of a scanning vibrometer: one block, mostly one file, per point and signal.

The layout is known from programs that read it; no file of the vendor was available.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.psv.signals import axes_notice, beam_of, chosen_order, signals
from legacy.kinematics.readers.psv.text_blocks import Block, fields_of, read_blocks, value_of
from legacy.kinematics.readers.recording import Recording, Recordings, unknown_vector
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.unit_labels import length_scale
from legacy.kinematics.readers.value_checks import check_frequencies, in_mm
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, list_some, raise_all
from legacy.stapeskit.warnings import Notice

_POINT = ("point index", "punktindex", "punkt-index")
_COMPONENT = ("component", "komponente", "composante")
_FREQUENCY = ("frequency", "frequenz", "fréquence")
_TIME = ("time", "zeit", "temps")
_PLACE = r"{axis}\s*=?\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![A-Za-z])"
_AXIS = re.compile(r"^\s*(?:vib\s*)?([+-]?)([xyz])\s*$", re.IGNORECASE)
_IN_SIGNAL = re.compile(r"\bvib\s+([+-]?)([xyz])\b", re.IGNORECASE)


def looks_like_points(text: str) -> bool:
    """Return whether a text begins as a per-point export."""
    return any(name in fields_of(text) for name in _POINT)


def read(path: Path) -> Recordings:
    """Read a folder (with its folders) of per-point files, or one file.

    Raises
    ------
    KinematicsError
        A file is cut short, holds a time series, amplitudes without phase or another unit than motion, or a
        point is there twice.

    Notes
    -----
    Layout of a block: ``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``,
    ``Signal``, an empty line, the names of the columns (Frequency, Real, Imaginary), their units
    ([ Hz ], [ m/s ], [ m/s ]), the numbers. The direction is that of the column (Real X), else of the
    component; positions without unit are in metres.
    """
    path = Path(path)
    entries = read_blocks(path, lambda block: (block, *_recordings(block)), deep=True)
    stated = all(unit_stated for _, _, unit_stated in entries)
    named = [
        (recording, block.fields.get("source file name", "") or block.file)
        for block, recordings, _ in entries
        for recording in recordings
    ]
    chosen, notices = _one_quantity(named, path.name)
    axes = {(recording.point, recording.direction.tobytes()) for recording, _ in chosen}
    if len(axes) > len({point for point, _ in axes}):
        notices.append(axes_notice(path.name))
    units = "positions in stated units" if stated else "positions without unit, as metres"
    recordings, joined_notices = _by_source(chosen, path.name)
    return Recordings(
        recordings, (*notices, *joined_notices), f"coordinates of the scan, {units}", length_stated=stated
    )


def _recordings(block: Block) -> tuple[list[Recording], bool]:
    """Return the recordings of one block and whether the unit of its position is stated."""
    name = next((name for name in _POINT if name in block.fields), None)
    if name is None:
        step = "Leave other files out of the folder"
        raise KinematicsError.of("the header", "one with a line Point Index: <n>", "none", block.where, step)
    faults: list[Fault] = []
    text = block.fields[name]
    number = re.match(r"\s*(\d+)", text)
    if number is None:
        faults.append(Fault("the point index", "a number", shown(text), block.where))
    freq, signals_read = np.empty(0), []
    with collect_faults(faults):
        freq = _frequencies(block)
        signals_read = signals(block)
    position, stated = unknown_vector(), True
    if number is not None:
        with collect_faults(faults):
            position, stated = _position(text[number.end() :], block.where)
    raise_all(KinematicsError, faults)
    if number is None:
        return [], True
    recordings = []
    for signal in signals_read:
        axis = signal.axis or _axis(block)
        recordings.append(
            Recording(
                number[1],
                freq,
                signal.value,
                signal.unit.order,
                block.where,
                position_mm=position,
                direction=beam_of(axis),
                per=signal.unit.per,
            )
        )
    return recordings, stated


def _frequencies(block: Block) -> Array:
    """Return the first column, Hz."""
    first = block.columns[0].lower()
    if first.startswith(_TIME):
        step = (
            "Export spectra or frequency responses, or give the time series as a table with a column time_s"
        )
        raise KinematicsError.of("the export", "over frequency", "a time series", block.where, step)
    if not first.startswith(_FREQUENCY) or block.units[0].lower() not in ("hz", "khz", ""):
        got = shown(f"{block.columns[0]} [{block.units[0]}]")
        step = "Export spectra or frequency responses"
        raise KinematicsError.of("the first column", "Frequency [Hz]", got, block.where, step)
    with np.errstate(over="ignore"):
        freq = block.numbers[:, 0] * (1e3 if block.units[0].lower() == "khz" else 1.0)
    check_frequencies(freq, block.where)
    return np.asarray(freq)


def _position(text: str, where: Place | str) -> tuple[Array, bool]:
    """Read x, y, z behind the point index, mm, and whether their unit is stated."""
    matches = [re.search(_PLACE.format(axis=axis), text, re.IGNORECASE) for axis in "xyz"]
    if any(match is None for match in matches):
        return unknown_vector(), True
    numbers = [value_of(match[1].rstrip(",.")) for match in matches if match is not None]
    if None in numbers:
        want = "three numbers, x = .. y = .. z = .."
        raise KinematicsError.of("the position of a point", want, shown(text), where, "Export it again")
    units = {match[2] for match in matches if match is not None and match[2]}
    scale = length_scale(min(units)) if len(units) == 1 else 1.0
    return in_mm(np.array(numbers, dtype=float), scale or 1.0), len(units) == 1


def _axis(block: Block) -> str:
    """Return the axis that component or signal names, empty when none does."""
    stated = next((block.fields[name] for name in _COMPONENT if name in block.fields), "")
    match = _AXIS.match(stated)
    match = match or _IN_SIGNAL.search(block.fields.get("signal", ""))
    return "" if match is None else match[1].replace("+", "") + match[2].lower()


def _one_quantity(
    entries: list[tuple[Recording, str]], name: str
) -> tuple[list[tuple[Recording, str]], list[Notice]]:
    """Keep one quantity, velocity first, and one kind of reference, responses first."""
    order, notices = chosen_order((recording.order for recording, _ in entries), name)
    entries = [entry for entry in entries if entry[0].order == order]
    if len({bool(recording.per) for recording, _ in entries}) > 1:
        text = f"{name} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("function_chosen", text))
        entries = [entry for entry in entries if entry[0].per]
    return entries, notices


def _by_source(entries: list[tuple[Recording, str]], name: str) -> tuple[tuple[Recording, ...], list[Notice]]:
    """Name runs after the measurement that was exported, when a point was measured in several.

    Raises
    ------
    KinematicsError
        A point and direction is there twice from one measurement.
    """
    from dataclasses import replace

    def key(recording: Recording) -> tuple[str, bytes]:
        return recording.point, recording.direction.tobytes()

    counts = Counter(key(recording) for recording, _ in entries)
    if max(counts.values()) == 1:
        return tuple(recording for recording, _ in entries), _join_notices(entries, name)
    where_of: dict[tuple[object, ...], Place | str] = {}
    faults = []
    for recording, source in entries:
        place = (*key(recording), source)
        if place in where_of:
            step = "Put every excitation into a separate folder, and give all folders"
            thing = f"the signal of point {recording.point}"
            faults.append(Fault(thing, "there once", "two", f"{where_of[place]} and {recording.where}", step))
        where_of[place] = recording.where
    raise_all(KinematicsError, faults)
    return tuple(
        replace(recording, run=Path(source.replace("\\", "/")).stem) for recording, source in entries
    ), []


def _join_notices(entries: list[tuple[Recording, str]], name: str) -> list[Notice]:
    """Warn that points of several measurements were joined into one run."""
    sources = list(dict.fromkeys(source for _, source in entries))
    if len(sources) < 2 or len(sources) == len({recording.where for recording, _ in entries}):
        return []
    text = f"{name} holds points of {len(sources)} measurements ({list_some(sources, 4)}), taken as one run."
    return [Notice("sources_joined", text)]

"""Text exports of scanning vibrometers: FastScan (one table a frequency) and one table a point.

FastScan: ``Source File Name``, ``Signal``, ``Frequency: <f> Hz``, ``Interpolated``, ``Filtered``; columns
Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s], or Real and Imaginary of a single head. Per point:
``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``, ``Signal``; columns
Frequency, Real, Imaginary. Positions without a unit are in metres. The layouts are known from programs that
read them; no such file of the vendor was available.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kinematics.readers.recording import unknown_vector
from kinematics.readers.sheets import Sheet, number_of, refuse
from kinematics.readers.text import shown
from kinematics.readers.units import HERTZ, LENGTHS, is_none, plain
from stapeskit.arrays import Array
from stapeskit.faults import Fault, list_some, raise_all
from stapeskit.warnings import Notice

FREQUENCY = ("frequency", "frequenz", "fréquence")
POINT = ("point index", "punktindex", "punkt-index")
APART = "Put the files of every measurement and excitation into a folder of its own"

_COMPONENT = ("component", "komponente", "composante")
_SOURCE = ("source file name",)
_TREATMENTS = ("interpolated", "filtered")
_INDEX = ("index", *POINT)
_AXIS = re.compile(r"(?:^|\bvib)\s*(?:vib\s*)?([+-]?)([xyz])\b", re.IGNORECASE)
_COORDINATE = r"{axis}\s*=?\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![A-Za-z])"
_HERTZ = re.compile(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(k|M)?Hz\s*")
_SAME_PLACE_M = 1e-6  # positions written with four digits


@dataclass(frozen=True)
class PointTable:
    """A table over frequency and its header: point, position (3,), m, axis of the beam, source.

    Empty and NaN where nothing is said; ``length_stated``: whether the position has a unit.
    """

    sheet: Sheet
    point: str = ""
    position_m: Array = field(default_factory=unknown_vector)
    length_stated: bool = True
    axis: str = ""
    source: str = ""


def is_fastscan(sheet: Sheet) -> bool:
    """Return whether a table holds the points at one frequency."""
    return bool(sheet.field_of(FREQUENCY)) and any(name.lower() in _INDEX for name in sheet.names)


def is_of_point(sheet: Sheet) -> bool:
    """Return whether a table says which point it is of."""
    return any(name in sheet.fields for name in POINT)


def point_table(sheet: Sheet) -> PointTable:
    """Read the header above the table of a point.

    Raises
    ------
    StapeskitError
        No number of the point, or a position that cannot be read.
    """
    text = sheet.field_of(POINT)
    number = re.match(r"\s*(\d+)", text)
    if number is None:
        want, step = "one with a line Point Index: <n>", "Leave other files out of the folder"
        raise refuse(sheet, "the header", want, shown(text) or "none", step)
    match = _AXIS.search(sheet.field_of(_COMPONENT)) or _AXIS.search(sheet.field_of(("signal",)))
    axis = match[1].replace("+", "") + match[2].lower() if match else ""
    source = sheet.field_of(_SOURCE) or sheet.where.file
    found = [
        match
        for axis_name in "xyz"
        if (match := re.search(_COORDINATE.format(axis=axis_name), text[number.end() :], re.IGNORECASE))
    ]
    if len(found) < 3:
        return PointTable(sheet, number[1], axis=axis, source=source)
    numbers = [number_of(match[1].rstrip(",.")) for match in found]
    units = {match[2] for match in found if match[2]}
    if None in numbers or len(units) > 1:
        raise refuse(sheet, "the position of a point", "three numbers, x = .. y = .. z = ..", shown(text))
    scale = LENGTHS[plain(min(units)).lower()] if units else 1.0
    position = np.array(numbers, dtype=float) * scale
    return PointTable(sheet, number[1], position, bool(units), axis, source)


def turned_over(sheets: Sequence[Sheet]) -> list[PointTable]:
    """Return the tables of single frequencies as one table over frequency for each point.

    Raises
    ------
    StapeskitError
        Tables of several measurements, of other points or columns, without a frequency, or whose points have
        other positions.
    """
    first, file = sheets[0], sheets[0].where.file
    faults = []
    sources = list(dict.fromkeys(sheet.field_of(_SOURCE) for sheet in sheets))
    if len(sources) > 1:
        got = list_some(map(shown, sources), 4, " and ")
        faults.append(Fault("the source of the files", "one measurement", got, file, APART))
    names, positions, length_stated = _points(first)
    for sheet in sheets[1:]:
        others, places, _ = _points(sheet)
        if (sheet.names, sheet.units, others) != (first.names, first.units, names):
            step = "Export all frequencies of one scan in one way"
            faults.append(Fault("the tables", "of the same columns and points", "others", sheet.where, step))
            continue
        apart = np.abs(places - positions) > _SAME_PLACE_M + 1e-5 * np.abs(positions)
        faults += [
            Fault(f"the position of point {names[row]}", "one", "another one", sheet.where, "Export one scan")
            for row in np.flatnonzero(np.any(apart, axis=1)).tolist()
        ]
    freq = [_frequency(sheet) for sheet in sheets]
    place_of: dict[float, Sheet] = {}
    for sheet, one in zip(sheets, freq, strict=True):
        if place_of.setdefault(one, sheet) is not sheet:
            got = f"{place_of[one].where} and {sheet.where}"
            faults.append(Fault(f"the frequency {one:g} Hz", "there once", got, "", APART))
    raise_all(faults)
    numbers = np.stack([sheet.numbers for sheet in sheets])
    header, units = ("Frequency", *first.names), ("Hz", *first.units)
    return [
        PointTable(
            replace(first, names=header, units=units, numbers=np.column_stack([freq, numbers[:, row]])),
            point,
            positions[row],
            length_stated,
            source=sources[0],
        )
        for row, point in enumerate(names)
    ]


def treatments(sheets: Sequence[Sheet], file: str) -> list[Notice]:
    """Report values that were mixed between points."""
    yes = ("yes", "ja", "oui", "1")
    marks = [
        mark
        for mark in _TREATMENTS
        if any(sheet.fields.get(mark, "").strip().lower() in yes for sheet in sheets)
    ]
    text = (
        f"{file} was exported {' and '.join(marks)}: values were mixed between points, so that points do not "
        "err independently. Export the measured values."
    )
    return [Notice("file_read", text)] if marks else []


def _points(sheet: Sheet) -> tuple[list[str], Array, bool]:
    """Return names of the points, positions (row, 3), m, and whether their unit is stated."""
    low = [name.lower() for name in sheet.names]
    column = next((low.index(name) for name in _INDEX if name in low), None)
    numbers = np.array([np.nan]) if column is None else sheet.numbers[:, column]
    if not np.all(numbers == np.round(numbers)) or len(np.unique(numbers)) < len(numbers):
        want, got = "one with a column Index of different whole numbers", shown(", ".join(sheet.names))
        raise refuse(sheet, "the table", want, got, "Export it again")
    names = [f"{number:.0f}" for number in numbers.tolist()]
    if not {"x", "y", "z"} <= set(low):
        return names, np.full((len(names), 3), np.nan), True
    places = [low.index(axis) for axis in "xyz"]
    labels = {plain(sheet.units[column]) for column in places}
    label = min(labels)
    if len(labels) > 1 or not (is_none(label) or label in LENGTHS):
        got, step = shown(", ".join(sorted(labels))), "Export them in metres"
        raise refuse(sheet, "the unit of X, Y, Z", "one length unit", got, step)
    return names, sheet.numbers[:, places] * LENGTHS.get(label, 1.0), not is_none(label)


def _frequency(sheet: Sheet) -> float:
    """Return the frequency of the points, Hz."""
    text = sheet.field_of(FREQUENCY)
    match = _HERTZ.fullmatch(text)
    number = number_of(match[1]) if match else None
    if match is None or number is None:
        want, step = "one with a line Frequency: <f> Hz", "Export the bands of a FastScan with their header"
        raise refuse(sheet, "the header", want, shown(text) or "none", step)
    return number * HERTZ[f"{(match[2] or '').lower()}hz"]

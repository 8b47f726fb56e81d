"""Read text exports of scanning vibrometers: FastScan (one table a frequency) and one table a point.

FastScan: ``Source File Name``, ``Signal``, ``Frequency: <f> Hz``, ``Interpolated``, ``Filtered``; columns
Index, X, Y, Z, Real X [m/s] ... Imaginary Z [m/s], or Real and Imaginary of a single head. Per point:
``Source File Name``, ``Point Index: <n> [x = .. y = .. z = ..]``, ``Component``, ``Signal``; columns
Frequency, Real, Imaginary. Positions without a unit are in metres. The layouts are known from programs that
read them; no such file of the vendor was available.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.sheets import Sheet, sheets_of
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.text import export_files
from kinematics.readers.units import HERTZ, LENGTHS, is_none, plain
from kinematics.readers.wide import frequencies_of, left_out_notices, rows_of
from stapeskit.arrays import Array
from stapeskit.faults import Fault, collect_faults, raise_all
from stapeskit.frames import axis_vector
from stapeskit.tables import decoded
from stapeskit.warnings import Notice

_FREQUENCY = ("frequency", "frequenz", "fréquence")
_POINT = ("point index", "punktindex", "punkt-index", "index du point", "indice du point")
_COMPONENT = ("component", "komponente", "composante", "signal")
_INDEX = ("index", "indice", *_POINT)
_MIXED = ("interpolated", "filtered", "interpoliert", "gefiltert", "interpolé", "filtré")
_AXIS = re.compile(r"(?:^|\bvib)\s*(?:vib\s*)?([+-]?)([xyz])\b", re.IGNORECASE)
_PLACE = re.compile(
    r"\b([xyz])\s*=?\s*([+-]?\d[\d.,]*(?:e[+-]?\d+)?)\s*(m|mm|um|µm|cm)?(?![a-z])", re.IGNORECASE
)
_HERTZ = re.compile(r"\s*([+-]?[\d.,]+(?:e[+-]?\d+)?)\s*([kM]?Hz)\s*", re.IGNORECASE)
_SAME_PLACE_M = 1e-6  # positions written with four digits
_APART = "Put the files of every measurement and excitation into a folder of its own"


def is_fastscan(sheet: Sheet) -> bool:
    """Return whether a table holds the points at one frequency."""
    return bool(sheet.field_of(_FREQUENCY)) and any(name.lower() in _INDEX for name in sheet.names)


def is_of_point(sheet: Sheet) -> bool:
    """Return whether a table says which point it is of."""
    return any(name in sheet.fields for name in _POINT)


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a file, or a folder (with its folders) of exports; the first table says which they are.

    Raises
    ------
    StapeskitError
        Cells that are no numbers, missing columns or headers, tables of several scans; as `rows_of`.
    """
    path, faults = Path(path), list[Fault]()
    files = export_files(path) if path.is_dir() else [path]
    sheets = [sheet for file in files for sheet in sheets_of(decoded(file.read_bytes()), file.name, faults)]
    raise_all(faults)
    found = list[tuple[list[Row], bool]]()
    if is_fastscan(sheets[0]):
        found.append(_of_frequencies(sheets))
    else:
        for sheet in sheets:
            with collect_faults(faults):
                found.append(_of_point(sheet))
        raise_all(faults)
    rows, stated = tuple(row for some, _ in found for row in some), all(stated for _, stated in found)
    units = "positions in stated units" if stated else "positions without unit, as metres"
    notices = (*_notices(sheets, rows, path.name), *left_out_notices(sheets))
    return Recording(path.name, rows, notices, f"coordinates of the scan, {units}", length_stated=stated)


def _of_frequencies(sheets: Sequence[Sheet]) -> tuple[list[Row], bool]:
    """Return the beams of tables of single frequencies, and whether the unit of positions is stated.

    Tables of other sources, columns, points or positions than the first are refused.
    """
    first = sheets[0]
    names, positions, stated = _points(first)
    freq, faults = np.array([_frequency(sheet) for sheet in sheets]), list[Fault]()
    for sheet in sheets:
        others, places, _ = _points(sheet)
        differences = {
            "another source": sheet.fields.get("source file name") != first.fields.get("source file name"),
            "other columns": (sheet.names, sheet.units) != (first.names, first.units),
            "other points": others != names,
            "other positions": others == names
            and not np.allclose(places, positions, 1e-5, _SAME_PLACE_M, equal_nan=True),
        }
        if got := ", ".join(text for text, true in differences.items() if true):
            faults.append(Fault("the tables", "of one scan", got, sheet.where, _APART))
    raise_all(faults)
    beams, _ = rows_of(replace(first, numbers=np.stack([sheet.numbers for sheet in sheets])), freq)
    rows = []
    for k, name in enumerate(names):
        for row in beams:
            coherence = None if row.coherence is None else np.asarray(row.coherence)[:, k]
            found = replace(row, point=name, position_m=positions[k], value=row.value[:, k])
            rows.append(replace(found, coherence=coherence))
    return rows, stated


def _of_point(sheet: Sheet) -> tuple[list[Row], bool]:
    """Return the beams of the table of a point, and whether the unit of its position is stated."""
    text = sheet.field_of(_POINT)
    number = re.match(r"\s*(\d+)", text)
    if number is None:
        want, step = "one with a line Point Index: <n>", "Leave other files out of the folder"
        raise sheet.refuse("the header", want, text, step)
    position, stated = unknown_vector(), True
    found = {match[1].lower(): match for match in _PLACE.finditer(text, number.end())}
    if len(found) == 3:
        numbers = [sheet.number(found[axis][2].rstrip(",.")) for axis in "xyz"]
        units = {match[3] for match in found.values() if match[3]}
        if None in numbers or len(units) > 1:
            raise sheet.refuse("the position of a point", "three numbers, x = .. y = .. z = ..", text)
        position = np.array(numbers, dtype=float) * (LENGTHS[plain(min(units)).lower()] if units else 1.0)
        stated = bool(units)
    fields = (sheet.fields[name] for name in _COMPONENT if name in sheet.fields)
    axis = next((match for field in fields if (match := _AXIS.search(field))), None)
    direction = axis_vector(axis[1].replace("+", "") + axis[2].lower()) if axis else None
    rows = []
    for row in rows_of(sheet, *frequencies_of(sheet))[0]:
        if direction is not None and np.any(np.isnan(row.direction)):
            row = replace(row, direction=direction)
        rows.append(replace(row, point=number[1], position_m=position, lines=sheet.lines))
    return rows, stated


def _points(sheet: Sheet) -> tuple[list[str], Array, bool]:
    """Return names of the points, positions (row, 3), m, and whether their unit is stated."""
    low = [name.lower() for name in sheet.names]
    column = next((low.index(name) for name in _INDEX if name in low), None)
    numbers = np.array([np.nan]) if column is None else sheet.numbers[:, column]
    if not np.all(numbers == np.round(numbers)) or len(np.unique(numbers)) < len(numbers):
        want, got = "one with a column Index of different whole numbers", ", ".join(sheet.names)
        raise sheet.refuse("the table", want, got, "Export it again")
    names = [f"{number:.0f}" for number in numbers.tolist()]
    if not {"x", "y", "z"} <= set(low):
        return names, np.full((len(names), 3), np.nan), True
    places = [low.index(axis) for axis in "xyz"]
    labels = {plain(sheet.units[column]) for column in places}
    label = min(labels)
    if len(labels) > 1 or not (is_none(label) or label in LENGTHS):
        got, step = ", ".join(sorted(labels)), "Export them in metres"
        raise sheet.refuse("the unit of X, Y, Z", "one length unit", got, step)
    return names, sheet.numbers[:, places] * LENGTHS.get(label, 1.0), not is_none(label)


def _frequency(sheet: Sheet) -> float:
    """Return the frequency of the points, Hz."""
    text = sheet.field_of(_FREQUENCY)
    match = _HERTZ.fullmatch(text)
    number = sheet.number(match[1]) if match else None
    if match is None or number is None:
        want = "one with a line Frequency: <f> Hz, without a mark of thousands"
        step = "Export the bands of a FastScan with their header"
        raise sheet.refuse("the header", want, text, step)
    return number * HERTZ[match[2].lower()]


def _notices(sheets: Sequence[Sheet], rows: Sequence[Row], file: str) -> list[Notice]:
    """Report values that were mixed between points, and x, y, z at a point, computed from several beams."""
    marks = [sheet.fields.get(mark, "") for mark in _MIXED for sheet in sheets]
    mixed = (
        f"{file} was exported interpolated or filtered: values were mixed between points, so that points do "
        "not err independently. Export the measured values."
    )
    computed = (
        f"{file} holds x, y, z computed from several beams: their noise is correlated, and larger across the "
        "beams than along them; sd and verdicts, which take channels as independent, are approximate. Export "
        "the single heads with their directions where possible."
    )
    treated = any(mark.strip().lower() in ("yes", "ja", "oui", "1") for mark in marks)
    several = len({row.beam for row in rows}) > len({row.point for row in rows})
    notices = ((treated, "file_read", mixed), (several, "axes_from_beams", computed))
    return [Notice(code, text) for true, code, text in notices if true]

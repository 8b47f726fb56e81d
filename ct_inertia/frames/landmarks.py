"""Read landmarks in scan coordinates (mm, LPS): 3D Slicer .mrk.json and .fcsv, CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.frames.anatomy import LANDMARK_NAMES
from ct_inertia.scan.place import mm_per_unit
from stapeskit.arrays import Array
from stapeskit.documents import read_json
from stapeskit.faults import Fault, Place, StapeskitError, raise_all
from stapeskit.tables import read_table

Found = Iterator[tuple[str, Any, Array, Place]]
"""Label, position as the file has it, factors (3,) that lead it to LPS in mm, and place of a point."""

_LPS_FROM = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}
_NUMBERED = {"0": "RAS", "1": "LPS"}  # as .fcsv writes coordinate systems
_FCSV_COLUMNS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label")
_COLUMNS = ("x_mm", "y_mm", "z_mm")
_AGAIN = "Set the point again, or correct the file"


def read_landmarks(path: Path) -> dict[str, Array]:
    """Read a file of named points and return them (3,) in scan coordinates, mm.

    ``.mrk.json`` or ``.json`` and ``.fcsv`` are of 3D Slicer, LPS or RAS as the file says; ``.csv`` has the
    columns name, x_mm, y_mm, z_mm (scan coordinates). Names are returned in lower case with underscores;
    ``footplate_center`` reads as ``footplate_centre``.

    Raises
    ------
    StapeskitError
        The file is of another kind, damaged, in no unit of length, names a point twice, or holds none of
        the names anterior, posterior, superior, inferior, head, footplate_centre.

    Notes
    -----
    RAS to LPS turns the signs of x and y. An .fcsv without a coordinate system is RAS, as Slicer wrote it
    before version 4.11; there 0 means RAS and 1 LPS.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None or not path.is_file():
        step = "Save the landmarks in one of these formats"
        raise StapeskitError.of("--landmarks", "a .mrk.json, .fcsv or .csv file", path.name, next_step=step)
    named: dict[str, Array] = {}
    faults: list[Fault] = []
    for label, values, to_lps, where in reader(path, faults):
        name = "_".join(label.strip().lower().replace("-", " ").replace("_", " ").split())
        name = name.replace("center", "centre")
        if name in named:
            got, step = "a second point of that name", "Rename or remove one of the two"
            faults.append(Fault(f"landmark {label}", "named once", got, where, step))
        named[name] = to_lps * _point(values)
        if not np.all(np.isfinite(named[name])):
            faults.append(Fault(f"landmark {label}", "at three finite numbers", values, where, _AGAIN))
    raise_all(faults)
    if not named.keys() & set(LANDMARK_NAMES):
        expected, got = f"named out of {', '.join(LANDMARK_NAMES)}", ", ".join(named) or "no point at all"
        step = "Rename them in the program they were set in"
        raise StapeskitError.of("the landmarks", expected, got, path.name, step)
    return named


def _signs(system: object, file: str) -> Array:
    """Return the signs (3,) that lead to LPS."""
    written = _NUMBERED.get(str(system), str(system)).upper()
    if written not in _LPS_FROM:
        step = "Save the markups in one of the two"
        raise StapeskitError.of("the coordinate system", "LPS or RAS", system, file, step)
    return _LPS_FROM[written]


def _slicer_json(path: Path, _: list[Fault]) -> Found:
    try:
        for markups in read_json(path, "the landmark file", "Save the markups as .mrk.json")["markups"]:
            to_lps = _to_lps_mm(markups, path.name)
            for number, control in enumerate(markups.get("controlPoints", []), 1):
                if control.get("positionStatus", "defined") == "defined":
                    where = Place(path.name, "control point", (number,))
                    yield str(control.get("label", "")), control.get("position"), to_lps, where
    except (KeyError, TypeError, AttributeError) as fault:
        got, step = "a file without a list of markups", "Save the markups as .mrk.json"
        expected = "a markups file of 3D Slicer"
        raise StapeskitError.of("the landmark file", expected, got, path.name, step) from fault


def _to_lps_mm(markups: dict[str, Any], file: str) -> Array:
    """Return the factors (3,) that lead the points of one list to LPS in mm."""
    units = markups.get("coordinateUnits", "mm")
    names = {str(unit) for unit in (units if isinstance(units, list) else [units])}
    factor = mm_per_unit(names.pop()) if len(names) == 1 else None
    if factor is None:
        raise StapeskitError.of(
            "coordinateUnits", "one unit of length", units, file, "Save the markups in mm"
        )
    return _signs(markups.get("coordinateSystem", "LPS"), file) * factor


def _point(values: Any) -> Array:
    """Return a position (3,); NaN where it is none."""
    try:
        point = np.array([float(value) for value in values])
    except (TypeError, ValueError, OverflowError):
        point = np.zeros(0)
    return point if point.shape == (3,) else np.full(3, np.nan)


def _slicer_fcsv(path: Path, faults: list[Fault]) -> Found:
    to_lps, columns = _LPS_FROM["RAS"], list(_FCSV_COLUMNS)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as fault:
        step = "Save the list again in 3D Slicer"
        raise StapeskitError.of("the landmark file", "text in UTF-8", "another", path.name, step) from fault
    for number, line in enumerate(lines, 1):
        where = Place(path.name, "line", (number,))
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            if key.strip().lower() == "coordinatesystem":
                to_lps = _signs(value.strip(), path.name)
            elif key.strip().lower() == "columns":
                columns = [column.strip() for column in value.split(",")]
        elif line.strip():
            row = next(csv.reader([line]))  # labels with commas are quoted
            cells = dict(zip(columns, row, strict=False))
            if "label" in cells:
                yield cells["label"], [cells.get(axis) for axis in "xyz"], to_lps, where
            else:
                step, thing = "Save the list again in 3D Slicer", "a row of an .fcsv file"
                faults.append(Fault(thing, "complete up to its label", line, where, step))


def _csv(path: Path, faults: list[Fault]) -> Found:
    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        missing = [column for column in ("name", *_COLUMNS) if column not in header]
        if missing:
            got, step = f"no {', '.join(missing)}", "Add the missing columns"
            raise StapeskitError.of("the columns", "name, x_mm, y_mm, z_mm", got, file, step)
        return set(_COLUMNS), {"name"}

    table = read_table(path, choose)
    faults += table.faults
    names, unread = table.texts["name"], table.invalid_rows()
    points = np.column_stack([table.numbers[column] for column in _COLUMNS])
    for row in np.flatnonzero(~unread).tolist():
        label = names.names[names.codes[row]] if names.codes[row] >= 0 else ""
        yield label, points[row].tolist(), _LPS_FROM["LPS"], table.where(row)


READERS: dict[str, Callable[[Path, list[Fault]], Found]] = {
    ".json": _slicer_json,
    ".fcsv": _slicer_fcsv,
    ".csv": _csv,
}
"""Reader of landmarks by the suffix of their file; it adds the faults of rows that hold no point."""

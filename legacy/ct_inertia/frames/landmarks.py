"""Read landmarks in scan coordinates (mm, LPS): 3D Slicer .mrk.json and .fcsv, MeshLab .pp, CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import LANDMARK_NAMES
from legacy.ct_inertia.readers.checks import mm_per_unit
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.json_toml import parse_json
from legacy.stapeskit.tables.csv_table import read_table

Named = list[tuple[str, Array]]

_LPS_FROM = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}
_COLUMNS = ("x_mm", "y_mm", "z_mm")


def read_landmarks(path: Path) -> dict[str, Array]:
    """Read a file of named points and return them in scan coordinates.

    Parameters
    ----------
    path : Path
        ``.mrk.json`` or ``.json`` and ``.fcsv`` (3D Slicer; LPS or RAS as the file says), ``.pp`` (MeshLab,
        in the coordinates of the mesh), ``.csv`` with columns name, x_mm, y_mm, z_mm (scan coordinates).

    Returns
    -------
    dict of str to ndarray, (3,)
        mm. Names in lower case with underscores; ``footplate_center`` reads as ``footplate_centre``.

    Raises
    ------
    CtInertiaError
        The file is missing, of another kind, damaged, in no unit of length, names a point twice, or holds
        none of the names anterior, posterior, superior, inferior, head, footplate_centre.

    Notes
    -----
    RAS to LPS turns the signs of x and y. An .fcsv without a coordinate system is RAS, as Slicer wrote it
    before version 4.11; there 0 means RAS and 1 LPS.
    """
    path = Path(path)
    if not path.is_file():
        raise CtInertiaError.of("the landmark file", "an existing file", path, next_step="Check the path")
    name = path.name.lower()
    readers: dict[str, Callable[[Path], Named]] = {
        ".json": _slicer_json,
        ".fcsv": _slicer_fcsv,
        ".pp": _meshlab,
        ".csv": _csv,
    }
    reader = next((read for ending, read in readers.items() if name.endswith(ending)), None)
    if reader is None:
        raise CtInertiaError.of(
            "the landmark file",
            "a .mrk.json, .fcsv, .pp or .csv file",
            path.name,
            next_step="Save the landmarks in one of these formats",
        )
    return _check(reader(path), path.name)


def normal_name(name: str) -> str:
    """Return a landmark's name in the one spelling that is compared."""
    spelled = "_".join(name.strip().lower().replace("-", " ").replace("_", " ").split())
    return spelled.replace("center", "centre")


def _check(points: Iterable[tuple[str, Array]], file: str) -> dict[str, Array]:
    by_name: dict[str, Array] = {}
    faults = []
    for label, point in points:
        name = normal_name(label)
        if not np.all(np.isfinite(point)):
            faults.append(
                Fault(
                    f"landmark {label}",
                    "three finite numbers",
                    point.tolist(),
                    file,
                    next_step="Set the point again, or correct the file",
                )
            )
        elif name in by_name:
            faults.append(
                Fault(
                    f"landmark {label}",
                    "named once",
                    "a second point of that name",
                    file,
                    next_step="Rename or remove one of the two",
                )
            )
        by_name[name] = point
    raise_all(CtInertiaError, faults)
    if not by_name.keys() & set(LANDMARK_NAMES):
        raise CtInertiaError.of(
            "the landmarks",
            f"named out of {', '.join(LANDMARK_NAMES)}",
            ", ".join(by_name) or "no point at all",
            file,
            "Rename them in the program they were set in",
        )
    return by_name


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as fault:
        raise CtInertiaError.of(
            "the landmark file",
            "text in UTF-8",
            "another encoding",
            path.name,
            next_step="Save the file again as UTF-8",
        ) from fault


def _signs(system: object, file: str) -> Array:
    """Return the signs (3,) that lead to LPS."""
    written = {"0": "RAS", "1": "LPS"}.get(str(system), str(system)).upper()
    if written not in _LPS_FROM:
        raise CtInertiaError.of(
            "the coordinate system",
            "LPS or RAS",
            system,
            file,
            next_step="Save the markups in one of the two",
        )
    return _LPS_FROM[written]


def _slicer_json(path: Path) -> Named:
    try:
        return [
            (str(control.get("label", "")), signs * _point(control.get("position"), path.name))
            for markups in parse_json(_text(path))["markups"]
            for signs in [_markups_signs(markups, path.name)]
            for control in markups.get("controlPoints", [])
            if control.get("positionStatus", "defined") == "defined"
        ]
    except CtInertiaError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as fault:
        raise CtInertiaError.of(
            "the landmark file",
            "a markups file of 3D Slicer",
            "a file without a list of markups",
            path.name,
            "Save the markups as .mrk.json",
        ) from fault


def _markups_signs(markups: dict[str, Any], file: str) -> Array:
    """Return what leads the points of one list to LPS in mm."""
    factor = _mm_per_unit(markups.get("coordinateUnits", "mm"), file)
    return _signs(markups.get("coordinateSystem", "LPS"), file) * factor


def _mm_per_unit(units: object, file: str) -> float:
    names = {str(unit) for unit in (units if isinstance(units, list) else [units])}
    factor = mm_per_unit(names.pop()) if len(names) == 1 else None
    if factor is None:
        raise CtInertiaError.of(
            "coordinateUnits", "one unit of length", units, file, next_step="Save the markups in mm"
        )
    return factor


def _point(values: Any, file: str) -> Array:
    try:
        point = np.array([float(value) for value in values])
    except (TypeError, ValueError, OverflowError):
        point = np.zeros(0)
    if point.shape != (3,):
        raise CtInertiaError.of(
            "a landmark's position",
            "three numbers",
            values,
            file,
            next_step="Set the point again, or correct the file",
        )
    return point


def _slicer_fcsv(path: Path) -> Named:
    signs = _LPS_FROM["RAS"]
    columns = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label"]
    points: Named = []
    for line in _text(path).splitlines():
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            if key.strip().lower() == "coordinatesystem":
                signs = _signs(value.strip(), path.name)
            elif key.strip().lower() == "columns":
                columns = [column.strip() for column in value.split(",")]
            continue
        if not line.strip():
            continue
        # Labels with commas are quoted.
        cells = dict(zip(columns, next(csv.reader([line])), strict=False))
        if "label" not in cells:
            raise CtInertiaError.of(
                "a row of an .fcsv file",
                "complete up to its label",
                line,
                path.name,
                next_step="Save the list again in 3D Slicer",
            )
        position = _point([cells.get(axis) for axis in "xyz"], path.name)
        points.append((cells["label"], signs * position))
    return points


def _meshlab(path: Path) -> Named:
    from xml.etree import ElementTree

    try:
        root = ElementTree.fromstring(_text(path))
    except ElementTree.ParseError as fault:
        raise CtInertiaError.of(
            "the landmark file",
            "XML of MeshLab",
            fault,
            path.name,
            next_step="Save the points again in MeshLab",
        ) from fault
    return [
        (point.get("name", ""), _point([point.get(axis) for axis in "xyz"], path.name))
        for point in root.iter("point")
        if point.get("active", "1") != "0"
    ]


def _csv(path: Path) -> Named:
    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        missing = [column for column in ("name", *_COLUMNS) if column not in header]
        if missing:
            raise CtInertiaError.of(
                "the columns",
                "name, x_mm, y_mm, z_mm",
                f"no {', '.join(missing)}",
                file,
                next_step="Add the missing columns",
            )
        return set(_COLUMNS), {"name"}

    table = read_table(path, choose)
    raise_all(CtInertiaError, table.faults)
    names = table.texts["name"]
    points = np.column_stack([table.numbers[column] for column in _COLUMNS])
    return [
        (names.names[code] if code >= 0 else "", point)
        for code, point in zip(names.codes, points, strict=True)
    ]

"""Read points measured on a surface: [name,] x_mm, y_mm, z_mm [, sd_mm] [, body]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import mirror_sign
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.kinematics.tidy.points_csv import finite_faults, require, sd_faults
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.tables.csv_table import Table, read_table

_PLACE = ("x_mm", "y_mm", "z_mm")


def read_surface_points(path: Path, kind: str) -> Cloud:
    """Read the points of one kind, ``plate`` or ``bone``, in vibrometer coordinates.

    A column ``body`` chooses the rows of that kind; the column ``name`` or ``point`` names them, else their
    line does.

    Raises
    ------
    KinematicsError
        A column is missing, a cell is no finite number, a name is repeated, an sd_mm is not positive
        or stated for some points only, or no row is of that kind; all faults are listed.
    """

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, _PLACE, file)
        return {*_PLACE, *({"sd_mm"} & set(header))}, {"name", "point", "body"} & set(header)

    table = read_table(path, choose)
    rows = _rows(table, kind)
    faults = [*table.faults, *finite_faults(table, _PLACE)]
    names = _names(table, rows, faults)
    sd = table.numbers.get("sd_mm")
    if sd is not None:
        faults += sd_faults(table, sd)
        sd = None if np.all(np.isnan(sd[rows])) else sd[rows]
    if sd is not None:
        step = "Fill it in, or leave the column out"
        faults += [
            Fault(
                "sd_mm", "stated for all points or for none", "an empty cell", table.where(int(rows[k])), step
            )
            for k in np.flatnonzero(np.isnan(sd))
        ]
    raise_all(KinematicsError, faults)
    places = np.column_stack([table.numbers[name][rows] for name in _PLACE])
    return Cloud(names, places, sd, kind)


def mirrored(cloud: Cloud, axis: str) -> Cloud:
    """Return points with one axis of left-handed coordinates reversed.

    Raises
    ------
    KinematicsError
        The axis is not x, y or z.
    """
    return replace(cloud, points_mm=cloud.points_mm * np.array(mirror_sign(axis)))


def _rows(table: Table, kind: str) -> np.ndarray:
    if "body" not in table.texts:
        return np.arange(len(table))
    column = table.texts["body"]
    words = [column.names[code].lower() if code >= 0 else "" for code in column.codes]
    rows = np.flatnonzero(np.array(words) == kind)
    if not len(rows):
        step = f"Name the body {kind} in the rows of these points, or leave the column body out"
        got = ", ".join(column.names) or "empty cells"
        raise KinematicsError.of("the column body", f"{kind} in some rows", got, table.file, step)
    return rows


def _names(table: Table, rows: np.ndarray, faults: list[Fault]) -> tuple[str, ...]:
    column = table.texts.get("name") or table.texts.get("point")
    if column is None:
        return tuple(f"line {int(table.lines[row])}" for row in rows)
    names = [column.names[column.codes[row]] if column.codes[row] >= 0 else "" for row in rows]
    for place, name in enumerate(names):
        if not name or name in names[:place]:
            got = f"{name} again" if name else "an empty cell"
            where = table.where(int(rows[place]))
            faults.append(Fault("the name of a point", "given, and different", got, where, "Name it"))
    return tuple(names)

"""Read the positions of measurement points: body, point, x_mm, y_mm, z_mm [, sd_mm]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.tables.csv_table import Table, read_table
from legacy.stapeskit.units import FARTHEST_MM, NEAREST_MM

_POSITION = ("x_mm", "y_mm", "z_mm")


@dataclass(frozen=True)
class Points:
    """Positions (3,), mm, and their standard deviations, mm (NaN when not stated), by body and point."""

    file: str
    positions: Mapping[tuple[str, str], Array]
    sd_mm: Mapping[tuple[str, str], float]


def read_points(path: Path) -> Points:
    """Read a points file.

    Raises
    ------
    KinematicsError
        A column is missing, a cell is no finite number, a name is empty, a point is repeated, or an
        sd_mm is not positive; all faults are listed.
    """

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, ("body", "point", *_POSITION), file)
        return {*_POSITION, *({"sd_mm"} & set(header))}, {"body", "point"}

    table = read_table(path, choose)
    body, point = table.texts["body"], table.texts["point"]
    xyz = np.column_stack([table.numbers[name] for name in _POSITION])
    sd = table.numbers.get("sd_mm", np.full(len(table), np.nan))
    faults = [*table.faults, *finite_faults(table, _POSITION), *sd_faults(table, sd)]
    positions: dict[tuple[str, str], Array] = {}
    spread: dict[tuple[str, str], float] = {}
    for row in range(len(table)):
        if body.codes[row] < 0 or point.codes[row] < 0:
            faults.append(
                Fault(
                    "body and point",
                    "names",
                    "an empty cell",
                    table.where(row),
                    "Name the body and the point",
                )
            )
            continue
        key = (body.names[body.codes[row]], point.names[point.codes[row]])
        if key in positions:
            old, new = positions[key].tolist(), xyz[row].tolist()
            what = "the same point again" if old == new else f"a second position, {new} after {old}"
            faults.append(
                Fault(
                    f"point {key[1]} of body {key[0]}", "listed once", what, table.where(row), "Keep one row"
                )
            )
        positions[key], spread[key] = xyz[row], float(sd[row])
    raise_all(KinematicsError, faults)
    return Points(table.file, positions, spread)


def require(header: Sequence[str], names: Sequence[str], file: str) -> None:
    """Refuse a header that lacks a column.

    Raises
    ------
    KinematicsError
        Names every missing column.
    """
    missing = [name for name in names if name not in header]
    if missing:
        raise KinematicsError.of(
            "the table",
            "complete",
            f"no column {', '.join(missing)}",
            Place(file, "line", (1,)),
            other_table(header, names) or _step(missing, header),
        )


def _step(missing: Sequence[str], header: Sequence[str]) -> str:
    """Return what to do where columns are missing: their unit may be another one."""
    stems = {name.removesuffix("_mm") for name in missing if name.endswith("_mm")}
    others = [name for name in header if name.rpartition("_")[0] in stems]
    if others:
        return f"Convert {', '.join(others)} to mm, and name their unit in the header"
    return "Add the column, or correct its name in the header"


def other_table(header: Sequence[str], names: Sequence[str]) -> str:
    """Return what to do where a header is that of another table than the one with columns ``names``.

    Files that were exchanged on the command line lack many columns, and none of them should be added. Empty
    where the header is of the right table, or of none that is known.
    """
    tables = {
        "vibrometer readings": ({"freq_hz"}, "give it first, without an option"),
        "fiducials": ({"x_ref_mm"}, f"give it with {named('fiducials')}"),
        "points": ({"body", "point", *_POSITION}, f"give it with {named('points')}"),
    }
    for kind, (columns, where) in tables.items():
        if columns <= set(header):
            return "" if columns <= set(names) else f"It looks like a table of {kind}: {where}"
    return ""


def finite_faults(table: Table, columns: Sequence[str]) -> list[Fault]:
    """List the cells of number columns that are empty, infinite or, in mm, impossibly far."""
    faults = []
    for name in columns:
        reported = table.invalid_rows(name)
        for row in np.flatnonzero(~np.isfinite(table.numbers[name]) & ~reported):
            value = table.numbers[name][row]
            got = "an empty or NaN cell" if np.isnan(value) else f"{value:g}"
            step = "Give the number, or leave the row out"
            faults.append(Fault(name, "a finite number", got, table.where(int(row)), step))
        if name.endswith("_mm"):
            values = table.numbers[name]
            for row in np.flatnonzero((np.abs(values) > FARTHEST_MM) & np.isfinite(values)):
                want, got = f"within {FARTHEST_MM:g} mm", f"{values[row]:g}"
                faults.append(Fault(name, want, got, table.where(int(row)), "Give the position in mm"))
    return faults


def sd_faults(table: Table, sd: Array, name: str = "sd_mm") -> list[Fault]:
    """List the standard deviations that are not positive and finite, or beyond all positions."""
    rows = np.flatnonzero((sd < NEAREST_MM) | (sd > FARTHEST_MM))
    step = "Give the standard deviation per coordinate in mm"
    wanted = {True: f"within {NEAREST_MM:g} and {FARTHEST_MM:g} mm", False: "positive and finite"}
    return [
        Fault(name, wanted[bool(0.0 < sd[row] < np.inf)], f"{sd[row]:g}", table.where(int(row)), step)
        for row in rows
    ]

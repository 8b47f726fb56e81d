"""Positions of the points of a vibrometer table, from the table, a points file, or both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.tidy.ldv_checks import each
from legacy.kinematics.tidy.ldv_columns import POSITION, Columns
from legacy.kinematics.tidy.points_csv import Points
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place
from legacy.stapeskit.tables.csv_table import Table
from legacy.stapeskit.warnings import Notice

Index = NDArray[np.intp]
# Rounding of written coordinates.
_SAME_MM = 1e-6


def check_positions(
    table: Table, columns: Columns, listed: Points | None, place: Index, first: Index, faults: list[Fault]
) -> tuple[Array, Array]:
    """Return the position of every point and its standard deviation, and add the faults.

    Parameters
    ----------
    listed : Points or None
        What a points file says.
    place : ndarray, (rows,)
        Number of the point of each row.
    first : ndarray, (points,)
        First row of each point.
    faults : list of str
        Added to: cells that are empty, points with two positions or with none.

    Returns
    -------
    positions : ndarray, (points, 3), mm
    spread : ndarray, (points,), mm
        NaN where not stated.
    """
    body, point = table.texts["body"], table.texts["point"]
    positions, spread = np.full((len(first), 3), np.nan), np.full(len(first), np.nan)

    def key_of(row: int) -> tuple[str, str]:
        return body.names[body.codes[row]], point.names[point.codes[row]]

    if columns.positions:
        rows = np.column_stack([table.numbers[name] for name in POSITION])
        bad = ~np.all(np.isfinite(rows), axis=1)
        if np.any(bad):
            for axis, name in enumerate(POSITION):
                empty = ~np.isfinite(rows[:, axis]) & ~table.invalid_rows(name)
                step = "Give all three coordinates"
                _each_position(empty, name, rows, table, faults, step)
        good = np.flatnonzero(~bad)
        first = first.copy()
        first[place[good][::-1]] = good[::-1]
        positions = rows[first]
        with np.errstate(invalid="ignore"):
            moved = np.any(np.abs(rows - positions[place]) > _SAME_MM, axis=1) & ~bad
        for row in np.flatnonzero(moved).tolist():
            number = place[row]
            if body.codes[row] < 0 or point.codes[row] < 0:
                continue
            old = f"{positions[number].tolist()} in line {table.lines[first[number]]}"
            faults.append(
                _two_positions_fault(key_of(row), old, rows[row], table.where(row, ", ".join(POSITION)))
            )
    if listed is not None:
        for number, row in enumerate(first.tolist()):
            if body.codes[row] < 0 or point.codes[row] < 0:
                continue
            key = key_of(row)
            known = listed.positions.get(key)
            if known is None:
                faults.append(_not_listed(key, listed, table.where(row, "point")))
            elif columns.positions and np.max(np.abs(positions[number] - known)) > _SAME_MM:
                old = f"{known.tolist()} in {listed.file}"
                faults.append(_two_positions_fault(key, old, positions[number], table.where(row)))
            else:
                positions[number], spread[number] = known, listed.sd_mm[key]
    return positions, spread


def unmeasured_notice(table: Table, listed: Points | None) -> list[Notice]:
    """Report bodies of the points file that have no row in the table."""
    if listed is None:
        return []
    absent = sorted({body for body, _ in listed.positions} - set(table.texts["body"].names))
    if not absent:
        return []
    text = f"{listed.file} lists points of {', '.join(absent)}, of which {table.file} has no row."
    return [Notice("bodies_not_measured", text)]


def alike_notice(table: Table) -> list[Notice]:
    """Report names of bodies that differ in upper and lower case only."""
    groups: dict[str, list[str]] = {}
    for name in table.texts["body"].names:
        groups.setdefault(name.casefold(), []).append(name)
    listed = [" and ".join(names) for names in groups.values() if len(names) > 1]
    if not listed:
        return []
    text = f"{'; '.join(listed)} differ in upper and lower case only and were taken as different bodies."
    return [Notice("names_alike", text)]


def _each_position(
    bad: NDArray[np.bool_], name: str, rows: Array, table: Table, faults: list[Fault], step: str
) -> None:
    each(
        bad,
        ", ".join(POSITION),
        "finite numbers",
        lambda r: f"{rows[r].tolist()}, {name} missing or infinite",
        table,
        faults,
        step,
    )


def _not_listed(key: tuple[str, str], listed: Points, where: Place) -> Fault:
    bodies = {name for name, _ in listed.positions}
    wanted = (key[0].casefold(), key[1].casefold())
    near = [f"{b} {p}" for b, p in listed.positions if (b.casefold(), p.casefold()) == wanted]
    got, step = "no row of that name there", f"Add it to {listed.file}, or leave its rows out"
    if near:
        got, step = f"no row of that name there, but {near[0]}", "Write both names alike"
    elif key[0] not in bodies:
        got = f"no point of that body there, only of {', '.join(sorted(bodies)[:6])}"
    return Fault(f"point {key[1]} of body {key[0]}", f"listed in {listed.file}", got, where, step)


def _two_positions_fault(key: tuple[str, str], old: str, new: Array, where: Place) -> Fault:
    return Fault(
        f"the position of point {key[1]} of body {key[0]}",
        "one",
        f"{old} and {new.tolist()}",
        where,
        "Name the points apart, or correct the position",
    )

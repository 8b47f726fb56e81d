"""Read the positions of measurement points: body, point, x_mm, y_mm, z_mm [, sd_mm]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kinematics.readers.text import plain_name
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, raise_all
from stapeskit.units import FARTHEST_MM, NEAREST_MM

if TYPE_CHECKING:
    from stapeskit.tables import Table

POSITION = ("x_mm", "y_mm", "z_mm")


@dataclass(frozen=True)
class Points:
    """Positions (3,), m, and their standard deviations, m (NaN where not stated), by body and point."""

    file: str
    positions_m: Mapping[tuple[str, str], Array]
    sd_m: Mapping[tuple[str, str], float]

    def bodies_of(self, point: str) -> list[str]:
        """Return the bodies that have a point of a name."""
        return [body for body, other in self.positions_m if other == point]

    def key_of(self, body: str, point: str) -> tuple[str, str] | None:
        """Return the key of a point, in this file's spelling where one alone differs in case or blanks."""
        if (body, point) in self.positions_m:
            return body, point
        wanted = [name.strip().casefold() for name in (body, point)]
        alike = [key for key in self.positions_m if [name.casefold() for name in key] == wanted]
        return alike[0] if len(alike) == 1 else None


def read_points(path: Path) -> Points:
    """Read a points file.

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, a name is empty, a point is repeated, or an sd_mm is
        not positive; all faults are listed.
    """
    from stapeskit.tables import read_table

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, ("body", "point", *POSITION), file)
        return {*POSITION, *({"sd_mm"} & set(header))}, {"body", "point"}

    table = read_table(Path(path), choose)
    xyz = np.column_stack([table.numbers[name] for name in POSITION])
    sd = table.numbers.get("sd_mm", np.full(len(table), np.nan))
    faults = [*table.faults, *position_faults(table, POSITION), *sd_faults(table)]
    positions: dict[tuple[str, str], Array] = {}
    spread: dict[tuple[str, str], float] = {}
    for row in range(len(table)):
        key = (text_of(table, "body", row), plain_name(text_of(table, "point", row)))
        if not all(key):
            step = "Name the body and the point"
            faults.append(Fault("body and point", "names", "an empty cell", table.where(row), step))
        elif key in positions:
            thing, got = f"point {key[1]} of body {key[0]}", "the same point again"
            faults.append(Fault(thing, "listed once", got, table.where(row), "Keep one row"))
        positions[key], spread[key] = 1e-3 * xyz[row], 1e-3 * float(sd[row])
    raise_all(faults)
    return Points(table.file, positions, spread)


def text_of(table: Table, name: str, row: int) -> str:
    """Return a cell of a text column; empty where the column or the text is missing."""
    column = table.texts.get(name)
    return "" if column is None else (*column.names, "")[column.codes[row]]


def require(header: Sequence[str], names: Sequence[str], file: str) -> None:
    """Refuse a header that lacks columns.

    Raises
    ------
    StapeskitError
        Names every missing column.
    """
    if missing := [name for name in names if name not in header]:
        step = "Add the column in the unit of its name, correct its name, or give the table it belongs to"
        got, where = f"no column {', '.join(missing)}", Place(file, "line", (1,))
        raise StapeskitError.of("the table", "complete", got, where, step)


def cell_faults(
    table: Table, name: str, low: float, high: float, step: str, must: bool = False
) -> list[Fault]:
    """List the numbers of a column outside of a range, and with ``must`` its cells without a number."""
    cells = table.numbers[name]
    bad = (cells < low) | (cells > high)
    if must:
        bad |= np.isnan(cells) & ~table.invalid_rows(name)
    got = [f"{cell:g}" if cell == cell else "an empty or NaN cell" for cell in cells[bad].tolist()]
    want = f"from {low:g} to {high:g}"
    return [
        Fault(name, want, text, table.where(row, name), step)
        for row, text in zip(np.flatnonzero(bad).tolist(), got, strict=True)
    ]


def position_faults(table: Table, columns: Sequence[str]) -> list[Fault]:
    """List the cells of columns in mm that are empty, infinite or impossibly far."""
    step = "Give the number in mm, or leave the row out"
    return [
        fault
        for name in columns
        for fault in cell_faults(table, name, -FARTHEST_MM, FARTHEST_MM, step, must=True)
    ]


def sd_faults(table: Table) -> list[Fault]:
    """List the standard deviations in mm that are not positive and finite, or beyond all positions."""
    step = "Give the standard deviation per coordinate in mm"
    known = "sd_mm" in table.numbers
    return cell_faults(table, "sd_mm", NEAREST_MM, FARTHEST_MM, step) if known else []

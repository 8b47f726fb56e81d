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
from stapeskit.units import FARTHEST_MM, LARGEST, NEAREST_MM

if TYPE_CHECKING:
    from stapeskit.tables import Table

POSITION = ("x_mm", "y_mm", "z_mm")
REFERENCE = ("x_ref_mm", "y_ref_mm", "z_ref_mm")

_MM = "Give the number in mm, or leave the row out"
_NUMBERS = {
    **dict.fromkeys((*POSITION, *REFERENCE), (-FARTHEST_MM, FARTHEST_MM, _MM)),
    "sd_mm": (NEAREST_MM, FARTHEST_MM, "Give the standard deviation per coordinate in mm"),
    "sensitivity": (1.0 / LARGEST, LARGEST, "Give the factor from the numbers of the file to unit"),
}
"""Columns of numbers with their range, and what to do about others."""
_TEXTS = ("body", "point", "name", "frame", "channel", "role", "dir", "unit", "run", "file")


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


def read_named(
    path: Path, needed: Sequence[str], optional: Sequence[str], texts: Sequence[str] = _TEXTS
) -> tuple[Table, list[Fault]]:
    """Read columns of a table by their names, and list the numbers that cannot be; needed ones must be there.

    Raises
    ------
    StapeskitError
        A needed column is missing; all are named.
    """
    from stapeskit.tables import read_table

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        if missing := [name for name in needed if name not in header]:
            step = "Add the column in the unit of its name, correct its name, or give the table it belongs to"
            got, where = f"no column {', '.join(missing)}", Place(file, "line", (1,))
            raise StapeskitError.of("the table", "complete", got, where, step)
        used = {*needed, *optional} & set(header)
        return used - set(texts), used & set(texts)

    table = read_table(Path(path), choose)
    faults = list(table.faults)
    for name in (name for name in _NUMBERS if name in table.numbers):
        faults += cell_faults(table, name, *_NUMBERS[name], must=name in needed)
    return table, faults


def read_points(path: Path) -> Points:
    """Read a points file.

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, a name is empty, a point is repeated, or an sd_mm is
        not positive; all faults are listed.
    """
    table, faults = read_named(path, ("body", "point", *POSITION), ("sd_mm",))
    xyz = np.column_stack([table.numbers[name] for name in POSITION])
    sd = table.numbers.get("sd_mm", np.full(len(table), np.nan))
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

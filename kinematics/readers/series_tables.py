"""Tables beside time series: the beam, point and unit of each channel, and the steps of a stepped sine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kinematics.readers.facts import direction_of
from kinematics.readers.points import require, text_of
from kinematics.readers.recording import SI_UNITS, Channel, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.units import MOTIONS, is_none, motion_unit, plain
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all

if TYPE_CHECKING:
    from stapeskit.tables import Table

ROLES = ("response", "reference", "ignore")
_NUMBERS = ("dir_x", "dir_y", "dir_z", "x_mm", "y_mm", "z_mm", "sensitivity")
_TEXTS = ("channel", "role", "body", "point", "dir", "unit", "run", "file")


@dataclass(frozen=True)
class Listed:
    """One row of the table of channels: ``scale`` leads from the numbers of the file to SI, or to ``per``."""

    name: str
    role: str
    file: str
    scale: float
    per: str
    channel: Channel


def read_channels(path: Path) -> list[Listed]:
    """Read a table of channels.

    Raises
    ------
    StapeskitError
        A column is missing, a role, unit, sensitivity or direction cannot be read, or a channel is listed
        twice; all faults with their lines.
    """
    table = table_of(path, ("channel", "unit"), _NUMBERS, _TEXTS)
    faults = list(table.faults)
    listed = [_listed(table, row, faults) for row in range(len(table))]
    keys = [(row.name, row.file, row.channel.point) for row in listed]
    faults += [
        Fault(f"channel {key[0]}", "listed once", "it again", table.where(number), "Keep one row")
        for number, key in enumerate(keys)
        if key in keys[:number]
    ]
    raise_all(faults)
    return [row for row in listed if row.role != "ignore"]


def _listed(table: Table, row: int, faults: list[Fault]) -> Listed:
    """Read one row of the table of channels; what is wrong is added to the faults."""
    texts = {name: text_of(table, name, row) for name in _TEXTS}
    numbers = {name: table.numbers.get(name, np.full(row + 1, np.nan))[row] for name in _NUMBERS}
    where = table.where(row)
    role = texts["role"].lower() or "response"
    if role not in ROLES or not texts["channel"]:
        got = shown(f"{texts['channel']} {role}")
        faults.append(Fault("channel and role", f"a name, and one of {', '.join(ROLES)}", got, where))
    factor = 1.0 if np.isnan(numbers["sensitivity"]) else float(numbers["sensitivity"])
    if not 0.0 < factor < np.inf:
        faults.append(Fault("sensitivity", "a positive number", f"{factor:g}", where))
    unit = motion_unit(texts["unit"])
    unit = None if unit is None or unit.per else unit
    direction = unknown_vector()
    if role == "response":
        direction = np.array([numbers[name] for name in _NUMBERS[:3]])
        with collect_faults(faults):
            direction = direction_of(texts["dir"], where, "dir") if texts["dir"] else direction
    wanted = MOTIONS if role == "response" and unit is None else ""
    wanted = "the unit of the reference" if role == "reference" and is_none(texts["unit"]) else wanted
    if wanted:
        step = "Give the unit of the numbers times the sensitivity, e.g. m/s, Pa or V"
        faults.append(
            Fault("the unit of unit", f"one of {wanted}", shown(texts["unit"]) or "none", where, step)
        )
    channel = Channel(
        plain_name(texts["point"]),
        texts["body"],
        texts["run"],
        order=unit.order if unit else 1,
        direction=direction,
        where=where,
        position_m=1e-3 * np.array([numbers[name] for name in _NUMBERS[3:6]]),
    )
    scale = factor * (unit.scale if unit else 1.0)
    per = SI_UNITS[unit.order] if unit else plain(texts["unit"])
    return Listed(texts["channel"], role, texts["file"], scale, per, channel)


def reference_of(listed: Sequence[Listed], wanted: str, table: str) -> Listed | None:
    """Return the reference that the table or the user names; None without one.

    Raises
    ------
    StapeskitError
        There are several, or not the one that is asked for.
    """
    references = [
        row for row in listed if (row.name.lower() == wanted.lower() if wanted else row.role == "reference")
    ]
    names = list(dict.fromkeys(row.name for row in references))
    if len(names) > 1 or (wanted and not names):
        got = ", ".join(names) or wanted
        step = "Choose one by --reference-channel, or ignore the others"
        raise StapeskitError.of("the reference", "one channel of the table", got, table, step)
    return references[0] if references else None


def read_steps(path: Path) -> list[tuple[float, float, float]]:
    """Read a table of steps: start_s, stop_s, freq_hz.

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, a step ends before it starts, or a frequency is not
        positive.
    """
    columns = ("start_s", "stop_s", "freq_hz")
    table = table_of(path, columns, columns)
    start, stop, freq = (table.numbers[name] for name in columns)
    good = (stop > start) & (freq > 0.0) & np.isfinite(start + stop + freq)
    want = "three finite numbers, the stop later than the start, the frequency positive"
    raise_all(
        [
            *table.faults,
            *(
                Fault("a step", want, f"{start[k]:g} to {stop[k]:g} s at {freq[k]:g} Hz", table.where(k))
                for k in np.flatnonzero(~good).tolist()
            ),
        ]
    )
    return list(zip(start.tolist(), stop.tolist(), freq.tolist(), strict=True))


def table_of(path: Path, required: Sequence[str], numbers: Sequence[str], texts: Sequence[str] = ()) -> Table:
    """Read the known columns that a table has; the caller raises its faults.

    Raises
    ------
    StapeskitError
        A required column is missing.
    """
    from stapeskit.tables import read_table

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, required, file)
        return set(numbers) & set(header), set(texts) & set(header)

    return read_table(Path(path), choose)

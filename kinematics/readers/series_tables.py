"""Tables beside time series: the beam, point and unit of each channel, and the steps of a stepped sine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kinematics.readers.facts import SeriesFacts
from kinematics.readers.points import require
from kinematics.readers.recording import Channel, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.units import is_none, motion_unit, plain, unit_fault
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import axis_vector

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
    from stapeskit.tables import read_table

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, ("channel", "unit"), file)
        return set(_NUMBERS) & set(header), set(_TEXTS) & set(header)

    table = read_table(Path(path), choose)
    faults = list(table.faults)
    listed = [_listed(table, row, faults) for row in range(len(table))]
    keys = [(row.name, row.file, row.channel.point) for row in listed]
    for number, key in enumerate(keys):
        if key in keys[:number]:
            faults.append(
                Fault(f"channel {key[0]}", "listed once", "it again", table.where(number), "Keep one row")
            )
    raise_all(faults)
    return [row for row in listed if row.role != "ignore"]


def _listed(table: Table, row: int, faults: list[Fault]) -> Listed:
    """Read one row of the table of channels; what is wrong is added to the faults."""
    texts = {
        name: one.names[one.codes[row]] if one.codes[row] >= 0 else "" for name, one in table.texts.items()
    }
    numbers = {name: float(values[row]) for name, values in table.numbers.items()}
    where = table.where(row)
    role = texts.get("role", "").lower() or "response"
    if role not in ROLES or not texts["channel"]:
        got = shown(role) if texts["channel"] else "an empty cell"
        faults.append(Fault("channel and role", f"a name, and one of {', '.join(ROLES)}", got, where))
    factor = numbers.get("sensitivity", np.nan)
    factor = 1.0 if np.isnan(factor) else factor
    if not 0.0 < factor < np.inf:
        faults.append(Fault("sensitivity", "a positive number", f"{factor:g}", where))
    unit = motion_unit(texts["unit"])
    if role == "response" and (unit is None or unit.per):
        step = "Give the unit of the numbers times the sensitivity, e.g. m/s"
        faults.append(unit_fault(shown(texts["unit"]), ("unit",), where, step))
    elif role == "reference" and is_none(texts["unit"]):
        faults.append(Fault("unit", "the unit of the reference, e.g. Pa, V or m/s", "an empty cell", where))
    direction = unknown_vector()
    if role == "response" and texts.get("dir"):
        axis = axis_vector(texts["dir"])
        direction = direction if axis is None else axis
        if axis is None:
            faults.append(Fault("dir", "x, y, z, -x, -y or -z", shown(texts["dir"]), where))
    elif role == "response":
        direction = np.array([numbers.get(name, np.nan) for name in _NUMBERS[:3]])
        length = float(np.linalg.norm(direction))
        if abs(length - 1.0) > 1e-3:
            step = "Divide the direction by its length"
            faults.append(
                Fault("dir_x, dir_y, dir_z", "a unit vector (within 1e-3)", f"{length:g}", where, step)
            )
            direction = unknown_vector()
    position = 1e-3 * np.array([numbers.get(name, np.nan) for name in _NUMBERS[3:6]])
    channel = Channel(
        plain_name(texts.get("point", "")), texts.get("body", ""), texts.get("run", ""),
        order=unit.order if unit else 1, position_m=position, direction=direction, where=where,
    )  # fmt: skip
    scale = factor * (unit.scale if unit is not None and not unit.per else 1.0)
    per = ("m", "m/s", "m/s2")[unit.order] if unit is not None and not unit.per else plain(texts["unit"])
    return Listed(texts["channel"], role, texts.get("file", ""), scale, per, channel)


def reference_of(listed: Sequence[Listed], how: SeriesFacts) -> Listed | None:
    """Return the reference that the table or the user names; None without one.

    Raises
    ------
    StapeskitError
        There are several, or not the one that is asked for.
    """
    wanted = how.reference_channel
    references = [
        r for r in listed if (r.name.lower() == wanted.lower() if wanted else r.role == "reference")
    ]
    names = list(dict.fromkeys(row.name for row in references))
    if len(names) > 1 or (wanted and not names):
        got = ", ".join(names) or wanted
        step = "Choose one by --reference-channel, or ignore the others"
        raise StapeskitError.of("the reference", "one channel of the table", got, how.channels.name, step)
    return references[0] if references else None


def read_steps(path: Path) -> list[tuple[float, float, float]]:
    """Read a table of steps: start_s, stop_s, freq_hz.

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, a step ends before it starts, or a frequency is not
        positive.
    """
    from stapeskit.tables import read_table

    columns = ("start_s", "stop_s", "freq_hz")

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, columns, file)
        return set(columns), set()

    table = read_table(Path(path), choose)
    faults = list(table.faults)
    start, stop, freq = (table.numbers[name] for name in columns)
    for row in np.flatnonzero(
        ~((stop > start) & (freq > 0.0) & np.isfinite(stop) & np.isfinite(freq))
    ).tolist():
        got = f"{start[row]:g} to {stop[row]:g} s at {freq[row]:g} Hz"
        want = "three finite numbers, the stop later than the start, the frequency positive"
        faults.append(Fault("a step", want, got, table.where(row)))
    raise_all(faults)
    return [(float(a), float(b), float(f)) for a, b, f in zip(start, stop, freq, strict=True)]

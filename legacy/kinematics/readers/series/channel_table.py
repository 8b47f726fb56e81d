"""The channel table of time series: the beam, point and body of each column.

``channels.csv``, one row a channel::

    channel, role, body, point, dir | dir_x, dir_y, dir_z, unit | sensitivity
    [, x_mm, y_mm, z_mm] [, run] [, file]

``channel`` is the column or variable; ``role`` is ``response``, ``reference`` or ``ignore``. ``unit`` says
what the numbers are (``mm/s``, ``um``, ``g``; any unit for a reference: ``Pa``, ``V``); ``sensitivity`` says
it for voltages, with its unit: ``5 mm/s/V`` of a vibrometer, ``100 mV/g`` of an accelerometer. An empty
``point`` says that the rows of a two-dimensional variable are points 1, 2, ...; with a point they are
repeated records of it, which are averaged. ``file`` restricts a row to one of several files.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.text import plain_text
from legacy.kinematics.readers.unit_labels import MOTIONS, motion_unit, plain
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, raise_all
from legacy.stapeskit.frames import axis_vector
from legacy.stapeskit.tables.csv_table import Table, read_table

ROLES = ("response", "reference", "ignore")
_NUMBERS = ("dir_x", "dir_y", "dir_z", "x_mm", "y_mm", "z_mm")
_TEXTS = ("channel", "role", "body", "point", "dir", "unit", "sensitivity", "run", "file")
_SI = ("m", "m/s", "m/s2")


@dataclass(frozen=True)
class Channel:
    """One row of the table.

    Attributes
    ----------
    name : str
        Column or variable.
    role : str
        ``response`` or ``reference``.
    direction : ndarray, (3,)
        Unit vector towards the laser head; NaN for a reference and where not stated.
    position_mm : ndarray, (3,)
        NaN when not stated.
    scale : float
        Factor from the numbers of the file to SI, or to ``unit``.
    order : int
        0 displacement, 1 velocity, 2 acceleration; -1 for a reference that is no motion.
    unit : str
        In which the scaled numbers are.
    where : Place or str
        Place for messages.
    """

    name: str
    role: str
    body: str
    point: str
    run: str
    file: str
    direction: Array
    position_mm: Array
    scale: float
    order: int
    unit: str
    where: Place | str


def read_channels(path: Path) -> tuple[Channel, ...]:
    """Read a channel table.

    Raises
    ------
    KinematicsError
        A column is missing, a role, unit, sensitivity or direction cannot be read, a channel is listed
        twice, or there is no response; all faults are listed with their lines.
    """

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        if "channel" not in header or not {"unit", "sensitivity"} & set(header):
            missing = "channel" if "channel" not in header else "unit (or sensitivity)"
            step = "Give channel, role, body, point, dir and unit or sensitivity"
            raise KinematicsError.of(
                "the channel table", f"with a column {missing}", "none", Place(file, "line", (1,)), step
            )
        return set(_NUMBERS) & set(header), set(_TEXTS) & set(header)

    table = read_table(Path(path), choose)
    faults = list(table.faults)
    channels = [_channel(table, row, faults) for row in range(len(table))]
    where_of: dict[tuple[str, str, str], Place | str] = {}
    for channel in channels:
        key = (channel.name, channel.file, channel.point)
        if key in where_of:
            faults.append(
                Fault(f"channel {channel.name}", "listed once", "it again", channel.where, "Keep one row")
            )
        where_of[key] = channel.where
    if not faults and not any(channel.role == "response" for channel in channels):
        faults.append(Fault("the channel table", "a table of at least one response", "none", table.file))
    raise_all(KinematicsError, faults)
    return tuple(channel for channel in channels if channel.role != "ignore")


def _channel(table: Table, row: int, faults: list[Fault]) -> Channel:
    texts = {
        name: column.names[column.codes[row]] if column.codes[row] >= 0 else ""
        for name, column in table.texts.items()
    }
    where = table.where(row)
    name, role = texts.get("channel", ""), texts.get("role", "").lower() or "response"
    if not name:
        faults.append(Fault("channel", "the name of a column or variable", "an empty cell", where))
    if role not in ROLES:
        faults.append(Fault("role", ", ".join(ROLES), plain_text(role), where))
    scale, order, unit = 1.0, -1, ""
    if role != "ignore":
        scale, order, unit = _unit(texts, role, where, faults)
    direction = np.full(3, np.nan)
    if role == "response":
        direction = _direction(texts, table, row, where, faults)
    position = _read_vector(table, row, ("x_mm", "y_mm", "z_mm"))
    if np.any(np.isinf(position)) or np.sum(np.isnan(position)) in (1, 2):
        faults.append(Fault("x_mm, y_mm, z_mm", "three finite numbers or empty", "others", where))
    return Channel(
        name,
        role,
        texts.get("body", ""),
        texts.get("point", ""),
        texts.get("run", ""),
        texts.get("file", ""),
        direction,
        position,
        scale,
        order,
        unit,
        where,
    )


def _read_vector(table: Table, row: int, names: tuple[str, str, str]) -> Array:
    return np.array([table.numbers[name][row] if name in table.numbers else np.nan for name in names])


def _direction(
    texts: dict[str, str], table: Table, row: int, where: Place | str, faults: list[Fault]
) -> Array:
    short = texts.get("dir", "").lower()
    if short:
        axis = axis_vector(short)
        if axis is None:
            faults.append(Fault("dir", "x, y, z, -x, -y or -z", plain_text(short), where))
            return np.full(3, np.nan)
        return axis
    vector = _read_vector(table, row, ("dir_x", "dir_y", "dir_z"))
    length = float(np.linalg.norm(vector))
    if np.all(np.isnan(vector)):
        return vector
    if not abs(length - 1.0) < 1e-3:
        step = "Divide the direction by its length"
        faults.append(Fault("dir_x, dir_y, dir_z", "a unit vector (within 1e-3)", vector, where, step))
        return np.full(3, np.nan)
    return vector / length


def _unit(
    texts: dict[str, str], role: str, where: Place | str, faults: list[Fault]
) -> tuple[float, int, str]:
    """Return factor, order and unit of a channel's numbers."""
    sensor_text, unit, factor = texts.get("sensitivity", ""), texts.get("unit", ""), 1.0
    if sensor_text:
        sensor = sensitivity(sensor_text)
        if sensor is None:
            step = "Write it with its unit: 5 mm/s/V (of a vibrometer) or 100 mV/g (of an accelerometer)"
            faults.append(
                Fault(
                    "sensitivity",
                    "a number with volts in its unit",
                    f'"{plain_text(sensor_text)}"',
                    where,
                    step,
                )
            )
            return 1.0, -1, ""
        factor, of_it = sensor
        if unit and plain(unit) != plain(of_it):
            step = "Leave one of them out"
            faults.append(Fault("unit and sensitivity", "of one unit", f"{unit} and {of_it}", where, step))
        unit = of_it
    motion = motion_unit(unit)
    if motion is not None and not motion.per:
        return factor * motion.scale, motion.order, _SI[motion.order]
    if role == "response" or not unit:
        got = f'"{plain_text(unit)}"' if unit else "an empty cell"
        want = "; ".join(MOTIONS) if role == "response" else "the unit of the reference, e.g. Pa, V or mm/s"
        faults.append(Fault("unit", want, got, where))
    return factor, -1, plain(unit)


def sensitivity(text: str) -> tuple[float, str] | None:
    """Read ``5 mm/s/V`` or ``100 mV/g`` as the factor from volts to the unit, and that unit.

    None when there is no positive number, or volts are neither the first nor the last unit.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*(\S.*)", text)
    if match is None:
        return None
    try:
        number = float(match[1])
    except ValueError:
        return None
    rest = plain(match[2])
    if not (np.isfinite(number) and number > 0.0):
        return None
    first = re.fullmatch(r"(m|u)?V/(.+)", rest)
    if first is not None:
        return 1.0 / (number * {"m": 1e-3, "u": 1e-6, None: 1.0}[first[1]]), first[2].strip("()")
    last = re.fullmatch(r"(.+)/(m|u)?V", rest)
    if last is not None:
        return number / {"m": 1e-3, "u": 1e-6, None: 1.0}[last[2]], last[1].strip("()")
    return None

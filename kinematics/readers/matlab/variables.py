"""Variables of MATLAB and HDF5 files as the parts of a signal: values, units, names, places, directions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError
from kinematics.readers.containers.matlab_file import describe
from kinematics.readers.matlab.mapping import Layout, Signal, stacked, usd_direction
from kinematics.readers.recording import from_parts, unknown_vector
from kinematics.readers.text import shown
from kinematics.readers.unit_labels import LENGTHS, MOTIONS, MotionUnit, motion_unit
from kinematics.readers.value_checks import in_mm
from stapeskit.arrays import Array
from stapeskit.frames import axis_vector

LENGTH_END = r"_(mm|um|m)$"


def variable(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> Any:
    """Return a variable; dots in its name reach into structs.

    Raises
    ------
    KinematicsError
        There is none; the variables of the file are listed.
    """
    value: Any = space
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            step = f"It holds {describe(dict(tree))}"
            raise KinematicsError.of(f"the variable {name}", "in the file", "no such one", where, step)
        value = value[part]
    return value


def reals(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> Array:
    """Return an array of real numbers.

    Raises
    ------
    KinematicsError
        No numbers, or complex ones.
    """
    value = _numbers(space, name, where, tree)
    if np.iscomplexobj(value):
        step = "Say which variable is what in a mapping"
        raise KinematicsError.of(f"the variable {name}", "real numbers", "complex ones", where, step)
    return value.astype(float)


def _numbers(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> NDArray[Any]:
    value = stacked(variable(space, name, where, tree))
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fciub" or value.size == 0:
        step = "Say which variable is what in a mapping"
        raise KinematicsError.of(f"the variable {name}", "an array of numbers", "something else", where, step)
    return value


def _shaped(values: NDArray[Any], count: int, name: str, where: str) -> NDArray[Any]:
    """Return values as (point, F, beam)."""
    if values.ndim == 1:
        values = values[None]
    if values.ndim == 2:
        values = values[:, :, None]
    if values.ndim == 3 and values.shape[1] != count and values.shape[0] == count:
        values = np.swapaxes(values, 0, 1)
    if values.ndim != 3 or values.shape[1] != count or values.shape[2] not in (1, 3):
        got = " x ".join(map(str, values.shape if values.shape[-1] != 1 else values.shape[:-1]))
        want = f"points x {count}, as many columns as frequencies"
        raise KinematicsError.of(f"the variable {name}", want, got, where)
    return values


def values_of(
    space: Mapping[str, Any], signal: Signal, count: int, where: str, tree: Mapping[str, Any]
) -> NDArray[np.complex128]:
    """Return the complex values of a signal, (point, F, beam), in its unit.

    Raises
    ------
    KinematicsError
        Real numbers alone, or another shape.
    """
    if signal.value_re:
        parts = [reals(space, name, where, tree) for name in (signal.value_re, signal.value_im)]
        shaped = [_shaped(part, count, signal.value_re, where) for part in parts]
        if shaped[0].shape != shaped[1].shape:
            want = f"as large as {signal.value_re}"
            raise KinematicsError.of(signal.value_im, want, "another size", where)
        return from_parts(shaped[0], shaped[1])
    values = _numbers(space, signal.value, where, tree)
    if not np.iscomplexobj(values):
        if values.ndim == 2 and values.shape[1] == 2 * count:
            values = from_parts(values[:, 0::2], values[:, 1::2])
        else:
            step = "Export Real & Imag., not a magnitude: without phase there is no motion"
            raise KinematicsError.of(f"the variable {signal.value}", "complex", "real numbers", where, step)
    return np.asarray(_shaped(values, count, signal.value, where), dtype=complex)


def unit_of(
    space: Mapping[str, Any], signal: Signal, name: str, where: str, tree: Mapping[str, Any]
) -> MotionUnit:
    """Return the unit that is stated, or that the signal description names.

    Raises
    ------
    KinematicsError
        None is known, or the signal is a power.
    """
    label = signal.unit.removeprefix("=")
    if not label and signal.usd:
        usd = variable(space, signal.usd, where, tree)
        if isinstance(usd, dict):
            power = np.asarray(usd.get("PowerSignal", 0))
            if power.size == 1 and power.dtype.kind in "fiub" and bool(power.reshape(-1)[0]):
                step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
                raise KinematicsError.of(name, "an amplitude spectrum", "a power", where, step)
            label = str(usd.get("YUnit", ""))
    unit = motion_unit(label)
    if unit is None:
        got = shown(label) if label else "none"
        step = 'Give it as unit = "m/s" in a mapping'
        raise KinematicsError.of(f"the unit of {name}", "; ".join(MOTIONS), got, where, step)
    return unit


def names_of(
    space: Mapping[str, Any], layout: Layout, count: int, where: str, tree: Mapping[str, Any], point: str
) -> list[str]:
    """Return the names of the points, one a row.

    Raises
    ------
    KinematicsError
        Others than one different name for each row.
    """
    if not layout.points:
        return [point] if point and count == 1 else [str(k) for k in range(1, count + 1)]
    entries = variable(space, layout.points, where, tree)
    if isinstance(entries, str):
        names = [entries]
    elif isinstance(entries, list):
        names = [_name(entry, layout.points, where) for entry in entries]
    else:
        names = [f"{number:g}" for number in reals(space, layout.points, where, tree).reshape(-1)]
    if len(names) != count or len(set(names)) != len(names):
        want = f"{count} different names, one a row"
        twice = (
            [name for name in dict.fromkeys(names) if names.count(name) > 1] if len(names) == count else []
        )
        got = ", ".join(twice[:5]) + " several times" if twice else f"{len(names)}"
        raise KinematicsError.of(layout.points, want, got, where)
    return names


def _name(entry: Any, variable: str, where: str) -> str:
    if isinstance(entry, str) and entry.strip():
        return entry.strip()
    if isinstance(entry, np.ndarray) and entry.size == 1 and entry.dtype.kind in "fiu":
        return f"{float(entry.reshape(-1)[0]):g}"
    raise KinematicsError.of(variable, "a name or number for every point", "something else", where)


def positions_of(
    space: Mapping[str, Any], layout: Layout, count: int, where: str, tree: Mapping[str, Any]
) -> list[Array]:
    """Return the positions of the points, mm; as metres where no unit is stated.

    Raises
    ------
    KinematicsError
        Another shape than points x 3.
    """
    if not layout.position:
        return [unknown_vector()] * count
    values = reals(space, layout.position, where, tree)
    if values.shape == (3, count) and count != 3:
        values = values.T
    values = values.reshape(1, 3) if values.size == 3 and count == 1 else values
    if values.shape != (count, 3):
        want = f"points x 3, here {count} x 3"
        got = " x ".join(map(str, values.shape))
        raise KinematicsError.of(layout.position, want, got, where)
    unit = layout.position_unit
    ending = re.search(LENGTH_END, layout.position)
    if unit or ending:
        return list(in_mm(values, LENGTHS[unit or (ending[1] if ending else "m")]))
    return list(in_mm(values, 1.0))


def companion_of(
    space: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str, tree: Mapping[str, Any]
) -> Array | None:
    """Return coherence or standard deviation in the shape of the values; None without one.

    Raises
    ------
    KinematicsError
        Another shape.
    """
    if not name:
        return None
    values = reals(space, name, where, tree)
    shaped = _shaped(values, shape[1], name, where)
    if shaped.shape[0] != shape[0] or shaped.shape[2] not in (1, shape[2]):
        raise KinematicsError.of(name, f"{shape[0]} x {shape[1]}", f"{shaped.shape[0]} rows", where)
    return np.broadcast_to(shaped, shape)


def count_of(space: Mapping[str, Any], signal: Signal, where: str, tree: Mapping[str, Any]) -> float | None:
    """Return the number of averages; None where it is not stated.

    Raises
    ------
    KinematicsError
        No number from 1 on.
    """
    if signal.n_avg == "":
        return None
    value = signal.n_avg
    number = np.asarray(variable(space, value, where, tree) if isinstance(value, str) else value)
    if number.size != 1 or number.dtype.kind not in "fiu" or not float(number.reshape(-1)[0]) >= 1.0:
        raise KinematicsError.of("n_avg", "a number from 1 on", value, where)
    return float(number.reshape(-1)[0])


def directions_of(
    space: Mapping[str, Any],
    signal: Signal,
    beam: int,
    values: NDArray[np.complex128],
    where: str,
    tree: Mapping[str, Any],
) -> list[Array]:
    """Return the direction (3,) of a beam at every point, NaN where it is not stated.

    ``values`` (point, F, beam) are those of the signal.

    Raises
    ------
    KinematicsError
        Neither a name of an axis nor three numbers a point.
    """
    count = len(values)
    if values.shape[2] == 3:
        return [np.eye(3)[beam]] * count
    given = signal.direction
    axis = axis_vector(given) if isinstance(given, str) else None
    if axis is not None:
        return [axis] * count
    if isinstance(given, str) and given:
        numbers = reals(space, given, where, tree)
        if numbers.shape not in ((count, 3), (1, 3)):
            raise KinematicsError.of(given, f"{count} x 3 directions", numbers.shape, where)
        return list(np.broadcast_to(numbers, (count, 3)))
    if isinstance(given, list):
        if len(given) != 3 or not all(isinstance(entry, (int, float)) for entry in given):
            raise KinematicsError.of("direction", "x, -x, ..., or three numbers", given, where)
        return [np.array(given, dtype=float)] * count
    axis = usd_direction(space.get(signal.usd)) if signal.usd else None
    return [unknown_vector() if axis is None else axis] * count

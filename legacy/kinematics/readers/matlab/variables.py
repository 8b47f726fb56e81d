"""Variables of MATLAB and HDF5 files as the parts of a signal: values, units, names, places, directions."""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.containers.matlab_file import describe
from legacy.kinematics.readers.matlab.mapping import Layout, Signal, stacked, usd_direction
from legacy.kinematics.readers.recording import from_parts, unknown_vector
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.unit_labels import LENGTHS, MOTIONS, MotionUnit, motion_unit
from legacy.kinematics.readers.value_checks import in_mm
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import axis_vector

LENGTH_END = r"_(mm|um|m)$"


@dataclass(frozen=True)
class Variables:
    """The variables among which the names of a layout are looked up.

    Attributes
    ----------
    space : mapping
        Variables by name: of the file, or the fields of a struct before those around it.
    where : str
        Their place, for messages.
    tree : mapping
        All variables of the file, listed in messages.
    """

    space: Mapping[str, Any]
    where: str
    tree: Mapping[str, Any]

    def within(self, fields: Mapping[str, Any], where: str) -> Variables:
        """Return the fields of a struct, and for other names what is around it."""
        return Variables(ChainMap(dict(fields), dict(self.space)), where, self.tree)

    def get(self, name: str) -> Any:
        """Return a variable; dots in its name reach into structs.

        Raises
        ------
        KinematicsError
            There is none; the variables of the file are listed.
        """
        value: Any = self.space
        for part in name.split("."):
            if not isinstance(value, Mapping) or part not in value:
                step = f"It holds {describe(dict(self.tree))}"
                raise KinematicsError.of(
                    f"the variable {name}", "in the file", "no such one", self.where, step
                )
            value = value[part]
        return value

    def reals(self, name: str) -> Array:
        """Return an array of real numbers.

        Raises
        ------
        KinematicsError
            No numbers, or complex ones.
        """
        value = self._get_numbers(name)
        if np.iscomplexobj(value):
            step = "Say which variable is what in a mapping"
            raise KinematicsError.of(f"the variable {name}", "real numbers", "complex ones", self.where, step)
        return value.astype(float)

    def _get_numbers(self, name: str) -> NDArray[Any]:
        value = stacked(self.get(name))
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fciub" or value.size == 0:
            step = "Say which variable is what in a mapping"
            raise KinematicsError.of(
                f"the variable {name}", "an array of numbers", "something else", self.where, step
            )
        return value

    def values(self, signal: Signal, count: int) -> NDArray[np.complex128]:
        """Return the complex values of a signal, (point, F, beam), in its unit.

        Raises
        ------
        KinematicsError
            Real numbers alone, or another shape.
        """
        if signal.value_re:
            parts = [self.reals(name) for name in (signal.value_re, signal.value_im)]
            shaped = [_shape(part, count, signal.value_re, self.where) for part in parts]
            if shaped[0].shape != shaped[1].shape:
                want = f"as large as {signal.value_re}"
                raise KinematicsError.of(signal.value_im, want, "another size", self.where)
            return from_parts(shaped[0], shaped[1])
        values = self._get_numbers(signal.value)
        if not np.iscomplexobj(values):
            if values.ndim == 2 and values.shape[1] == 2 * count:
                values = from_parts(values[:, 0::2], values[:, 1::2])
            else:
                step = "Export Real & Imag., not a magnitude: without phase there is no motion"
                raise KinematicsError.of(
                    f"the variable {signal.value}", "complex", "real numbers", self.where, step
                )
        return np.asarray(_shape(values, count, signal.value, self.where), dtype=complex)

    def unit(self, signal: Signal, name: str) -> MotionUnit:
        """Return the unit that is stated, or that the signal description names.

        Raises
        ------
        KinematicsError
            None is known, or the signal is a power.
        """
        label = signal.unit.removeprefix("=")
        if not label and signal.usd:
            usd = self.get(signal.usd)
            if isinstance(usd, dict):
                power = np.asarray(usd.get("PowerSignal", 0))
                if power.size == 1 and power.dtype.kind in "fiub" and bool(power.reshape(-1)[0]):
                    step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
                    raise KinematicsError.of(name, "an amplitude spectrum", "a power", self.where, step)
                label = str(usd.get("YUnit", ""))
        unit = motion_unit(label)
        if unit is None:
            got = shown(label) if label else "none"
            step = 'Give it as unit = "m/s" in a mapping'
            raise KinematicsError.of(f"the unit of {name}", "; ".join(MOTIONS), got, self.where, step)
        return unit

    def names(self, layout: Layout, count: int, point: str) -> list[str]:
        """Return the names of the points, one a row.

        Raises
        ------
        KinematicsError
            Others than one different name for each row.
        """
        if not layout.points:
            return [point] if point and count == 1 else [str(k) for k in range(1, count + 1)]
        entries = self.get(layout.points)
        if isinstance(entries, str):
            names = [entries]
        elif isinstance(entries, list):
            names = [_name(entry, layout.points, self.where) for entry in entries]
        else:
            names = [f"{number:g}" for number in self.reals(layout.points).reshape(-1)]
        if len(names) != count or len(set(names)) != len(names):
            want = f"{count} different names, one a row"
            twice = (
                [name for name in dict.fromkeys(names) if names.count(name) > 1]
                if len(names) == count
                else []
            )
            got = ", ".join(twice[:5]) + " several times" if twice else f"{len(names)}"
            raise KinematicsError.of(layout.points, want, got, self.where)
        return names

    def positions(self, layout: Layout, count: int) -> list[Array]:
        """Return the positions of the points, mm; as metres where no unit is stated.

        Raises
        ------
        KinematicsError
            Another shape than points x 3.
        """
        if not layout.position:
            return [unknown_vector()] * count
        values = self.reals(layout.position)
        if values.shape == (3, count) and count != 3:
            values = values.T
        values = values.reshape(1, 3) if values.size == 3 and count == 1 else values
        if values.shape != (count, 3):
            want = f"points x 3, here {count} x 3"
            got = " x ".join(map(str, values.shape))
            raise KinematicsError.of(layout.position, want, got, self.where)
        unit = layout.position_unit
        ending = re.search(LENGTH_END, layout.position)
        if unit or ending:
            return list(in_mm(values, LENGTHS[unit or (ending[1] if ending else "m")]))
        return list(in_mm(values, 1.0))

    def companion(self, name: str, shape: tuple[int, ...]) -> Array | None:
        """Return coherence or standard deviation in the shape of the values; None without one.

        Raises
        ------
        KinematicsError
            Another shape.
        """
        if not name:
            return None
        values = self.reals(name)
        shaped = _shape(values, shape[1], name, self.where)
        if shaped.shape[0] != shape[0] or shaped.shape[2] not in (1, shape[2]):
            raise KinematicsError.of(name, f"{shape[0]} x {shape[1]}", f"{shaped.shape[0]} rows", self.where)
        return np.broadcast_to(shaped, shape)

    def count(self, signal: Signal) -> float | None:
        """Return the number of averages; None where it is not stated.

        Raises
        ------
        KinematicsError
            No number from 1 on.
        """
        if signal.n_avg == "":
            return None
        value = signal.n_avg
        number = np.asarray(self.get(value) if isinstance(value, str) else value)
        if number.size != 1 or number.dtype.kind not in "fiu" or not float(number.reshape(-1)[0]) >= 1.0:
            raise KinematicsError.of("n_avg", "a number from 1 on", value, self.where)
        return float(number.reshape(-1)[0])

    def directions(self, signal: Signal, beam: int, values: NDArray[np.complex128]) -> list[Array]:
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
        stated = signal.direction
        axis = axis_vector(stated) if isinstance(stated, str) else None
        if axis is not None:
            return [axis] * count
        if isinstance(stated, str) and stated:
            numbers = self.reals(stated)
            if numbers.shape not in ((count, 3), (1, 3)):
                raise KinematicsError.of(stated, f"{count} x 3 directions", numbers.shape, self.where)
            return list(np.broadcast_to(numbers, (count, 3)))
        if isinstance(stated, list):
            if len(stated) != 3 or not all(isinstance(entry, (int, float)) for entry in stated):
                raise KinematicsError.of("direction", "x, -x, ..., or three numbers", stated, self.where)
            return [np.array(stated, dtype=float)] * count
        axis = usd_direction(self.space.get(signal.usd)) if signal.usd else None
        return [unknown_vector() if axis is None else axis] * count


def _shape(values: NDArray[Any], count: int, name: str, where: str) -> NDArray[Any]:
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


def _name(entry: Any, variable: str, where: str) -> str:
    if isinstance(entry, str) and entry.strip():
        return entry.strip()
    if isinstance(entry, np.ndarray) and entry.size == 1 and entry.dtype.kind in "fiu":
        return f"{float(entry.reshape(-1)[0]):g}"
    raise KinematicsError.of(variable, "a name or number for every point", "something else", where)

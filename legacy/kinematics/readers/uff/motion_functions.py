"""Functions of a universal file that hold motion: quantity, unit, direction and lines of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legacy.kinematics.readers.recording import QUANTITIES
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.uff.functions import COHERENCE, FRF, SPECTRUM, TIME, TRANSMISSIBILITY, Function
from legacy.kinematics.readers.uff.geometry import Geometry
from legacy.kinematics.readers.unit_labels import MOTIONS, is_none, motion_unit, plain
from legacy.stapeskit.faults import Fault

ORDERS = {8: 0, 11: 1, 12: 2}
REFERENCES = {13: "N", 9: "N", 15: "Pa", 8: "m", 11: "m/s", 12: "m/s2"}
# Specific data type of the abscissa (dataset 58, record 8).
_FREQUENCY = 18
_TRANSLATIONS = "0 (scalar) or +-1, +-2, +-3 (translations)"


@dataclass(frozen=True)
class Motion:
    """A function that holds motion: derivative order, factor to SI, unit of the reference."""

    function: Function
    order: int
    scale: float
    per: str


def usable_motions(
    functions: Sequence[Function], geometry: Geometry, file: str, faults: list[Fault]
) -> tuple[list[Motion], Counter[str]]:
    """Return the functions of motion over frequency, and count the others by what they are.

    Parameters
    ----------
    faults : list of str
        What is wrong with functions of motion is added to it.
    """
    usable, others = [], Counter[str]()
    for function in functions:
        if function.kind not in (FRF, TRANSMISSIBILITY, SPECTRUM):
            others[function.kind_name] += function.kind != COHERENCE
        elif not is_motion(function):
            others[f"{function.kind_name} of {function.ordinate.label or 'another quantity'}"] += 1
        elif function.abscissa.kind not in (0, 1, _FREQUENCY):
            others[f"{function.kind_name} over {function.abscissa.label or 'something else'}"] += 1
        elif function.real:
            others[f"{function.kind_name} of real numbers, without phase"] += 1
        else:
            faults += direction_faults(function, file)
            faults += _frequency_faults(function, file)
            motion = motion_of(function, geometry, file, faults)
            if motion is not None:
                usable.append(motion)
    return usable, Counter({name: count for name, count in others.items() if count})


def is_motion(function: Function) -> bool:
    """Return whether a function is motion by its data type, of unknown or general type by its unit."""
    ordinate = function.ordinate
    if ordinate.kind in ORDERS:
        return True
    if ordinate.kind not in (0, 1) or is_none(ordinate.unit):
        return False
    return motion_unit(ordinate.unit) is not None


def direction_faults(function: Function, file: str) -> list[Fault]:
    """Refuse rotations, and numbers that are no direction."""
    if abs(function.direction) <= 3:
        return []
    where = f"{file}, dataset {function.place}"
    thing = f"the direction at node {function.node}"
    if abs(function.direction) > 6:
        return [Fault(thing, _TRANSLATIONS, function.direction, where)]
    step = "Vibrometers measure translations: leave this function out of the export"
    return [Fault(thing, _TRANSLATIONS, f"{function.direction}, a rotation", where, step)]


def _frequency_faults(function: Function, file: str) -> list[Fault]:
    freq = np.sort(function.x)
    if np.all(np.isfinite(freq)) and np.all(np.diff(freq) > 0.0) and freq[0] >= 0.0:
        return []
    bad = np.flatnonzero(~np.isfinite(function.x) | (function.x < 0.0))
    if not len(bad):
        bad = np.flatnonzero(np.isin(function.x, freq[1:][np.diff(freq) <= 0.0]))
    more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
    got = f"{function.x[bad[0]]:g} at value {bad[0] + 1}{more}"
    want = "different and not negative"
    where = f"{file}, dataset {function.place}"
    return [Fault("the frequencies of a function", want, got, where, "Export it again")]


def motion_of(function: Function, geometry: Geometry, file: str, faults: list[Fault]) -> Motion | None:
    """Find order, factor to SI and reference of a function of motion."""
    where = f"{file}, dataset {function.place}"
    ordinate, denominator = function.ordinate, function.denominator
    scale = 1.0 / (geometry.length_factor or 1.0)
    order, per = ORDERS.get(ordinate.kind), ""
    if not is_none(ordinate.unit):
        unit = motion_unit(ordinate.unit)
        if unit is None:
            want = f"one of {'; '.join(MOTIONS)} [per unit of a reference]"
            step = "Export the file in SI units, on a linear scale"
            faults.append(Fault("the unit of the values", want, shown(ordinate.unit), where, step))
            return None
        if order is not None and unit.order != order:
            got = f"{QUANTITIES[order]} (type {ordinate.kind}) in {ordinate.unit}"
            step = "Correct the unit in the measuring program, and export again"
            faults.append(Fault("quantity and unit", "those of one motion", got, where, step))
            return None
        order, scale, per = unit.order, unit.scale, unit.per
    if order is None:
        return None
    if function.kind in (SPECTRUM, TIME):
        return Motion(function, order, scale, per)
    if not is_none(denominator.unit):
        per = plain(denominator.unit)
    elif not per:
        per = REFERENCES.get(denominator.kind, "unit of the reference")
    return Motion(function, order, scale, per)


def direction_label(node: int, direction: int) -> str:
    """Return node and direction as one name: ``12+z``, ``12`` for a scalar."""
    sign = "-" if direction < 0 else "+"
    axes = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
    return f"{node}{sign}{axes[abs(direction)]}" if abs(direction) in axes else f"{node}"


def point_name(function: Function) -> str:
    """Return the name of a point: the number of its node, or the name of the entity where that is 0."""
    if function.node == 0 and not is_none(function.entity):
        return function.entity
    return str(function.node)

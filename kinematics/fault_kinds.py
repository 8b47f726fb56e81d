"""The kinds of fault a channel, a point or a whole body can have, and how each is undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.fault_model import Fault, FaultFit, LineData
from kinematics.frames import rotation_from_vector

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def gain_fault(data: LineData, channels: list[int]) -> Fault:
    """Return a complex factor common to some channels, parameters (real - 1, imaginary)."""
    own = data.beams.basis[channels].astype(complex)
    return Fault("gain", channels, lambda p: own * (1.0 + p[0] + 1j * p[1]), 2)


def drift_fault(data: LineData, channels: list[int]) -> Fault:
    """Return a complex factor that runs linearly over the lines: two parameters constant, two of slope."""
    own = data.beams.basis[channels].astype(complex)

    def rows(p: Array) -> ComplexArray:
        factor = 1.0 + p[0] + 1j * p[1] + (p[2] + 1j * p[3]) * data.tau
        return np.asarray(own[None] * factor[:, None, None])

    return Fault("drift", channels, rows, 4)


def direction_fault(data: LineData, channel: int) -> Fault:
    """Return a beam that points elsewhere: two angles across it, rad."""
    old = data.directions[channel]
    first, second = _across(old)

    def rows(p: Array) -> ComplexArray:
        new = old + p[0] * first + p[1] * second
        return data.row(data.arms_m[[channel]], (new / np.linalg.norm(new))[None]).astype(complex)

    return Fault("direction", [channel], rows, 2)


def position_fault(data: LineData, channels: list[int]) -> Fault:
    """Return a point that lies elsewhere: three shifts, m."""
    return Fault(
        "position",
        channels,
        lambda p: data.row(data.arms_m[channels] + p, data.directions[channels]).astype(complex),
        3,
    )


def swap_fault(data: LineData, first: list[int], second: list[int], what: str) -> Fault:
    """Return two points (or two beams of a point) whose names were exchanged: no parameters."""
    channels = [*first, *second]
    arms, directions = swapped(data, first, second, what)
    rows = data.row(arms[channels], directions[channels]).astype(complex)
    return Fault("label_swap", channels, lambda _p: rows, 0)


def swapped(data: LineData, first: list[int], second: list[int], what: str) -> tuple[Array, Array]:
    """Return arms and directions (channel, 3) with two points' places or two beams' directions exchanged."""
    arms, directions = data.arms_m.copy(), data.directions.copy()
    if what == "points":
        arms[first], arms[second] = data.arms_m[second[0]], data.arms_m[first[0]]
    else:
        directions[first], directions[second] = data.directions[second], data.directions[first]
    return arms, directions


def swap_parts(data: LineData, fault: Fault) -> tuple[list[int], list[int], str]:
    """Return the two sides of a label swap and whether points or beams changed places."""
    own = data.points[fault.channels[0]]
    one = [c for c in fault.channels if data.points[c] == own]
    two = [c for c in fault.channels if c not in one]
    return (one, two, "points") if two else (one[:1], one[1:], "beams")


def corrected(data: LineData, fit: FaultFit) -> LineData:
    """Return the data with a fitted fault undone."""
    fault, p = fit.fault, fit.parameters
    if fault.kind in ("gain", "drift"):
        factor = np.full(len(data.tau), 1.0 + p[0] + 1j * p[1])
        if fault.kind == "drift":
            factor = factor + (p[2] + 1j * p[3]) * data.tau
        y, s = data.y.copy(), data.s.copy()
        y[fault.channels] /= factor
        s[fault.channels] *= np.abs(factor)
        return replace(data, y=y, s=s)
    if fault.kind == "position":
        arms = data.arms_m.copy()
        arms[fault.channels] += p
        return data.moved(arms_m=arms)
    if fault.kind == "label_swap":
        arms, directions = swapped(data, *swap_parts(data, fault))
        return data.moved(arms, directions)
    directions = data.directions.copy()
    if fault.kind == "axes":
        directions = directions @ rotation_from_vector(p).T
    else:
        channel = fault.channels[0]
        first, second = _across(directions[channel])
        new = directions[channel] + p[0] * first + p[1] * second
        directions[channel] = new / np.linalg.norm(new)
    return data.moved(directions=directions)


def rebuilt(data: LineData, fault: Fault) -> Fault:
    """Return the same kind of fault on data with other positions or directions."""
    if fault.kind == "gain":
        return gain_fault(data, fault.channels)
    if fault.kind == "drift":
        return drift_fault(data, fault.channels)
    if fault.kind == "direction":
        return direction_fault(data, fault.channels[0])
    if fault.kind == "position":
        return position_fault(data, fault.channels)
    if fault.kind == "axes":
        return axes_fault(data)
    return swap_fault(data, *swap_parts(data, fault))


def _across(direction: Array) -> tuple[Array, Array]:
    """Return two unit vectors square to a beam and to each other."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def axes_fault(data: LineData) -> Fault:
    """Return beam axes that are turned as a whole against the positions: a rotation vector, rad."""
    channels = list(range(len(data.points)))
    return Fault(
        "axes",
        channels,
        lambda p: data.row(data.arms_m, data.directions @ rotation_from_vector(p).T).astype(complex),
        3,
    )

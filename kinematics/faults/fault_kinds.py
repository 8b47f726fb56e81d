"""The kinds of fault a channel, a point, a laser or a whole body can have, and how each is undone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed.compact import Compact
from stapeskit.frames import rotation_from_vector

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
GAIN, DIRECTION_DEG, AXES_DEG = 0.1, 4.0, 2.0
POSITION_OF_LEVER = 0.2


@dataclass(frozen=True)
class Fault:
    """One possible fault.

    Attributes
    ----------
    kind : str
        ``gain``, ``phase``, ``delay``, ``drift``, ``direction``, ``position``, ``label_swap``, ``axes``.
    channels : list of int
        The channels it changes.
    size : int
        Number of real parameters.
    rows : callable
        Data and parameters (size,) to the rows of those channels, (n, m) or (line, n, m) in the basis.
    undone : callable
        Data and parameters to data without the fault.
    scale : ndarray, (size,)
        How large each parameter commonly is.
    owner : str
        What is at fault: ``channel``, ``point``, ``laser``, ``body``, ``points``, ``beams``, ``lasers``.
    factor : callable, optional
        Data and parameters to the factor (line,) that multiplies all rows; of faults that run over the lines.
    """

    kind: str
    channels: list[int]
    size: int
    rows: Callable[[Compact, Array], ComplexArray | Array]
    undone: Callable[[Compact, Array], Compact]
    scale: Array
    owner: str = "channel"
    factor: Callable[[Compact, Array], ComplexArray] | None = None


def gain(channels: list[int], owner: str = "channel") -> Fault:
    """Return a real factor common to some channels, parameter factor - 1."""

    def undone(data: Compact, p: Array) -> Compact:
        return data.scaled(channels, np.full(len(data.part), 1.0 + p[0] + 0j))

    return Fault(
        "gain",
        channels,
        1,
        lambda data, p: data.beams.basis[channels] * (1.0 + p[0]),
        undone,
        np.array([GAIN]),
        owner,
    )


def phase(channels: list[int], owner: str = "channel") -> Fault:
    """Return a complex factor common to some channels, parameters (real - 1, imaginary)."""

    def undone(data: Compact, p: Array) -> Compact:
        return data.scaled(channels, np.full(len(data.part), 1.0 + p[0] + 1j * p[1]))

    return Fault(
        "phase",
        channels,
        2,
        lambda data, p: data.beams.basis[channels] * (1.0 + p[0] + 1j * p[1]),
        undone,
        np.full(2, GAIN),
        owner,
    )


def delay(data: Compact, channels: list[int], owner: str = "channel") -> Fault:
    """Return a delay of some channels; parameter: phase lag at the mean frequency, rad."""
    middle = float(np.mean(data.freq_hz))

    def factor(data: Compact, p: Array) -> ComplexArray:
        return np.asarray(np.exp(-1j * p[0] * data.freq_hz / middle))

    return Fault(
        "delay",
        channels,
        1,
        lambda data, p: data.beams.basis[channels] * factor(data, p)[:, None, None],
        lambda data, p: data.scaled(channels, factor(data, p)),
        np.array([GAIN]),
        owner,
        factor,
    )


def drift(channels: list[int], owner: str = "channel") -> Fault:
    """Return a complex factor that runs linearly over the lines: two parameters constant, two of slope."""

    def factor(data: Compact, p: Array) -> ComplexArray:
        return np.asarray(1.0 + p[0] + 1j * p[1] + (p[2] + 1j * p[3]) * data.tau)

    return Fault(
        "drift",
        channels,
        4,
        lambda data, p: data.beams.basis[channels] * factor(data, p)[:, None, None],
        lambda data, p: data.scaled(channels, factor(data, p)),
        np.full(4, 0.5 * GAIN),
        owner,
        factor,
    )


def direction(data: Compact, channels: list[int], owner: str = "channel") -> Fault:
    """Return beams (parallel ones) that point elsewhere: two angles across them, rad."""
    first, second = across(data.directions[channels[0]])

    def turned(data: Compact, p: Array) -> Array:
        new = data.directions[channels] + p[0] * first + p[1] * second
        return np.asarray(new / np.linalg.norm(new, axis=1, keepdims=True))

    def undone(data: Compact, p: Array) -> Compact:
        directions = data.directions.copy()
        directions[channels] = turned(data, p)
        return data.moved(directions=directions)

    return Fault(
        "direction",
        channels,
        2,
        lambda data, p: data.row(data.arms_m[channels], turned(data, p)),
        undone,
        np.full(2, np.radians(DIRECTION_DEG)),
        owner,
    )


def position(data: Compact, channels: list[int]) -> Fault:
    """Return a point that lies elsewhere: three shifts, m."""

    def undone(data: Compact, p: Array) -> Compact:
        arms = data.arms_m.copy()
        arms[channels] += p
        return data.moved(arms_m=arms)

    return Fault(
        "position",
        channels,
        3,
        lambda data, p: data.row(data.arms_m[channels] + p, data.directions[channels]),
        undone,
        np.full(3, POSITION_OF_LEVER * data.beams.lever_m),
        "point",
    )


def axes(data: Compact) -> Fault:
    """Return beam axes that are turned as a whole against the positions: a rotation vector, rad."""
    channels = data.live

    def undone(data: Compact, p: Array) -> Compact:
        return data.moved(directions=data.directions @ rotation_from_vector(p).T)

    return Fault(
        "axes",
        channels,
        3,
        lambda data, p: data.row(
            data.arms_m[channels], data.directions[channels] @ rotation_from_vector(p).T
        ),
        undone,
        np.full(3, np.radians(AXES_DEG)),
        "body",
    )


def swap(data: Compact, first: list[int], second: list[int], owner: str) -> Fault:
    """Return two points whose names, or beams whose directions, were exchanged: no parameters.

    Parameters
    ----------
    data : Compact
    first, second : list of int
        Channels of either.
    owner : str
        ``points`` exchange their places; ``beams`` (of one point) and ``lasers`` (at all points, listed in
        the
        same order) their directions.
    """
    channels = [*first, *second]
    given = data.arms_m

    def undone(data: Compact, _p: Array) -> Compact:
        arms, directions = data.arms_m.copy(), data.directions.copy()
        if owner == "points":
            arms[first] += given[second[0]] - given[first[0]]
            arms[second] += given[first[0]] - given[second[0]]
        else:
            directions[first], directions[second] = data.directions[second], data.directions[first]
        return data.moved(arms, directions)

    def rows(data: Compact, p: Array) -> Array:
        return undone(data, p).beams.basis[channels]

    return Fault("label_swap", channels, 0, rows, undone, np.zeros(0), owner)


def across(direction: Array) -> tuple[Array, Array]:
    """Return two unit vectors (..., 3) square to beams (..., 3) and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    first = np.cross(direction, least)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(direction, first)

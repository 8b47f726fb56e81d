"""Faults that ``fault_bodies`` puts into the readings of a body: each changes the true state of the body.

Shares no code with the project.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Response = Callable[[Array, float], ComplexArray]


@dataclass
class World:
    """The true state of the body, which a fault changes."""

    rng: np.random.Generator
    point_of: NDArray[np.int64]
    head: NDArray[np.int64]
    freq_hz: Array
    places: Array
    beams: Array
    twist: ComplexArray
    factor: ComplexArray
    loud: Array
    added: ComplexArray
    size: float
    response: Response

    def of_point(self, point: int) -> list[int]:
        """Return the channels of a point."""
        return np.flatnonzero(self.point_of == point).tolist()

    def of_head(self, head: int) -> list[int]:
        """Return the channels of a laser head."""
        return np.flatnonzero(self.head == head).tolist()

    def readings(self, twist: ComplexArray | None = None) -> ComplexArray:
        """Return what the beams see (channel, freq), m, of the own motion or another (6, freq)."""
        twist = self.twist if twist is None else twist
        turned = np.cross(self.places * 1e-3, self.beams)
        return self.beams @ twist[:3] + turned @ twist[3:]


# The verdict that is right of each channel at fault.
Made = dict[int, str]


def _channel(world: World) -> int:
    return int(world.rng.integers(len(world.head)))


def _factor(factor: complex, verdict: str) -> Callable[[World], Made]:
    def spoil(world: World) -> Made:
        channel = _channel(world)
        world.factor[channel] = factor
        return dict.fromkeys([channel], verdict)

    return spoil


def _delay(world: World) -> Made:
    channel = _channel(world)
    world.factor[channel] = np.exp(-2j * np.pi * world.freq_hz * 8e-6)
    return dict.fromkeys([channel], "gain")


def _drift(world: World) -> Made:
    channel = _channel(world)
    world.factor[channel] = np.linspace(1.0, 0.93, len(world.freq_hz))
    return dict.fromkeys([channel], "drift")


def _loud(world: World) -> Made:
    channel = _channel(world)
    world.loud[channel] = 4.0
    return dict.fromkeys([channel], "noise")


def _tilt(world: World, channels: list[int], degrees: float) -> None:
    across = np.cross(world.beams[channels[0]], world.rng.normal(size=3))
    step = np.tan(np.radians(degrees)) * across / np.linalg.norm(across)
    world.beams[channels] += step
    world.beams[channels] /= np.linalg.norm(world.beams[channels], axis=1, keepdims=True)


def _direction(world: World) -> Made:
    channel = _channel(world)
    _tilt(world, [channel], 4.0)
    return dict.fromkeys([channel], "direction")


def _position(world: World) -> Made:
    own = world.of_point(int(world.rng.integers(world.point_of.max() + 1)))
    shift = world.rng.normal(size=3)
    world.places[own] += 0.12 * world.size * shift / np.linalg.norm(shift)
    return dict.fromkeys(own, "position")


def _coordinates(world: World) -> Made:
    """Exchange x and z of one point: the true place is the file's with both exchanged."""
    most = [
        abs(world.places[own[0], 0] - world.places[own[0], 2]) for own in map(world.of_point, _points(world))
    ]
    own = world.of_point(int(np.argsort(most)[-1 - int(world.rng.integers(len(most) // 2))]))
    world.places[own] = world.places[own][:, [2, 1, 0]]
    return dict.fromkeys(own, "position")


def _points(world: World) -> range:
    return range(int(world.point_of.max()) + 1)


def _names(world: World) -> Made:
    """Exchange the names of two points with the same heads, at least a third of the body apart."""
    pairs = [
        (a, b)
        for a in _points(world)
        for b in range(a)
        if np.array_equal(world.head[world.of_point(a)], world.head[world.of_point(b)])
        and np.linalg.norm(world.places[world.of_point(a)[0]] - world.places[world.of_point(b)[0]])
        > 0.35 * world.size
    ]
    a, b = pairs[int(world.rng.integers(len(pairs)))]
    first, second = world.of_point(a), world.of_point(b)
    for table in (world.places, world.beams):
        table[first], table[second] = table[second].copy(), table[first].copy()
    return dict.fromkeys([*first, *second], "label_swap")


def _cycle(world: World) -> Made:
    """Let the rows of three points with the same heads, apart from each other, belong to the next."""
    heads = [tuple(world.head[world.of_point(point)]) for point in _points(world)]
    alike = [point for point in _points(world) if heads[point] == max(heads, key=heads.count)]
    for _ in range(1000):
        own = [world.of_point(int(point)) for point in world.rng.permutation(alike)[:3]]
        at = world.places[[rows[0] for rows in own]]
        if min(np.linalg.norm(at[k] - at[k - 1]) for k in range(3)) > 0.35 * world.size:
            break
    for table in (world.places, world.beams):
        table[np.concatenate(own)] = table[np.concatenate([*own[1:], own[0]])]
    return dict.fromkeys([int(row) for rows in own for row in rows], "label_swap")


def _range(world: World) -> Made:
    """Read a few points, noise and all, in another range, unit, or in rms beside peak values."""
    count = int(world.point_of.max()) + 1
    some = world.rng.permutation(count)[: int(world.rng.integers(2, (count - 1) // 2 + 1))]
    factor = float(world.rng.choice([2.0, 5.0, 10.0, np.sqrt(2.0)])) ** world.rng.choice([-1.0, 1.0])
    own = np.flatnonzero(np.isin(world.point_of, some))
    world.factor[own], world.loud[own] = factor, factor
    return dict.fromkeys(own.tolist(), "gain")


def _beams(world: World) -> Made:
    own = world.of_point(int(world.rng.integers(world.point_of.max() + 1)))
    pair = world.rng.choice(own, 2, replace=False)
    world.beams[pair] = world.beams[pair[::-1]]
    return dict.fromkeys(pair.tolist(), "label_swap")


def _axes(world: World) -> Made:
    axis = world.rng.normal(size=3)
    axis = np.radians(2.5) * axis / np.linalg.norm(axis)
    world.beams += np.cross(axis, world.beams)
    world.beams /= np.linalg.norm(world.beams, axis=1, keepdims=True)
    return dict.fromkeys(list(range(len(world.head))), "direction")


def _head(factor: Callable[[Array], ComplexArray], verdict: str) -> Callable[[World], Made]:
    def spoil(world: World) -> Made:
        own = world.of_head(int(world.rng.integers(world.head.max() + 1)))
        world.factor[own] = factor(world.freq_hz)
        return dict.fromkeys(own, verdict)

    return spoil


def _head_direction(world: World) -> Made:
    own = world.of_head(int(world.rng.integers(world.head.max() + 1)))
    _tilt(world, own, 3.0)
    return dict.fromkeys(own, "direction")


def _bends(world: World) -> Made:
    """Add the first bending of a free bar along the longest axis, with its own resonance."""
    along = int(np.argmax(np.ptp(world.places, axis=0)))
    s = world.places[:, along] - np.mean(world.places[:, along])
    shape = (s / np.max(np.abs(s))) ** 2 - 0.3
    ratio = world.freq_hz / 5200.0
    course = 1.0 / (1.0 - ratio**2 + 0.1j * ratio)
    way = world.rng.normal(size=3)
    size = np.sqrt(np.mean(np.abs(world.readings()) ** 2))
    added = np.outer((world.beams @ way) * shape, course)
    world.added += 0.06 * size * added / np.sqrt(np.mean(np.abs(added) ** 2))
    return dict.fromkeys(list(range(len(world.head))), "flexible")


def _drying(world: World) -> Made:
    """Let the stiffness rise by 3 % while the points are measured one after the other."""
    last = _points(world)[-1]
    for point in _points(world)[1:]:
        own = world.of_point(point)
        now = world.response(world.freq_hz, 1.0 + 0.03 * point / last)
        world.added[own] += (world.readings(now) - world.readings())[own]
    return dict.fromkeys(range(len(world.head)), "drift")


def _both(one: str, two: str) -> Callable[[World], Made]:
    """Make two faults of which no point has both."""

    def spoil(world: World) -> Made:
        first = FAULTS[one](world)
        for _ in range(100):
            tried = replace(
                world,
                **{
                    name: getattr(world, name).copy()
                    for name in ("places", "beams", "factor", "loud", "added")
                },
            )
            second = FAULTS[two](tried)
            if not {*world.point_of[list(first)]} & {*world.point_of[list(second)]}:
                break
        vars(world).update(vars(tried))
        return first | second

    return spoil


# Faults by name; each returns the channels at fault and the verdict that is right.
FAULTS: dict[str, Callable[[World], Made]] = {
    "gain 6 %": _factor(1.06, "gain"),
    "gain -3 %": _factor(0.97, "gain"),
    "phase 4 deg": _factor(complex(np.exp(0.07j)), "gain"),
    "delay 8 us": _delay,
    "sign": _factor(-1.0, "sign"),
    "drift 7 %": _drift,
    "noise x4": _loud,
    "direction 4 deg": _direction,
    "position": _position,
    "x and z of a point": _coordinates,
    "names of points": _names,
    "names of three points": _cycle,
    "range of points": _range,
    "beams of a point": _beams,
    "axes 2.5 deg": _axes,
    "head gain 5 %": _head(lambda f: np.full(len(f), 1.05 + 0j), "gain"),
    "head phase 4 deg": _head(lambda f: np.full(len(f), np.exp(0.07j)), "gain"),
    "head delay 10 us": _head(lambda f: np.exp(-2j * np.pi * f * 1e-5), "gain"),
    "head sign": _head(lambda f: np.full(len(f), -1.0 + 0j), "sign"),
    "head direction 3 deg": _head_direction,
    "bends 6 %": _bends,
    "drying 3 %": _drying,
    "gain 6 % + position": _both("gain 6 %", "position"),
    "sign + gain 6 %": _both("sign", "gain 6 %"),
    "names of points + gain 6 %": _both("names of points", "gain 6 %"),
    "drift 7 % + phase 4 deg": _both("drift 7 %", "phase 4 deg"),
}
# Faults that one head alone cannot show.
SEVERAL_HEADS = ("beams of a point", "axes", "head", "drying")

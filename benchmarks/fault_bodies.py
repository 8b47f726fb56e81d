"""Draw readings of rigid bodies from the physics of a mass on springs, with one fault each.

Shares no code with ``fault_scenes`` and none with the project: the bodies are shells seen from laser heads at
a finite distance, so that no two beams of a head are parallel; the motion is the forced response of a mass on
springs; the noise is white in velocity, of another size for each head.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Response = Callable[[Array, float], ComplexArray]


@dataclass
class Reading:
    """Readings of one body, what the file says of them, and the fault that was put in.

    Attributes
    ----------
    points : list of str, (channel,)
    positions_mm, directions : ndarray, (channel, 3)
        As in the file.
    head : ndarray, (channel,), int
        Laser head of each channel.
    freq_hz : ndarray, (freq,)
    value : ndarray, (channel, freq), complex
        Displacement along each beam, m.
    sd : ndarray, (channel, freq)
        Standard deviation of its real part, m.
    expected : dict of int to str
        The verdict that is right of each channel at fault, as in ``dof.channels.csv``.
    twist : ndarray, (6, freq), complex
        The true motion, m and rad.
    """

    points: list[str]
    positions_mm: Array
    directions: Array
    head: NDArray[np.int64]
    freq_hz: Array
    value: ComplexArray
    sd: Array
    expected: dict[int, str] = field(default_factory=dict)
    twist: ComplexArray = field(default_factory=lambda: np.zeros((6, 0), dtype=complex))

    @property
    def culprits(self) -> list[int]:
        """The channels at fault, ascending."""
        return sorted(self.expected)

    @property
    def verdict(self) -> str:
        """The verdict of all channels at fault; of several faults, each, joined by plus signs."""
        return "+".join(dict.fromkeys(self.expected.values()))


@dataclass
class _World:
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
        return np.flatnonzero(self.point_of == point).tolist()

    def of_head(self, head: int) -> list[int]:
        return np.flatnonzero(self.head == head).tolist()

    def readings(self, twist: ComplexArray | None = None) -> ComplexArray:
        twist = self.twist if twist is None else twist
        turned = np.cross(self.places * 1e-3, self.beams)
        return self.beams @ twist[:3] + turned @ twist[3:]


# Number of points, heads, half-angle of the heads about y (degrees; a range), half-axes of the shell, mm.
BODIES: dict[str, tuple[int, int, tuple[float, float], tuple[float, float, float]]] = {
    "shell, 5 points, 3 heads": (5, 3, (25.0, 50.0), (1.6, 0.5, 0.8)),
    "shell, 12 points, 3 heads": (12, 3, (15.0, 35.0), (2.5, 1.2, 0.9)),
    "rod, 8 points, 2-3 heads": (8, 3, (20.0, 40.0), (0.5, 4.0, 0.5)),
    "disc, 40 points, 1 head": (40, 1, (0.0, 8.0), (1.8, 0.15, 0.8)),
}


def forced_response(rng: np.random.Generator, arm_mm: float) -> Response:
    """Return the twist (6, freq), m and rad, of a mass on springs under a harmonic force.

    It is a function of the frequencies (freq,), Hz, and of what the stiffness is multiplied with; the ratios
    of damping stay.
    """
    lever = np.array([1.0] * 3 + [arm_mm * 1e-3] * 3)
    root = rng.normal(size=(6, 6))
    basis = np.linalg.qr(root)[0]
    natural = 2.0 * np.pi * np.exp(rng.uniform(np.log(700.0), np.log(6000.0), 6))
    damping = rng.uniform(0.05, 0.3, 6)
    force = rng.normal(size=6) * natural**2

    def twist(freq_hz: Array, stiffness: float = 1.0) -> ComplexArray:
        w, own = 2.0 * np.pi * freq_hz, natural * np.sqrt(stiffness)
        modal = force[:, None] / (own[:, None] ** 2 - w**2 + 2j * (damping * own)[:, None] * w)
        return np.asarray(80e-9 * (basis @ modal) / lever[:, None])

    return twist


def _shell(rng: np.random.Generator, count: int, axes: tuple[float, float, float]) -> Array:
    """Return points (point, 3) on the side of an ellipsoid that the heads see, mm, off the origin."""
    places: list[Array] = []
    while len(places) < count:
        v = rng.normal(size=3)
        v[1] = abs(v[1])
        place = v / np.linalg.norm(v) * axes
        if all(np.linalg.norm(place - other) > 0.15 * max(axes) / np.sqrt(count) for other in places):
            places.append(place)
    return np.array(places) + rng.normal(size=3) * 0.3


def frequencies(lines: int) -> Array:
    """Return the frequencies of a drawn reading, Hz."""
    return np.geomspace(300.0, 8000.0, lines)


def draw(
    seed: int,
    body: str,
    fault: str = "",
    *,
    lines: int = 120,
    noise: float = 0.01,
    position_sd_mm: float = 0.0,
    gaps: float = 0.0,
    motion: ComplexArray | None = None,
) -> Reading:
    """Draw one body with readings, noise, and a fault by its name in FAULTS.

    Parameters
    ----------
    seed : int
    body : str
        In BODIES.
    fault : str
        In FAULTS; empty for none.
    lines : int
        Logarithmic from 300 to 8000 Hz.
    noise : float
        Standard deviation of a complex reading over the rms of all, at the mean of its course.
    position_sd_mm : float
        True errors of the positions.
    gaps : float
        Share of values that are missing.
    motion : ndarray, (6, lines), complex, optional
        The twist, m and rad, instead of a drawn one.
    """
    rng = np.random.default_rng([seed, 977])
    count, heads, cone, axes = BODIES[body]
    freq = frequencies(lines)
    places = _shell(rng, count, axes)
    turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(heads) / heads
    tilt = np.radians(rng.uniform(*cone, heads))
    eyes = 120.0 * np.column_stack([np.sin(tilt) * np.cos(turn), np.cos(tilt), np.sin(tilt) * np.sin(turn)])
    pairs = [
        (p, h)
        for p in range(count)
        for h in range(heads)
        if "2-3" not in body or rng.random() < 0.85 or h < 2
    ]
    point_of, head = np.array(pairs).T
    beams = eyes[head] - places[point_of]
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    at = places[point_of]
    response = forced_response(rng, float(np.max(axes)))
    twist = response(freq, 1.0)
    if heads == 1:
        twist[[0, 2, 4]] *= 0.02
    if motion is not None:
        twist = motion
    off = position_sd_mm * rng.normal(size=places.shape)
    shape = (len(pairs), lines)
    world = _World(
        rng, point_of, head, freq, at + off[point_of], beams.copy(), twist,
        np.ones(shape, dtype=complex), np.ones(len(pairs)), np.zeros(shape, dtype=complex),
        float(np.max(axes)), response,
    )  # fmt: skip
    size = np.sqrt(np.mean(np.abs(world.readings()) ** 2))
    course = (1.0 / freq) / np.sqrt(np.mean(1.0 / freq**2))
    level = rng.uniform(0.7, 1.4, heads)
    sd = noise * size / np.sqrt(2.0) * level[head][:, None] * course
    expected = FAULTS[fault](world) if fault else {}
    value = world.readings() * world.factor + world.added
    dead = np.all(world.factor == 0.0, axis=1)[:, None]
    error = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    value = value + np.where(dead, 0.0, sd * world.loud[:, None]) * error
    if gaps:
        value[rng.random(shape) < gaps] = np.nan
    points = [f"P{p + 1}" for p in point_of]
    return Reading(points, at, beams, head, freq, value, sd, expected, twist)


# The verdict that is right of each channel at fault.
Made = dict[int, str]


def _channel(world: _World) -> int:
    return int(world.rng.integers(len(world.head)))


def _factor(factor: complex, verdict: str) -> Callable[[_World], Made]:
    def spoil(world: _World) -> Made:
        channel = _channel(world)
        world.factor[channel] = factor
        return dict.fromkeys([channel], verdict)

    return spoil


def _delay(world: _World) -> Made:
    channel = _channel(world)
    world.factor[channel] = np.exp(-2j * np.pi * world.freq_hz * 8e-6)
    return dict.fromkeys([channel], "gain")


def _drift(world: _World) -> Made:
    channel = _channel(world)
    world.factor[channel] = np.linspace(1.0, 0.93, len(world.freq_hz))
    return dict.fromkeys([channel], "drift")


def _loud(world: _World) -> Made:
    channel = _channel(world)
    world.loud[channel] = 4.0
    return dict.fromkeys([channel], "noise")


def _tilt(world: _World, channels: list[int], degrees: float) -> None:
    across = np.cross(world.beams[channels[0]], world.rng.normal(size=3))
    step = np.tan(np.radians(degrees)) * across / np.linalg.norm(across)
    world.beams[channels] += step
    world.beams[channels] /= np.linalg.norm(world.beams[channels], axis=1, keepdims=True)


def _direction(world: _World) -> Made:
    channel = _channel(world)
    _tilt(world, [channel], 4.0)
    return dict.fromkeys([channel], "direction")


def _position(world: _World) -> Made:
    own = world.of_point(int(world.rng.integers(world.point_of.max() + 1)))
    shift = world.rng.normal(size=3)
    world.places[own] += 0.12 * world.size * shift / np.linalg.norm(shift)
    return dict.fromkeys(own, "position")


def _coordinates(world: _World) -> Made:
    """Exchange x and z of one point: the true place is the file's with both exchanged."""
    most = [
        abs(world.places[own[0], 0] - world.places[own[0], 2]) for own in map(world.of_point, _points(world))
    ]
    own = world.of_point(int(np.argsort(most)[-1 - int(world.rng.integers(len(most) // 2))]))
    world.places[own] = world.places[own][:, [2, 1, 0]]
    return dict.fromkeys(own, "position")


def _points(world: _World) -> range:
    return range(int(world.point_of.max()) + 1)


def _names(world: _World) -> Made:
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


def _cycle(world: _World) -> Made:
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


def _range(world: _World) -> Made:
    """Read a few points, noise and all, in another range, unit, or in rms beside peak values."""
    count = int(world.point_of.max()) + 1
    some = world.rng.permutation(count)[: int(world.rng.integers(2, (count - 1) // 2 + 1))]
    factor = float(world.rng.choice([2.0, 5.0, 10.0, np.sqrt(2.0)])) ** world.rng.choice([-1.0, 1.0])
    own = np.flatnonzero(np.isin(world.point_of, some))
    world.factor[own], world.loud[own] = factor, factor
    return dict.fromkeys(own.tolist(), "gain")


def _beams(world: _World) -> Made:
    own = world.of_point(int(world.rng.integers(world.point_of.max() + 1)))
    pair = world.rng.choice(own, 2, replace=False)
    world.beams[pair] = world.beams[pair[::-1]]
    return dict.fromkeys(pair.tolist(), "label_swap")


def _axes(world: _World) -> Made:
    axis = world.rng.normal(size=3)
    axis = np.radians(2.5) * axis / np.linalg.norm(axis)
    world.beams += np.cross(axis, world.beams)
    world.beams /= np.linalg.norm(world.beams, axis=1, keepdims=True)
    return dict.fromkeys(list(range(len(world.head))), "direction")


def _head(factor: Callable[[Array], ComplexArray], verdict: str) -> Callable[[_World], Made]:
    def spoil(world: _World) -> Made:
        own = world.of_head(int(world.rng.integers(world.head.max() + 1)))
        world.factor[own] = factor(world.freq_hz)
        return dict.fromkeys(own, verdict)

    return spoil


def _head_direction(world: _World) -> Made:
    own = world.of_head(int(world.rng.integers(world.head.max() + 1)))
    _tilt(world, own, 3.0)
    return dict.fromkeys(own, "direction")


def _bends(world: _World) -> Made:
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


def _drying(world: _World) -> Made:
    """Let the stiffness rise by 3 % while the points are measured one after the other."""
    last = _points(world)[-1]
    for point in _points(world)[1:]:
        own = world.of_point(point)
        now = world.response(world.freq_hz, 1.0 + 0.03 * point / last)
        world.added[own] += (world.readings(now) - world.readings())[own]
    return dict.fromkeys(range(len(world.head)), "drift")


def _both(one: str, two: str) -> Callable[[_World], Made]:
    """Make two faults of which no point has both."""

    def spoil(world: _World) -> Made:
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
FAULTS: dict[str, Callable[[_World], Made]] = {
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


def possible(fault: str, body: str) -> bool:
    """Tell whether a body can have a fault at all."""
    return BODIES[body][1] > 1 or not fault.startswith(SEVERAL_HEADS)

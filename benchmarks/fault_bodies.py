"""Draw readings of rigid bodies from the physics of a mass on springs, with one fault each.

Shares no code with ``fault_scenes`` and none with the project: the bodies are shells seen from laser heads at
a finite distance, so that no two beams of a head are parallel; the motion is the forced response of a mass on
springs; the noise is white in velocity, of another size for each head.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.body_faults import FAULTS, SEVERAL_HEADS, Array, ComplexArray, Response, World


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
    world = World(
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


def possible(fault: str, body: str) -> bool:
    """Tell whether a body can have a fault at all."""
    return BODIES[body][1] > 1 or not fault.startswith(SEVERAL_HEADS)

"""Simulated readings of one rigid body with one fault.

Nothing of the project's fitting code is used: v(p) = v0 + omega x (p - p0), read along each beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.frames import rotation_from_vector

Array = NDArray[np.float64]
RESONANCES = ((1753.0, 0.12), (2783.0, 0.14), (3862.0, 0.16))


@dataclass
class Scene:
    """Reported geometry, and true geometry, factors, motion and noise of one body."""

    points: tuple[str, ...]
    reported: Array
    directions: Array
    freq_hz: Array
    q: NDArray[np.complex128]
    sd: Array
    placed: Array = field(default_factory=lambda: np.empty(0))
    true: Array = field(default_factory=lambda: np.empty(0))
    true_directions: Array = field(default_factory=lambda: np.empty(0))
    factor: NDArray[np.complex128] = field(default_factory=lambda: np.empty(0, dtype=complex))
    loud: Array = field(default_factory=lambda: np.empty(0))
    extra: NDArray[np.complex128] = field(default_factory=lambda: np.empty(0, dtype=complex))
    culprits: list[int] = field(default_factory=list)
    verdict: str = ""

    def clean(self) -> NDArray[np.complex128]:
        """Return what a body without fault would read (channel, freq)."""
        return readings(self.reported, self.directions, self.q)

    def faulty(self) -> NDArray[np.complex128]:
        """Return the readings with the fault, without noise."""
        return readings(self.true, self.true_directions, self.q) * self.factor + self.extra


def readings(positions_mm: Array, directions: Array, q: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Displacement along each beam (channel, freq)."""
    rows = np.hstack([directions, np.cross(positions_mm * 1e-3, directions)])
    return np.asarray(rows @ q.T)


def three_lasers(cone_deg: float = 20.0) -> Array:
    """Unit vectors towards three laser heads on a cone around y."""
    cone, turn = np.radians(cone_deg), np.radians([0.0, 120.0, 240.0])
    return np.column_stack(
        [np.sin(cone) * np.cos(turn), np.full(3, np.cos(cone)), np.sin(cone) * np.sin(turn)]
    )


def footplate(rng: np.random.Generator, count: int) -> Array:
    """Points on a footplate of 3.0 x 1.4 mm, 0.3 mm thick, mm."""
    turn = 2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 1.0)) / count
    ring = np.column_stack([1.3 * np.cos(turn), rng.uniform(0.0, 0.3, count), 0.6 * np.sin(turn)])
    return ring + 0.1 * rng.normal(size=ring.shape)


def whole_stapes(rng: np.random.Generator, count: int) -> Array:
    """Points on the footplate, and on crura and head above it, mm."""
    low = count // 2
    high = count - low
    arch = np.column_stack(
        [rng.uniform(-0.7, 0.7, high), np.linspace(1.0, 3.2, high), rng.uniform(-0.4, 0.4, high)]
    )
    return np.vstack([footplate(rng, low), arch])


GEOMETRIES: dict[str, tuple[Callable[[np.random.Generator], Array], Array]] = {
    "footplate, 5 points 3D": (lambda rng: footplate(rng, 5), np.eye(3)),
    "stapes, 10 points 3D": (lambda rng: whole_stapes(rng, 10), np.eye(3)),
    "stapes, 9 points, lasers at 20 deg": (lambda rng: whole_stapes(rng, 9), three_lasers(20.0)),
    "bone, 12 points, lasers at 30 deg": (
        lambda rng: rng.uniform(-4.0, 4.0, (12, 3)) * [1.0, 0.3, 1.0],
        three_lasers(30.0),
    ),
    "1D, 40 points": (lambda rng: rng.uniform(-1.0, 1.0, (40, 3)) * [1.4, 0.1, 0.65], np.eye(3)[1:2]),
}
SINGLE = (
    "gain 5 %", "gain 2 %", "phase 3 deg", "delay 10 us", "sign", "direction 3 deg", "noise x4",
    "drift 6 %", "zeros",
)  # fmt: skip
POINT = ("position 200 um", "point sign", "label swap")
THREE_D = ("beams swapped", "axes 2 deg", "laser gain 5 %", "laser sign", "laser direction 3 deg")
FAULTS = (*SINGLE, *POINT, *THREE_D, "flexible 3 %")


def possible(fault: str, geometry: str) -> bool:
    """Tell whether a geometry can have a fault at all."""
    flat = GEOMETRIES[geometry][1]
    return not (fault in THREE_D and len(flat) == 1)


def scene(
    seed: int,
    geometry: str,
    fault: str = "",
    *,
    noise: float = 0.01,
    lines: int = 120,
    position_sd_mm: float = 0.0,
    at: int | None = None,
) -> Scene:
    """Draw a scene: random points and motion, and the fault at a random place, or at channel ``at``."""
    rng = np.random.default_rng([seed, 53])
    make, beams = GEOMETRIES[geometry]
    places = make(rng)
    count, per = len(places), len(beams)
    freq = np.linspace(400.0, 5000.0, lines)
    q = np.zeros((lines, 6), dtype=complex)
    for resonance, damping in RESONANCES:
        ratio = freq / resonance
        shape = rng.normal(size=6) * np.array([25e-9, 100e-9, 25e-9, 35e-6, 15e-6, 35e-6])
        q += np.outer(1.0 / (1.0 - ratio**2 + 2j * damping * ratio), shape)
    q[:, 1] += 100e-9
    reported = np.repeat(places, per, axis=0)
    true = reported + np.repeat(position_sd_mm * rng.normal(size=places.shape), per, axis=0)
    directions = np.tile(beams, (count, 1))
    case = Scene(
        tuple(str(1 + c // per) for c in range(count * per)), reported, directions, freq, q, np.empty(0)
    )
    size = np.sqrt(np.mean(np.abs(case.clean()) ** 2))
    case.sd = np.full((count * per, lines), noise * size / np.sqrt(2.0))
    case.placed, case.true, case.true_directions = true, true.copy(), directions.copy()
    case.factor = np.ones((count * per, lines), dtype=complex)
    case.loud = np.ones(count * per)
    case.extra = np.zeros((count * per, lines), dtype=complex)
    if fault:
        _spoil(case, fault, rng, (count, per), at)
    return case


def _spoil(case: Scene, fault: str, rng: np.random.Generator, shape: tuple[int, int], at: int | None) -> None:
    count, per = shape
    channel = int(rng.integers(count * per))
    channel = channel if at is None else at
    point, beam = divmod(channel, per)
    own = list(range(per * point, per * point + per))
    laser = list(range(beam, count * per, per))
    tau = np.linspace(0.0, 1.0, len(case.freq_hz))
    case.culprits, case.verdict = [channel], fault.split()[0]
    if fault.startswith("gain"):
        case.factor[channel] = 1.0 + float(fault.split()[1]) / 100.0
    elif fault == "phase 3 deg":
        case.factor[channel], case.verdict = np.exp(1j * np.radians(3.0)), "gain"
    elif fault == "delay 10 us":
        case.factor[channel], case.verdict = np.exp(-2e-5j * np.pi * case.freq_hz), "gain"
    elif fault == "sign":
        case.factor[channel] = -1.0
    elif fault == "drift 6 %":
        case.factor[channel] = 1.0 + 0.06 * tau
    elif fault == "zeros":
        case.factor[channel], case.loud[channel] = 0.0, 0.0
    elif fault == "noise x4":
        case.loud[channel] = 4.0
    elif fault == "direction 3 deg":
        case.true_directions[channel] = _tilt(case.directions[channel], 3.0, rng) @ case.directions[channel]
    elif fault == "position 200 um":
        shift = rng.normal(size=3)
        case.true[own] += 0.2 * shift / np.linalg.norm(shift)
        case.culprits = own
    elif fault == "point sign":
        case.factor[own], case.culprits, case.verdict = -1.0, own, "sign"
    elif fault == "label swap":
        other = (point + 1 + int(rng.integers(count - 1))) % count
        others = list(range(per * other, per * other + per))
        case.true[own], case.true[others] = case.true[others].copy(), case.true[own].copy()
        case.culprits, case.verdict = sorted(own + others), "label_swap"
    elif fault == "beams swapped":
        other = own[(beam + 1) % per]
        pair = [channel, other]
        case.true_directions[pair] = case.directions[pair[::-1]]
        case.culprits, case.verdict = sorted(pair), "label_swap"
    elif fault == "axes 2 deg":
        axis = rng.normal(size=3)
        turn = rotation_from_vector(np.radians(2.0) * axis / np.linalg.norm(axis))
        case.true_directions[:] = case.directions @ turn.T
        case.culprits, case.verdict = list(range(count * per)), "direction"
    elif fault == "laser gain 5 %":
        case.factor[laser], case.culprits, case.verdict = 1.05, laser, "gain"
    elif fault == "laser sign":
        case.factor[laser], case.culprits, case.verdict = -1.0, laser, "sign"
    elif fault == "laser direction 3 deg":
        turn = _tilt(case.directions[channel], 3.0, rng)
        case.true_directions[laser] = case.directions[laser] @ turn.T
        case.culprits, case.verdict = laser, "direction"
    else:
        bend = (case.true[:, 1] / 3.0) ** 2 + (case.true[:, 0] / 1.4) ** 2
        shape = bend * case.directions[:, 1]
        shape = shape / np.sqrt(np.mean(shape**2))
        size = float(np.sqrt(np.mean(np.abs(case.clean()) ** 2)))
        course = 1.0 / (1.0 - (case.freq_hz / 6000.0) ** 2 + 0.05j)
        course = course / np.sqrt(np.mean(np.abs(course) ** 2))
        case.extra = 0.03 * size * np.outer(shape, course)
        case.culprits = list(range(count * per))


def _tilt(direction: Array, angle_deg: float, rng: np.random.Generator) -> Array:
    axis = np.cross(direction, rng.normal(size=3))
    return rotation_from_vector(np.radians(angle_deg) * axis / np.linalg.norm(axis))


def measured(case: Scene, seed: int) -> NDArray[np.complex128]:
    """Return the readings with noise."""
    rng = np.random.default_rng([seed, 59])
    noise = rng.normal(size=(*case.sd.shape, 2)) @ np.array([1.0, 1j])
    return np.asarray(case.faulty() + case.sd * case.loud[:, None] * noise)


def with_gaps(
    value: NDArray[np.complex128], seed: int, share: float, band: bool = False
) -> NDArray[np.complex128]:
    """Return readings with a share of single values missing at random, or one channel over many lines.

    Parameters
    ----------
    value : ndarray, (channel, freq), complex
    seed : int
    share : float
        Of all values.
    band : bool
        Leave one channel out over half of the lines, which follow each other.
    """
    rng = np.random.default_rng([seed, 61])
    case = value.copy()
    if share > 0.0:
        case[rng.random(case.shape) < share] = np.nan
    if band:
        channel, half = int(rng.integers(len(case))), case.shape[1] // 2
        start = int(rng.integers(half))
        case[channel, start : start + half] = np.nan
    return case


def two_faults(
    seed: int, geometry: str, faults: tuple[str, str], *, noise: float = 0.01, lines: int = 120
) -> Scene:
    """Draw a scene with a fault each of two channels of different points.

    ``verdict`` holds both verdicts, and ``culprits`` both channels, in this order.
    """
    first = scene(seed, geometry, faults[0], noise=noise, lines=lines)
    rng = np.random.default_rng([seed, 67])
    count = len(first.points)
    own = {first.points[c] for c in first.culprits}
    channel = int(rng.choice([c for c in range(count) if first.points[c] not in own]))
    turn = np.linspace(0.0, 1.0, lines)
    if faults[1] == "direction 4 deg":
        beam = first.directions[channel]
        first.true_directions[channel] = _tilt(beam, 4.0, rng) @ beam
    elif faults[1] == "noise x4":
        first.loud[channel] = 4.0
    elif faults[1] == "drift 10 %":
        first.factor[channel] = 1.0 + 0.1 * turn
    else:
        first.factor[channel] = {"sign": -1.0, "gain 5 %": 1.05}[faults[1]]
    first.culprits, first.verdict = [*first.culprits, channel], f"{first.verdict} {faults[1].split()[0]}"
    return first

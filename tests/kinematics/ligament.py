"""A stapes that hangs in the paper's ligament, and its base: two bodies in one or several runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.kinematics.measurement import BodyChannels, Measurement
from tests.kinematics.simulated import readings, stapes_points, three_beams

FREE = [1, 3, 5]
MASS = np.diag([3.2e-6, 3.2e-6, 3.2e-6, 9.77e-12, 3e-12, 11.14e-12])
STIFFNESS = np.array([[1722.0, 0.414, -0.48], [0.414, 1.37e-3, -6.41e-5], [-0.48, -6.41e-5, 3.79e-3]])
DAMPING = np.array(
    [[22.89e-3, 61.42e-7, -36.79e-7], [61.42e-7, 30.15e-9, -67.56e-13], [-36.79e-7, -67.56e-13, 56.46e-9]]
)
MAIN = {"y": 1, "x": 0, "z": 2}


def base_motion(freq_hz, main, rng, delay=1.0):
    """Displacement of the base, (freq, 6): mainly along one axis, with some rocking and in-plane motion."""
    size = 1e-7 * np.array([0.08, 0.08, 0.08, 40.0, 15.0, 40.0]) * rng.uniform(0.5, 1.5, 6)
    size[MAIN[main]] = 1e-7
    turn = delay * rng.uniform(-1.0, 1.0, 6) - delay * 2e-4 * freq_hz[:, None]
    ripple = 1.0 + 0.15 * np.sin(freq_hz[:, None] / 700.0 + rng.uniform(0.0, 6.0, 6))
    return size * ripple * np.exp(1j * turn)


def stapes_motion(freq_hz, base, *, scale=1.0, loss=0.0):
    """Motion of the stapes, (freq, 6): viscous, or hysteretic with a loss factor."""
    moved = base.copy()
    for k, w in enumerate(2.0 * np.pi * freq_hz):
        ligament = scale * STIFFNESS * (1.0 + 1j * loss) + (1j * w * DAMPING if loss == 0.0 else 0.0)
        moved[k, FREE] = np.linalg.solve(ligament - w**2 * MASS[np.ix_(FREE, FREE)], ligament @ base[k, FREE])
    return moved


def study(seed, runs=("y",), *, lines=120, noise=0.01, count=9, sd=True, delay=1.0, scale=1.0, loss=0.0):
    """Return stapes and base, each with ``count`` points of three beams, as one measurement."""
    rng = np.random.default_rng([seed, 93])
    freq = np.linspace(400.0, 5000.0, lines)
    bases = [base_motion(freq, main, rng, delay) for main in runs]
    motions = {"stapes": [stapes_motion(freq, b, scale=scale, loss=loss) for b in bases], "base": bases}
    bodies = []
    for name, moved in motions.items():
        places = np.repeat(
            stapes_points(rng, count) * (1.0 if name == "stapes" else [2.5, 0.5, 3.0]), 3, axis=0
        )
        beams = np.tile(three_beams(), (count, 1))
        clean = np.stack([readings(places, beams, q) for q in moved])
        size = noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=(1, 2), keepdims=True))
        spread = np.broadcast_to(size, clean.shape).copy()
        value = clean + spread * (rng.normal(size=(*clean.shape, 2)) @ [1.0, 1j])
        names = tuple(str(1 + c // 3) for c in range(3 * count))
        bodies.append(BodyChannels(name, names, places, beams, value, spread if sd else None))
    return Measurement("footplate", tuple(str(1 + k) for k in range(len(runs))), freq, tuple(bodies), 0)


def channels_of(body, point):
    return [c for c, name in enumerate(body.points) if name == point]


def exchanged(data, one, two, with_sd=True):
    """Exchange the rows of a stapes point (or channel number) and a base point (or channel)."""
    stapes, base = data.bodies
    i = channels_of(stapes, one) if isinstance(one, str) else [one]
    j = channels_of(base, two) if isinstance(two, str) else [two]
    first, second = stapes.displacement.copy(), base.displacement.copy()
    first[:, i], second[:, j] = base.displacement[:, j], stapes.displacement[:, i]
    bodies = (replace(stapes, displacement=first), replace(base, displacement=second))
    if with_sd and stapes.sd is not None:
        one_sd, two_sd = stapes.sd.copy(), base.sd.copy()
        one_sd[:, i], two_sd[:, j] = base.sd[:, j], stapes.sd[:, i]
        bodies = (replace(bodies[0], sd=one_sd), replace(bodies[1], sd=two_sd))
    return replace(data, bodies=bodies)


def relisted(data, number, point):
    """List a point of one body, with its position, under the other."""
    gives, takes = data.bodies[number], data.bodies[1 - number]
    own = channels_of(gives, point)
    rest = [c for c in range(len(gives.points)) if c not in own]

    def picked(body, channels, name):
        return BodyChannels(
            name,
            tuple(body.points[c] for c in channels),
            body.positions_mm[channels],
            body.directions[channels],
            body.displacement[:, channels],
            None if body.sd is None else body.sd[:, channels],
            position_sd_mm=body.position_sd_mm[channels],
        )

    moved = picked(gives, own, takes.body)
    parts = ("positions_mm", "directions")
    grown = BodyChannels(
        takes.body,
        (*takes.points, *("extra" for _ in own)),
        *(np.concatenate([getattr(takes, part), getattr(moved, part)]) for part in parts),
        np.concatenate([takes.displacement, moved.displacement], axis=1),
        None if takes.sd is None else np.concatenate([takes.sd, moved.sd], axis=1),
        position_sd_mm=np.concatenate([takes.position_sd_mm, moved.position_sd_mm]),
    )
    bodies = [grown, grown]
    bodies[number] = picked(gives, rest, gives.body)
    return replace(data, bodies=tuple(bodies))


def altered(data, number, channels, change):
    """Change the readings (run, k, freq) of some channels of a body."""
    body = data.bodies[number]
    value = body.displacement.copy()
    value[:, channels] = change(value[:, channels])
    bodies = list(data.bodies)
    bodies[number] = replace(body, displacement=value)
    return replace(data, bodies=tuple(bodies))


def with_lines(data, number, channels, lines):
    """Take what some channels of a body read from other lines (freq,); -1 where nothing was read."""
    body, own = data.bodies[number], list(channels)
    ratio = (data.freq_hz[lines] / data.freq_hz) ** data.order
    value, sd = body.displacement.copy(), body.sd.copy()
    value[:, own] = np.where(lines < 0, np.nan, value[:, own][..., lines] * ratio)
    sd[:, own] = sd[:, own][..., lines] * ratio
    bodies = list(data.bodies)
    bodies[number] = replace(body, displacement=value, sd=sd)
    return replace(data, bodies=tuple(bodies))

"""Vibrometer data of rigid bodies from v(p) = v0 + omega x (p - p0), with one fault at a time.

Nothing of the project's fitting code is used here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.frames import rotation_from_vector

RESONANCES = ((1753.0, 0.12), (2783.0, 0.14), (3862.0, 0.16))
FAULTS = ("gain", "sign", "direction", "position", "noise", "label_swap", "drift", "flexible")


@dataclass
class Scene:
    """True geometry and motion of one body, what was reported of it, and what it read."""

    points: tuple[str, ...]
    positions_mm: np.ndarray
    directions: np.ndarray
    freq_hz: np.ndarray
    q: np.ndarray
    value: np.ndarray
    sd: np.ndarray
    culprits: list[int] = field(default_factory=list)


def three_beams(cone_deg=20.0):
    """Unit vectors towards three laser heads on a cone around y."""
    cone, turn = np.radians(cone_deg), np.radians([0.0, 120.0, 240.0])
    return np.column_stack(
        [np.sin(cone) * np.cos(turn), np.full(3, np.cos(cone)), np.sin(cone) * np.sin(turn)]
    )


def stapes_points(rng, count=9):
    """Points on a footplate of 2.8 x 1.2 mm and on crura and head above it, mm."""
    low = count // 2
    plate = np.column_stack(
        [rng.uniform(-1.4, 1.4, low), rng.uniform(0.0, 0.3, low), rng.uniform(-0.6, 0.6, low)]
    )
    high = count - low
    arch = np.column_stack(
        [rng.uniform(-0.6, 0.6, high), rng.uniform(1.0, 3.3, high), rng.uniform(-0.4, 0.4, high)]
    )
    return np.vstack([plate, arch])


def smooth_motion(rng, freq_hz):
    """Displacements (freq, 6), m and rad: a piston with three resonances that turn it too."""
    q = np.zeros((len(freq_hz), 6), dtype=complex)
    for resonance, damping in RESONANCES:
        ratio = freq_hz / resonance
        shape = rng.normal(size=6) * np.array([25e-9, 100e-9, 25e-9, 35e-6, 15e-6, 35e-6])
        q += np.outer(1.0 / (1.0 - ratio**2 + 2j * damping * ratio), shape)
    q[:, 1] += 100e-9
    return q


def readings(positions_mm, directions, q):
    """Displacement along each beam (channel, freq), point by point."""
    return np.array(
        [
            (q[:, :3] + np.cross(q[:, 3:], position * 1e-3)) @ direction
            for position, direction in zip(positions_mm, directions, strict=True)
        ]
    )


def scene(seed, fault="", *, lines=200, count=9, snr=100.0, position_sd_mm=0.0, q=None):
    """Simulate one body of ``count`` points with three beams each, and one fault."""
    rng = np.random.default_rng([seed, 41])
    places = stapes_points(rng, count)
    freq_hz = np.linspace(400.0, 5000.0, lines)
    q = smooth_motion(rng, freq_hz) if q is None else q
    reported = np.repeat(places, 3, axis=0)
    true = reported + np.repeat(position_sd_mm * rng.normal(size=places.shape), 3, axis=0)
    beams = np.tile(three_beams(), (count, 1))
    true_beams = beams.copy()
    factor = np.ones((3 * count, lines), dtype=complex)
    loud = np.ones(3 * count)
    channel = int(rng.integers(3 * count))
    own = [3 * (channel // 3) + k for k in range(3)]
    culprits = [channel]
    if fault == "gain":
        factor[channel] = 1.05
    elif fault == "sign":
        factor[channel] = -1.0
    elif fault == "drift":
        factor[channel] = 1.0 + 0.06 * np.linspace(0.0, 1.0, lines)
    elif fault == "noise":
        loud[channel] = 4.0
    elif fault == "direction":
        across = np.cross(beams[channel], rng.normal(size=3))
        axis = across / np.linalg.norm(across)
        true_beams[channel] = rotation_from_vector(np.radians(4.0) * axis) @ beams[channel]
    elif fault == "position":
        shift = rng.normal(size=3)
        true[own] += 0.25 * shift / np.linalg.norm(shift)
        culprits = own
    elif fault == "label_swap":
        other = (channel // 3 + 1 + int(rng.integers(count - 1))) % count
        others = [3 * other + k for k in range(3)]
        true[own], true[others] = true[others].copy(), true[own].copy()
        culprits = sorted(own + others)
    elif fault == "flexible":
        culprits = list(range(3 * count))
    clean = readings(true, true_beams, q) * factor
    if fault == "flexible":
        bend = (true[:, 1] / 3.0) ** 2 + 0.7 * (true[:, 0] / 1.4) ** 2
        size = np.sqrt(np.mean(np.abs(q[:, 1]) ** 2))
        clean = clean + 0.06 * size * np.outer(
            bend * beams[:, 1], 1.0 / (1.0 - (freq_hz / 6000.0) ** 2 + 0.05j)
        )
    sd = np.full(clean.shape, np.sqrt(np.mean(np.abs(clean) ** 2)) / snr / np.sqrt(2.0))
    noise = rng.normal(size=(*clean.shape, 2)) @ np.array([1.0, 1j])
    value = clean + sd * loud[:, None] * noise
    names = tuple(str(1 + c // 3) for c in range(3 * count))
    return Scene(names, reported, beams, freq_hz, q, value, sd, culprits if fault else [])


def body(name, made, position_sd_mm=np.nan, sd=True):
    """Return a scene as the channels of a body in one run."""
    return BodyChannels(
        name,
        made.points,
        made.positions_mm,
        made.directions,
        made.value[None],
        made.sd[None] if sd else None,
        not sd,
        np.full(len(made.points), position_sd_mm),
    )


def measurement(*bodies, freq_hz, order=0):
    """Return bodies in the footplate frame as one measurement."""
    return Measurement("footplate", ("1",), freq_hz, tuple(bodies), order)


def csv_rows(name, made, digits=12):
    """Return rows body, point, x, y, z, dir_x, dir_y, dir_z, freq, re, im, sd of velocities in m/s."""
    rows = []
    w = 2.0 * np.pi * made.freq_hz
    velocity = made.value * 1j * w
    sd = made.sd * w
    for c, point in enumerate(made.points):
        place = ",".join(f"{x:.9g}" for x in (*made.positions_mm[c], *made.directions[c]))
        for k, freq in enumerate(made.freq_hz):
            v = velocity[c, k]
            rows.append(
                f"{name},{point},{place},{freq:.12g},{v.real:.{digits}g},{v.imag:.{digits}g},{sd[c, k]:.9g}"
            )
    return rows


HEADER = "body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s,sd_m_s"

"""Faults put into a simulated recording: what goes wrong at a vibrometer, one kind at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.frames import rotation_from_vector
from sample_volumes.vibrometer import Recording

Array = NDArray[np.float64]
KINDS = ("gain", "sign", "direction", "position", "label_swap", "noise", "drift", "zeros", "conjugate")


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind : str
        One of KINDS. ``position`` and ``label_swap`` concern a point, ``conjugate`` (the e^{-i w t}
        convention) all channels, the others one channel.
    body, point : str
        Names in the recording.
    beam : int
        0, 1 or 2 of the point.
    size : float
        gain: relative error; direction: degrees; position: mm; noise: how many times the stated sd;
        drift: relative change of the gain from the first to the last line. Unused by the others.
    other : str
        The point that ``point`` is swapped with.
    """

    kind: str
    body: str = "stapes"
    point: str = "1"
    beam: int = 0
    size: float = 0.05
    other: str = "2"


def faulty(recording: Recording, fault: Fault, seed: int = 1) -> Recording:
    """Return the recording with one fault; what is reported and what was seen no longer agree.

    Raises
    ------
    ValueError
        The kind is unknown, or the recording holds no such point or beam.
    """
    if fault.kind not in KINDS:
        raise ValueError(f"the fault must be one of {', '.join(KINDS)}; got {fault.kind}.")
    if fault.kind == "conjugate":
        return replace(recording, velocity_m_s=recording.velocity_m_s.conj())
    rng = np.random.default_rng([seed, 13])
    own = _channels(recording, fault.body, fault.point)
    if fault.kind == "position":
        position = recording.position_mm.copy()
        position[own] += fault.size * _unit(rng)
        return replace(recording, position_mm=position)
    if fault.kind == "label_swap":
        position = recording.position_mm.copy()
        other = _channels(recording, fault.body, fault.other)
        position[own], position[other] = recording.position_mm[other[0]], recording.position_mm[own[0]]
        return replace(recording, position_mm=position)
    if not 0 <= fault.beam < len(own):
        raise ValueError(f"the beam must be one of 0 to {len(own) - 1}; got {fault.beam}.")
    channel = own[fault.beam]
    if fault.kind == "direction":
        return replace(recording, direction=_tilt(recording, channel, fault.size, rng))
    velocity = recording.velocity_m_s.copy()
    lines = len(recording.freq_hz)
    if fault.kind == "gain":
        velocity[:, channel] *= 1.0 + fault.size
    elif fault.kind == "sign":
        velocity[:, channel] *= -1.0
    elif fault.kind == "drift":
        velocity[:, channel] *= 1.0 + fault.size * np.linspace(0.0, 1.0, lines)
    elif fault.kind == "zeros":
        velocity[:, channel] = 0.0
    else:
        more = rng.standard_normal((len(recording.runs), lines, 2)) @ np.array([1.0, 1j])
        velocity[:, channel] += fault.size * recording.sd_m_s[:, channel, None] * more
    return replace(recording, velocity_m_s=velocity)


def _channels(recording: Recording, body: str, point: str) -> list[int]:
    pairs = zip(recording.body, recording.point, strict=True)
    numbers = [number for number, pair in enumerate(pairs) if pair == (body, point)]
    if not numbers:
        raise ValueError(f"the point must be one of the recording; got {body} {point}.")
    return numbers


def _tilt(recording: Recording, channel: int, angle_deg: float, rng: np.random.Generator) -> Array:
    """Return the reported directions with one of them turned away from the true beam."""
    direction = recording.direction.copy()
    axis = np.cross(direction[channel], _unit(rng))
    turn = rotation_from_vector(np.radians(angle_deg) * axis / np.linalg.norm(axis))
    direction[channel] = turn @ direction[channel]
    return direction


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))

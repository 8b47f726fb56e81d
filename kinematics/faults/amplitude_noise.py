"""Noise that grows with the amplitude of what is read, as that of speckle and of ranges does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.faults.lines import line_residuals
from kinematics.joint.estimate import State
from kinematics.joint.pack import Readings

_SHARES = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 33)])  # of the amplitude, over the constant part
_LEAST_GAIN = 3.0  # log likelihood of the middle channel: e^3 in each of half the channels
_LEAST_LINES = 4  # for each motion


def amplitude_noise(readings: Readings, state: State) -> Readings | None:
    """Return the readings with noise that grows with their amplitude.

    None where noise of one size in each channel explains the residuals as well.

    Notes
    -----
    The variance of a value a is taken as sd^2 + (share a)^2, up to a factor of each channel. What follows the
    motion in a channel is subtracted before, so that faults that are the same at all lines do not matter, and
    the middle channel decides, so that few channels do not.
    """
    lines = line_residuals(readings, state)
    gains = []
    for rest, size, factor in zip(lines.scaled, lines.size, readings.sd, strict=True):
        used = np.flatnonzero(np.isfinite(rest))
        if len(used) < _LEAST_LINES * len(lines.motion):
            continue
        course = np.linalg.qr((lines.motion[:, used] / factor[used]).T)[0]
        square = np.abs(rest[used] - course @ (course.conj().T @ rest[used])) ** 2
        variance = 1.0 + (_SHARES[:, None] * size[used]) ** 2
        likelihood = -np.log(variance).sum(axis=1) - len(used) * np.log(np.mean(square / variance, axis=1))
        gains.append(likelihood - likelihood[0])
    middle = np.median(gains, axis=0) if len(gains) > 2 else np.zeros(len(_SHARES))
    best = int(np.argmax(middle))
    if middle[best] < _LEAST_GAIN:
        return None
    amplitude = np.where(np.isfinite(lines.size), lines.size, 0.0)
    return replace(readings, sd=readings.sd * np.sqrt(1.0 + (_SHARES[best] * amplitude) ** 2))

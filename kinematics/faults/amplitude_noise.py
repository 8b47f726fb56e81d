"""Noise that grows with the amplitude of what is read, as that of speckle and of ranges does.

Shapes: c channels, N lines of all runs.
"""

from __future__ import annotations

import numpy as np

from kinematics.fit.lsq import solve
from kinematics.joint.estimate import State
from kinematics.joint.pack import Readings
from stapeskit.arrays import Array

_SHARES = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 33)])  # of the amplitude, over the constant part
_LEAST_GAIN = 3.0  # log likelihood of the middle channel: e^3 in each of half the channels
_LEAST_LINES = 4  # for each motion


def amplitude_noise(readings: Readings, state: State) -> tuple[Readings, float] | None:
    """Return the readings with noise that grows with their amplitude, and by which share of it.

    None where noise of one size in each channel explains the residuals as well.

    Notes
    -----
    The variance of a value a is taken as sd^2 + (share a)^2, up to a factor of each channel. What follows the
    motion in a channel is subtracted before, so that faults that are the same at all lines do not matter, and
    the middle channel decides, so that few channels do not.
    """
    rows = state.rows @ state.packed.visible
    factor = readings.geometry.factor.T
    live = np.isfinite(readings.noise_factor)
    value = np.where(live[:, None], readings.value / np.where(factor == 0.0, 1.0, factor), np.nan)
    scaled = readings.sd * np.where(live, readings.noise_factor, 1.0)[:, None]
    z = solve(rows, value, scaled).z
    fitted = rows @ z
    size = np.abs(fitted) / scaled
    gains = []
    for channel in np.flatnonzero(live):
        used = np.flatnonzero(np.isfinite(value[channel]) & np.isfinite(fitted[channel]))
        if len(used) < _LEAST_LINES * len(z):
            continue
        course = np.linalg.qr((z[:, used] / scaled[channel, used]).T)[0]
        rest = (value[channel, used] - fitted[channel, used]) / scaled[channel, used]
        square = np.abs(rest - course @ (course.conj().T @ rest)) ** 2
        variance = 1.0 + (_SHARES[:, None] * size[channel, used]) ** 2
        likelihood = -np.log(variance).sum(axis=1) - len(used) * np.log(np.mean(square / variance, axis=1))
        gains.append(likelihood - likelihood[0])
    if len(gains) < 3:
        return None
    middle = np.median(gains, axis=0)
    best = int(np.argmax(middle))
    if middle[best] < _LEAST_GAIN:
        return None
    share = float(_SHARES[best])
    amplitude: Array = np.where(np.isfinite(size), size, 0.0)
    sd = readings.sd * np.sqrt(1.0 + (share * amplitude) ** 2)
    changed = Readings(
        readings.value,
        sd,
        readings.freq_hz,
        readings.tau,
        readings.run,
        readings.geometry,
        readings.noise_factor,
    )
    return changed, share

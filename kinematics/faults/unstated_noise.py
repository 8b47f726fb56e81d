"""Noise that a file does not state, next to faults: its level, and noise in proportion to amplitude.

Shapes: c channels, N lines of all runs, r motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinematics.faults.scores import Noise, Test
from kinematics.fit.noise import FAR, FLOOR, Residuals, robust_residuals
from kinematics.joint.estimate import Estimate, State
from kinematics.joint.pack import Readings
from stapeskit.arrays import Array

_LEAST_LEVEL_DOF = 200.0  # of a noise level apart from the motion: known to 5 %
_SHARES = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 33)])  # of the amplitude, over the constant part
_LEAST_GAIN = 3.0  # log likelihood of the middle channel: e^3 in each of half the channels
_LEAST_LINES = 4  # for each motion


def unknown_noise(estimate: Estimate, tests: Sequence[Test], unsure: Array) -> Noise:
    """Return the level of noise that is not stated: from columns without motion, else from residuals.

    ``unsure`` (c,) is the variance of the logarithm of each channel's noise, as it was estimated.

    Notes
    -----
    The weights of channels follow the noise of the columns that they were estimated from, whose squares are
    smaller than those of others: with the leverage h, the logarithm of a channel's variance has the variance
    v = 4 unsure / (1 - h), and others are larger by v in the mean (as those of Fisher's F, f / (f - 2), with
    v = 2 / f). Over all channels, which keep 1 - h of their squares, v / 2 is one over degrees of freedom.
    """
    state = estimate.state
    energy, freedom = (float(part.sum()) for part in state.noise_energy)
    if freedom < _LEAST_LEVEL_DOF:
        top = max(tests, key=lambda test: test.statistic / max(test.freedom, 1), default=None)
        taken = (top.statistic, top.freedom) if top else (0.0, 0)
        energy += max(estimate.chi2 - taken[0], 0.0)
        freedom += max(state.freedom - taken[1], 1)
    kept = 1.0 - np.mean(state.leverage, axis=0)
    whole = max(float(np.sum(kept)), 1.0)
    larger = 1.0 + 4.0 * float(np.sum(unsure)) / whole
    share = 2.0 * float(kept @ unsure) / whole**2
    level = larger * max(energy, FLOOR**2) / max(freedom, 1.0)  # exact data leave nothing
    return Noise(level, 1.0 / (1.0 / max(freedom, 1.0) + share))


def line_residuals(readings: Readings, state: State) -> Residuals:
    """Fit the motion of every line under the geometry of a state."""
    factor = readings.geometry.factor.T
    live = np.isfinite(readings.noise_factor)[:, None]
    value = np.where(live, readings.value / np.where(factor == 0.0, 1.0, factor), np.nan)
    sd = readings.sd * np.where(live, readings.noise_factor[:, None], 1.0)
    return robust_residuals(state.rows @ state.packed.visible, value, sd)


def amplitude_noise(readings: Readings, state: State) -> Readings | None:
    """Return the readings with noise that grows with their amplitude.

    None where noise of one size in each channel explains the residuals as well.

    Notes
    -----
    The variance of a value a is taken as sd^2 + (share a)^2, up to a factor of each channel. What follows the
    motion in a channel is subtracted before, so that faults that are the same at all lines do not matter, and
    the middle channel decides, so that few channels do not; nor do values far off, which are left out.
    """
    lines, gains = line_residuals(readings, state), []
    near, sizes = np.where(lines.squares < FAR, lines.left, np.nan), np.abs(lines.fitted)
    for rest, size, factor in zip(near, sizes, readings.sd, strict=True):
        used = np.flatnonzero(np.isfinite(rest))
        if len(used) < _LEAST_LINES * len(lines.z):
            continue
        course = np.linalg.qr((lines.z[:, used] / factor[used]).T)[0]
        square = np.abs(rest[used] - course @ (course.conj().T @ rest[used])) ** 2
        variance = 1.0 + (_SHARES[:, None] * size[used]) ** 2
        likelihood = -np.log(variance).sum(axis=1) - len(used) * np.log(np.mean(square / variance, axis=1))
        gains.append(likelihood - likelihood[0])
    middle = np.median(gains, axis=0) if len(gains) > 2 else np.zeros(len(_SHARES))
    best = int(np.argmax(middle))
    if middle[best] < _LEAST_GAIN:
        return None
    amplitude = np.where(np.isfinite(sizes), sizes, 0.0)
    return replace(readings, sd=readings.sd * np.sqrt(1.0 + (_SHARES[best] * amplitude) ** 2))

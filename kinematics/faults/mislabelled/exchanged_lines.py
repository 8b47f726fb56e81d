"""Two lines whose readings were exchanged, and lines at which a body agrees much worse than at others."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from kinematics.fit.rigid_fit import LineFit
from stapeskit.arrays import Array, ComplexArray

# How many of the roughest lines are exchanged with each other in trial.
_MOST = 8
# Lines to either side whose median is the usual comparison.
_AROUND = 7
# A jump, in units of its expected square, and what an exchange may leave of it.
_ROUGH, _SETTLES = 30.0, 0.05
# The cubic through the four neighbours of a line, at the line (Lagrange).
_BESIDE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0
# How many times the usual chi2 a line that agrees much worse has at least.
_LOUD = 3.0


def loud_lines(fit: LineFit) -> list[tuple[int, int]]:
    """Return pairs of the few lines at which a body agrees much worse than at the others."""
    good = np.isfinite(fit.chi2) & (fit.n_dof > 0)
    if np.sum(good) < 12:
        return []
    ratio = np.where(good, fit.chi2 / np.maximum(fit.n_dof, 1), 0.0)
    freedom = float(np.median(fit.n_dof[good]))
    typical = max(float(np.median(ratio[good])), 1e-300)
    loud = np.flatnonzero(ratio > typical * max(_LOUD, 1.0 + 10.0 * np.sqrt(2.0 / freedom)))
    if not 2 <= len(loud) <= max(4, len(ratio) // 20):
        return []
    worst = loud[np.argsort(-ratio[loud], kind="stable")[:4]]
    return [(int(min(pair)), int(max(pair))) for pair in combinations(worst, 2)]


def exchanged_pair(readings: ComplexArray, sd: Array) -> tuple[int, int] | None:
    """Return the two lines of readings (freq, m) whose exchange makes them smooth; None without such.

    Notes
    -----
    Each line is compared with the cubic through its four neighbours, in units of its noise and of what this
    comparison gives at the lines around it.
    """
    count = len(readings)
    if count < 16 or not np.all(np.isfinite(readings)) or not np.all(np.isfinite(sd)):
        return None
    rough = _roughness(readings)
    noise = 2.0 * sd**2 * (1.0 + float(np.sum(_BESIDE**2)))
    beyond = np.pad(rough, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(beyond, 2 * _AROUND + 1, axis=0), axis=-1)
    scale = np.maximum(noise + 2.0 * usual, 1e-300)
    size = np.mean(rough / scale, axis=1)
    roughest = np.argsort(-size, kind="stable")[:_MOST]
    roughest = roughest[size[roughest] > _ROUGH]
    if not roughest.size:
        return None
    least, pair = _SETTLES, None
    for k, m in combinations(np.unique([*roughest.tolist(), 0, 1, count - 2, count - 1]), 2):
        near = np.unique(np.clip([n + j for n in (k, m) for j in range(-2, 3)], 0, count - 1))
        before = np.mean(size[near])
        if max(size[k], size[m]) < _ROUGH or before < _ROUGH:
            continue
        exchanged = readings.copy()
        exchanged[[k, m]] = readings[[m, k]]
        after = np.mean(_roughness(exchanged)[near] / scale[near])
        if after < min(least * before, _ROUGH):
            least, pair = after / before, (int(k), int(m))
    return pair


def _roughness(readings: ComplexArray) -> Array:
    """Return |line - cubic of its neighbours|^2, (freq, m); zero at the ends."""
    roughness = np.zeros(readings.shape)
    between = sum(_BESIDE[j] * readings[j : len(readings) - 4 + j] for j in range(5))
    roughness[2:-2] = np.abs(readings[2:-2] - between) ** 2
    return roughness

"""Profile likelihood intervals: where the data are weak, chi2 is no parabola and the Fisher matrix misleads.

The interval of an entry holds all its values for which chi2, minimised over the other entries, exceeds its
minimum by no more than a quantile of chi2 with one degree of freedom (Venzon and Moolgavkar 1988,
doi:10.2307/2347496), times the variance of the entry over what the curvature of chi2 alone would give: the
scores spread more than that where the noise of the motion is large (fitting.estimators.regressor_noise).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import Estimate, EstimatorOptions, solve_symmetric
from legacy.fitting.model.parameter_vector import pairs
from legacy.fitting.model.scaled_lines import Lines
from legacy.fitting.uncertainty.covariance import degrees, invert, known_and_spread
from legacy.stapeskit.arrays import Array

# Chi2 of one degree of freedom at 95 %.
QUANTILE_95 = 3.841458820694124
# Of the search for one end of an interval, and of the refits on the way.
_MOST_STEPS = 12
_MOST_REFITS = 12
# Farther than this many Fisher standard deviations from the estimate an end counts as infinite.
_FARTHEST = 60.0


def profile_intervals(lines: Lines, estimate: Estimate, options: EstimatorOptions, widened: float) -> Array:
    """Return the 95 % intervals of the scaled parameters, (p, 2); infinite where chi2 never rises enough.

    Parameters
    ----------
    estimate : Estimate
        By ml.
    widened : float
        Factor on the noise covariance because chi2 exceeds its degrees of freedom.

    Notes
    -----
    The minimum and its neighbours are taken without K >= 0 and D >= 0; diagonal entries are then cut at zero.
    """
    best = ml.estimate(lines, replace(options, passive=False), estimate.parameters)
    with np.errstate(all="ignore"):
        return _intervals(lines, best, widened)


def _intervals(lines: Lines, best: Estimate, widened: float) -> Array:
    hessian, _ = ml.normal_equations(best.parameters, lines)
    if not np.all(np.isfinite(hessian)):
        return np.tile([-np.inf, np.inf], (len(best.parameters), 1))
    level = 2.0 * best.objective / max(degrees(lines), 1)
    known, spread = known_and_spread(best.parameters, lines, level)
    inverse = invert(known)
    covariance = 0.5 * widened * inverse @ spread @ inverse
    feigned = np.diag(covariance) / (0.5 * widened * np.diag(inverse))
    wanted = QUANTILE_95 * widened * feigned
    ends = np.empty((len(best.parameters), 2))
    for place in range(len(ends)):
        for side, sign in enumerate((-1.0, 1.0)):
            ends[place, side] = best.parameters[place] + sign * _reach(
                lines, best, covariance, place, sign, wanted[place]
            )
    half = len(ends) // 2
    for place, (row, column) in enumerate(pairs(lines.n)):
        if row == column:
            ends[[place, place + half]] = np.maximum(ends[[place, place + half]], 0.0)
    return ends


def _reach(lines: Lines, best: Estimate, covariance: Array, place: int, sign: float, wanted: float) -> float:
    """Return how far one entry may go to one side, by a secant search in the root of the rise of chi2."""
    sd = float(np.sqrt(covariance[place, place]))
    along = covariance[:, place] / covariance[place, place]
    target = np.sqrt(wanted)
    rise = _riser(lines, best, along, place, sign)
    near, low = 0.0, 0.0
    far = 1.96 * sd
    for _ in range(_MOST_REFITS):
        high = rise(far)
        if high < target:
            slope = (high - low) / (far - near)
            near, low = far, high
            step = (target - high) / slope if slope > 0.0 else 2.0 * far
            far = far + min(1.1 * step, 2.0 * far)
            if far > _FARTHEST * sd:
                return float("inf")
            continue
        if high - target < 1e-3 * target:
            return far
        middle = near + (far - near) * (target - low) / (high - low)
        reached = rise(middle)
        if abs(reached - target) < 1e-3 * target:
            return middle
        if reached < target:
            near, low = middle, reached
        else:
            far = middle
    return far


def _riser(lines: Lines, best: Estimate, along: Array, place: int, sign: float) -> Callable[[float], float]:
    """Return the root of the rise of chi2 as a function of an entry's distance from its estimate."""
    others = np.flatnonzero(np.arange(len(along)) != place)
    known: list[tuple[float, Array]] = [(0.0, best.parameters)]

    def rise(distance: float) -> float:
        before, start = known[-1]
        parameters, value = _minimise_others(lines, start + sign * (distance - before) * along, others)
        if np.isfinite(value):
            known.append((distance, parameters))
        return float(np.sqrt(max(2.0 * (value - best.objective), 0.0)))

    return rise


def _minimise_others(lines: Lines, parameters: Array, others: NDArray[np.intp]) -> tuple[Array, float]:
    """Minimise over the other entries by Gauss-Newton with halved steps; return parameters and objective."""
    value = float(np.sum(ml.distances(parameters, lines)))
    for _ in range(_MOST_STEPS):
        hessian, gradient = ml.normal_equations(parameters, lines)
        if not np.all(np.isfinite(hessian)):
            break
        step = np.zeros(len(parameters))
        step[others] = -solve_symmetric(hessian[np.ix_(others, others)], gradient[others])
        decrement = float(step @ hessian @ step)
        for length in (1.0, 0.5, 0.25, 0.1, 0.02):
            reached = float(np.sum(ml.distances(parameters + length * step, lines)))
            if reached <= value:
                parameters, value = parameters + length * step, reached
                break
        else:
            break
        if decrement < 1e-4:
            break
    return parameters, value

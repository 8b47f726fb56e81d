"""Minimise a smooth function of a few parameters that is evaluated at many points at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class Minimum:
    """Where a function is least.

    Attributes
    ----------
    point : ndarray, (p,)
    curvature : ndarray, (p, p)
        Second derivatives there.
    """

    point: Array
    value: float
    curvature: Array


def minimise(
    function: Callable[[Array], Array],
    starts: Array,
    scales: Array,
    low: Array,
    high: Array,
    steps: int = 60,
    tolerance: float = 1e-10,
) -> Minimum:
    """Find the least value from several starts by Newton's method with trial damping.

    Derivatives are central differences; function values alone decide which step is taken, so that the value
    found is exact to the tolerance whatever the differences lose.

    Parameters
    ----------
    function : callable
        From (g, p) to (g,).
    starts : ndarray, (s, p)
    scales : ndarray, (p,)
        Sizes over which the function changes; differences are taken over a thousandth of these.
    low, high : ndarray, (p,)
        Bounds of the parameters.
    steps : int
        At most so many steps from each start; five to ten are usual.
    tolerance : float
        A start ends when a step gains less.
    """
    best: Minimum | None = None
    for start in np.atleast_2d(starts):
        minima = _descend(function, np.clip(start, low, high), scales, low, high, steps, tolerance)
        if best is None or minima.value < best.value:
            best = minima
    if best is None:
        raise ValueError("at least one start must be given")
    return best


def _descend(
    function: Callable[[Array], Array],
    point: Array,
    scales: Array,
    low: Array,
    high: Array,
    steps: int,
    tolerance: float,
) -> Minimum:
    damping = np.r_[0.0, 10.0 ** np.arange(-3, 5)]
    value, gradient, curvature = _derivatives(function, point, scales)
    for _ in range(steps):
        # A parameter at a bound that it would cross stays there; the others move as if it were fixed.
        moves = ~(((point <= low) & (gradient > 0.0)) | ((point >= high) & (gradient < 0.0)))
        gradient = np.where(moves, gradient, 0.0)
        scaled = curvature * np.outer(scales, scales)
        scaled = np.where(np.outer(moves, moves), scaled, np.diag(np.diag(scaled)))
        roots, axes = np.linalg.eigh(0.5 * (scaled + scaled.T))
        size = np.maximum(np.abs(roots), 1e-6 * max(np.abs(roots).max(), 1e-12))
        slope = axes.T @ (gradient * scales)
        trials = -(slope / (size + damping[:, None] * size.max())) @ axes.T * scales
        reach = np.max(np.abs(trials) / (4.0 * scales), axis=1)
        trials /= np.maximum(reach, 1.0)[:, None]
        places = np.clip(point + trials, low, high)
        values = function(places)
        values = np.where(np.isfinite(values), values, np.inf)
        k = int(np.argmin(values))
        gain = value - values[k]
        if gain <= 0.0:
            break
        point = places[k]
        value, gradient, curvature = _derivatives(function, point, scales)
        if gain < tolerance:
            break
    return Minimum(point, value, curvature)


@cache
def _stencil(p: int) -> tuple[list[tuple[int, int]], Array]:
    """Return the pairs of p parameters, and the steps (points, p) of central differences."""
    step = np.eye(p)
    pairs = list(combinations(range(p), 2))
    crosses = [
        sign_a * step[a] + sign_b * step[b] for a, b in pairs for sign_a in (1, -1) for sign_b in (1, -1)
    ]
    return pairs, np.array([np.zeros(p), *step, *-step, *crosses])


def _derivatives(
    function: Callable[[Array], Array], point: Array, scales: Array
) -> tuple[float, Array, Array]:
    """Return value, gradient (p,) and second derivatives (p, p) by central differences."""
    p = len(point)
    h = 1e-3 * scales
    pairs, stencil = _stencil(p)
    values = function(point + stencil * h)
    up, down = values[1 : p + 1], values[p + 1 : 2 * p + 1]
    gradient = (up - down) / (2.0 * h)
    curvature = np.diag((up - 2.0 * values[0] + down) / h**2)
    for (a, b), (pp, pm, mp, mm) in zip(pairs, values[2 * p + 1 :].reshape(-1, 4), strict=True):
        curvature[a, b] = curvature[b, a] = (pp - pm - mp + mm) / (4.0 * h[a] * h[b])
    return float(values[0]), gradient, curvature

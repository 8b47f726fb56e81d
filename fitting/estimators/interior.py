"""Minimisation within K >= 0 and D >= 0 by a log-determinant barrier (path following).

For a convex objective the multiplier that the barrier leaves bounds the distance to the global optimum by
2 n / t in the objective's own units (Boyd and Vandenberghe 2004, Convex Optimization, section 11.6).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fitting.estimators.base import solve_symmetric
from fitting.model.symmetric import basis, join, split

Array = NDArray[np.float64]
Objective = Callable[[Array], float]
Expansion = Callable[[Array], tuple[float, Array, Array]]
# Newton steps in all, and growth of the barrier once a point is central.
_MOST_STEPS = 40
_GROWTH = 20.0
# Smallest eigenvalue, in scaled units, below which a constraint is reported as active.
_ACTIVE = 1e-4
# Share of a Newton step below which a line search has failed by rounding.
_SHORTEST = 1e-10
# Newton decrement at which a point is central enough to raise the barrier (Boyd and Vandenberghe 2004,
# 11.3).
_CENTRED = 1e-4
# Ratio of Cholesky pivots at which a matrix counts as singular: solving with it would be rounding.
_THINNEST = 1e-7


def smallest_eigenvalues(parameters: Array, n: int) -> tuple[float, float]:
    """Return the smallest eigenvalue of scaled K over its largest magnitude, and the same of D."""
    ratios = []
    for part in split(parameters, n):
        values = np.linalg.eigvalsh(part)
        ratios.append(float(values[0] / max(np.max(np.abs(values)), 1e-300)))
    return ratios[0], ratios[1]


def inside(parameters: Array, n: int) -> bool:
    """Return whether both K and D are positive definite."""
    return min(smallest_eigenvalues(parameters, n)) > 0.0


def pull_inside(parameters: Array, n: int, margin: float = 0.02) -> Array:
    """Return the nearest K and D whose eigenvalues are at least ``margin`` of the largest magnitude."""
    pulled = []
    for part in split(parameters, n):
        values, vectors = np.linalg.eigh(part)
        floor = margin * max(float(np.max(np.abs(values))), 1e-12)
        pulled.append((vectors * np.maximum(values, floor)) @ vectors.T)
    return join(pulled[0], pulled[1])


def wall(parameters: Array, n: int) -> float:
    """Return -log det K - log det D; inf outside."""
    value = 0.0
    for part in split(parameters, n):
        try:
            pivots = np.diag(np.linalg.cholesky(part))
        except np.linalg.LinAlgError:
            return float("inf")
        if pivots.min() <= _THINNEST * pivots.max():
            return float("inf")
        value -= 2.0 * float(np.sum(np.log(np.maximum(pivots, 1e-300))))
    return value


def wall_slopes(parameters: Array, n: int) -> tuple[Array, Array]:
    """Return gradient (p,) and Hessian (p, p) of the wall at an interior point."""
    half = len(parameters) // 2
    gradient, hessian = np.zeros(2 * half), np.zeros((2 * half, 2 * half))
    for place, part in enumerate(split(parameters, n)):
        products = np.linalg.solve(part, basis(n))
        block = slice(place * half, (place + 1) * half)
        gradient[block] = -np.einsum("kii->k", products)
        hessian[block, block] = np.einsum("kij,lji->kl", products, products)
    return gradient, hessian


def minimise(
    expansion: Expansion, value: Objective, start: Array, n: int, gap: float
) -> tuple[Array, float, int]:
    """Follow the barrier path from an interior start until the barrier's share is below ``gap``.

    Parameters
    ----------
    expansion : callable
        Value, gradient and (Gauss-Newton) Hessian of the objective.
    value : callable
        Value alone.
    start : ndarray, (p,)
        Both matrices positive definite.
    n : int
    gap : float
        Largest 2 n / t to end with, in units of the objective.

    Returns
    -------
    parameters : ndarray, (p,)
    gap : float
        The last 2 n / t.
    steps : int
    """
    now = np.array(start)
    order = 2.0 * n
    sharpness = order / max(0.1 * abs(value(now)), gap)
    steps = 0
    while True:
        now, count = _centre(expansion, value, now, n, sharpness)
        steps += count
        if order / sharpness <= gap * (1.0 + 1e-9):
            return now, order / sharpness, steps
        sharpness = min(sharpness * _GROWTH, order / gap)


def _centre(
    expansion: Expansion, value: Objective, start: Array, n: int, sharpness: float
) -> tuple[Array, int]:
    """Minimise sharpness * objective + wall by Newton steps; return the point and the number of steps."""
    now = start
    for count in range(1, _MOST_STEPS + 1):
        level, gradient, hessian = expansion(now)
        wall_gradient, wall_hessian = wall_slopes(now, n)
        slope = sharpness * gradient + wall_gradient
        move = -solve_symmetric(sharpness * hessian + wall_hessian, slope)
        decrement = float(-slope @ move)
        if not decrement > 0.0:
            return now, count
        height = sharpness * level + wall(now, n)
        length = 1.0
        while length > _SHORTEST:
            trial = now + length * move
            lifted = wall(trial, n)
            if np.isfinite(lifted):
                reached = sharpness * value(trial) + lifted
                if reached <= height - 1e-4 * length * decrement + 1e-12 * abs(height):
                    break
            length *= 0.5
        else:
            return now, count
        now = trial
        if decrement < _CENTRED:
            return now, count
    return now, _MOST_STEPS


def active_names(parameters: Array, n: int) -> tuple[str, ...]:
    """Name which of the constraints K >= 0 and D >= 0 are active."""
    stiffness, damping = smallest_eigenvalues(parameters, n)
    named = (("stiffness_psd", stiffness), ("damping_psd", damping))
    return tuple(name for name, smallest in named if smallest < _ACTIVE)


def shortest_distance(target: Array, metric: Array, start: Array, n: int) -> tuple[Array, tuple[str, ...]]:
    """Return the positive semidefinite K, D nearest to ``target`` in a metric (p, p), and active constraints.

    This is the constrained minimum of a least squares objective with that Hessian.
    """

    from fitting.estimators.semidefinite import nearest

    difference = start - target
    gap = 1e-7 * max(1.0, 0.5 * float(difference @ metric @ difference))
    reached, _, _ = nearest(metric, metric @ target, start, n, gap)
    return reached, active_names(reached, n)

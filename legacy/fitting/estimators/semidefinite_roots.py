"""Minimisation within K >= 0 and D >= 0 by their symmetric roots, which know no limit.

At K = S S a stationary S is one of K where the gradient by K is positive semidefinite on what S misses
(Burer and Monteiro 2003, doi:10.1007/s10107-002-0352-8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from legacy.fitting.model.parameter_vector import basis, join, split, vector
from legacy.stapeskit.arrays import Array

Objective = Callable[[Array], float]
Expansion = Callable[[Array], tuple[float, Array, Array]]
# First weight of the pull towards unit matrices over the objective, its last, and how it falls.
_FIRST, _LAST, _GROWTH = 0.1, 1e-2, 20.0
# Steps under each weight, and at the end; expected fall of the objective that ends it there.
_FEW, _MOST, _TOLERANCE = 30, 200, 1e-8
# Least eigenvalue of a start over the largest: at a root of zero nothing pulls an eigenvalue up. Chosen by
# judgement: below what ligaments have, above rounding.
_INSIDE = 1e-3
# Smallest eigenvalue, in scaled units, below which a constraint is reported as active.
_ACTIVE = 1e-4


def smallest_eigenvalues(parameters: Array, n: int) -> tuple[float, float]:
    """Return the smallest eigenvalue of scaled K over its largest magnitude, and the same of D."""
    ratios = []
    for part in split(parameters, n):
        values = np.linalg.eigvalsh(part)
        ratios.append(float(values[0] / max(np.max(np.abs(values)), 1e-300)))
    return ratios[0], ratios[1]


def is_positive_definite(parameters: Array, n: int) -> bool:
    """Return whether both K and D are positive definite."""
    return min(smallest_eigenvalues(parameters, n)) > 0.0


def nearest_inside(parameters: Array, n: int, margin: float = 0.02) -> Array:
    """Return the nearest K and D whose eigenvalues are at least ``margin`` of the largest magnitude."""
    pulled = []
    for part in split(parameters, n):
        values, vectors = np.linalg.eigh(part)
        floor = margin * max(float(np.max(np.abs(values))), 1e-12)
        pulled.append((vectors * np.maximum(values, floor)) @ vectors.T)
    return join(pulled[0], pulled[1])


def minimise(expansion: Expansion, value: Objective, others: Array, n: int) -> tuple[Array, bool, int]:
    """Minimise an objective over positive semidefinite K and D and unknowns without a limit.

    Parameters
    ----------
    expansion : callable
        Value, gradient and (Gauss-Newton) Hessian of the objective.
    value : callable
        Value alone.
    others : ndarray, (k,)
        Where the unknowns after K and D start.

    Returns
    -------
    parameters : ndarray, (n (n + 1) + k,)
    converged : bool
    steps : int

    Notes
    -----
    K and D start from unit matrices, the usual size. A quadratic term that pulls them there first outweighs
    the objective and is then lowered to nothing: the valley that is followed does not depend on a start, and
    where data are weak the path does not run to infinity, where a likelihood levels off.
    """
    usual = join(np.eye(n), np.eye(n))
    now = np.concatenate([usual, others])
    weight, steps = _FIRST * abs(value(now)) / len(usual), 0
    if not np.isfinite(weight):
        return now, False, 0
    while weight > _LAST:
        pulled = _Pulled(expansion, value, usual, weight)
        now, _, count = _descend(pulled.expansion, pulled.value, now, n, _LAST, _FEW)
        now[: len(usual)] = nearest_inside(now[: len(usual)], n, _INSIDE)
        weight, steps = weight / _GROWTH, steps + count
    now, converged, count = _descend(expansion, value, now, n, _TOLERANCE, _MOST)
    return now, converged, steps + count


def minimise_near(expansion: Expansion, value: Objective, start: Array, n: int) -> tuple[Array, bool, int]:
    """Minimise as `minimise` does, from a start (n (n + 1) + k,) alone; its K and D are pulled inside."""
    entries = n * (n + 1)
    begin = np.concatenate([nearest_inside(start[:entries], n, _INSIDE), start[entries:]])
    if not np.isfinite(value(begin)):
        return begin, False, 0
    return _descend(expansion, value, begin, n, _TOLERANCE, _MOST)


@dataclass(frozen=True)
class _Pulled:
    """An objective plus weight * |X - usual|^2 over the entries of K and D."""

    objective: Expansion
    level: Objective
    usual: Array
    weight: float

    def value(self, parameters: Array) -> float:
        off = parameters[: len(self.usual)] - self.usual
        return self.level(parameters) + self.weight * float(off @ off)

    def expansion(self, parameters: Array) -> tuple[float, Array, Array]:
        value, gradient, hessian = self.objective(parameters)
        count = len(self.usual)
        off = parameters[:count] - self.usual
        gradient, hessian = gradient.copy(), hessian.copy()
        gradient[:count] += 2.0 * self.weight * off
        hessian[np.arange(count), np.arange(count)] += 2.0 * self.weight
        return value + self.weight * float(off @ off), gradient, hessian


def _descend(
    expansion: Expansion, value: Objective, start: Array, n: int, tolerance: float, most: int
) -> tuple[Array, bool, int]:
    """Take Newton steps, damped after Levenberg, in symmetric roots S of K = S S and D: they know no limit.

    Ends where a step is expected to lower the objective by less than ``tolerance``.
    """
    now, damping = start, 0.0
    level, gradient, hessian = expansion(now)
    for count in range(1, most + 1):
        roots, slope, curvature = _in_roots(now, gradient, hessian, n)
        move = -descent(curvature, slope, damping)
        expected = float(-slope @ move)
        trial = now.copy()
        trial[: n * (n + 1)] = join(*(root @ root for root in roots + np.stack(split(move, n))))
        trial[n * (n + 1) :] += move[n * (n + 1) :]
        reached = value(trial)
        if reached <= level - 1e-4 * min(expected, level) or (expected < tolerance and reached <= level):
            now, damping = trial, damping / 10.0 if damping > 1e-4 else 0.0
            level, gradient, hessian = expansion(now)
        else:
            damping = max(10.0 * damping, 1e-2)
        if expected < tolerance:
            return now, damping < 1.0, count
    return now, False, most


def _in_roots(parameters: Array, gradient: Array, hessian: Array, n: int) -> tuple[Array, Array, Array]:
    """Return the roots of K and D (2, n, n), and gradient and Hessian by their entries and the others.

    d(S S) = S dS + dS S; the second derivative, dS dS, times the gradient is what holds a root at zero where
    the objective would rather have K negative.
    """
    half, units = n * (n + 1) // 2, basis(n)
    slopes, curved = np.eye(len(parameters)), np.zeros_like(hessian)
    roots = []
    for place, part in enumerate(split(parameters, n)):
        values, vectors = np.linalg.eigh(part)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        block = slice(place * half, (place + 1) * half)
        slopes[block, block] = vector(root @ units + units @ root).T
        curved[block, block] = _second_derivative(n) @ gradient[block]
        roots.append(root)
    return np.stack(roots), slopes.T @ gradient, slopes.T @ hessian @ slopes + curved


@lru_cache(maxsize=16)
def _second_derivative(n: int) -> Array:
    """Return the second derivative of the independent entries of S S by those of S, (p, p, p)."""
    units = basis(n)
    return vector(units[:, None] @ units[None] + units[None] @ units[:, None])


def descent(matrix: Array, slope: Array, damping: float = 0.0) -> Array:
    """Return |H|^-1 g with H scaled to unit diagonal: Newton's step with |curvature|."""
    size = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    curvature = np.maximum(np.abs(values), 1e-13 * float(np.max(np.abs(values)))) + damping
    return np.asarray(vectors @ (vectors.T @ (slope / size) / curvature) / size)


def active_names(parameters: Array, n: int) -> tuple[str, ...]:
    """Name which of the constraints K >= 0 and D >= 0 are active."""
    stiffness, damping = smallest_eigenvalues(parameters, n)
    named = (("stiffness_psd", stiffness), ("damping_psd", damping))
    return tuple(name for name, smallest in named if smallest < _ACTIVE)


def shortest_distance(target: Array, metric: Array, start: Array, n: int) -> tuple[Array, tuple[str, ...]]:
    """Return the positive semidefinite K, D nearest to ``target`` in a metric (p, p), and active constraints.

    This is the constrained minimum of a least squares objective with that Hessian.
    """

    from legacy.fitting.estimators.semidefinite import nearest

    difference = start - target
    gap = 1e-7 * max(1.0, 0.5 * float(difference @ metric @ difference))
    reached, _, _ = nearest(metric, metric @ target, start, n, gap)
    return reached, active_names(reached, n)

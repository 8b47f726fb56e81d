"""Least squares within the stable models by a barrier that is smooth up to the limit of stability.

With the state matrix S of the model and a margin m, the equation ``(S + m I) P + P (S + m I)^T = -I`` has a
positive definite solution P if and only if every eigenvalue of S lies left of -m (Lyapunov's theorem,
e.g. Boyd et al. 1994, Linear Matrix Inequalities in System and Control Theory, section 2.6.3). S is linear in
K and D, so log det P is a smooth barrier of the stable set, which the largest real part itself is not: there
eigenvalues meet and split. Steps that would leave the set are shortened, so that every iterate is stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fitting.errors import FittingError
from fitting.estimators.semidefinite_roots import descent
from fitting.model.model import state_matrix
from fitting.model.parameter_vector import basis, split
from stapeskit.arrays import Array

# How far left of the imaginary axis every eigenvalue must lie, in units of the reference frequency.
MARGIN = 5e-7
# Weights of the barrier, in units of the objective: one that outweighs it, and the last.
_FIRST, _LAST = 1.0, 1e-9
_GROWTH = 4.0
_MOST_STEPS = 40
# A change of the objective over the last decades of the weight that counts as settled.
_SETTLED = 1e-3
_SHORTEST = 1e-12
_CENTRED = 1e-6


class Objective(Protocol):
    """A quadratic objective within bounds, and the scaled mass (fitting.estimators.constrained.Quadratic)."""

    @property
    def mass(self) -> Array:
        """Return the scaled mass, (n, n)."""

    @property
    def lower(self) -> Array:
        """Return the lower bounds, (p,)."""

    @property
    def upper(self) -> Array:
        """Return the upper bounds, (p,)."""

    def expansion(self, parameters: Array) -> tuple[float, Array, Array]:
        """Return value, gradient and Hessian."""

    def value(self, parameters: Array) -> float:
        """Return the value."""


@dataclass(frozen=True)
class Wall:
    """log det P - sum log of the distances to finite bounds, at a stable point.

    Attributes
    ----------
    gradient : ndarray, (p,)
    hessian : ndarray, (p, p)
        Not always positive definite: the stable set is not convex.
    """

    value: float
    gradient: Array
    hessian: Array


def state_derivatives(mass: Array) -> Array:
    """Return the derivative of the state matrix by every parameter, (p, 2n, 2n)."""
    n = len(mass)
    shapes = np.linalg.solve(mass, basis(n))
    derivatives = np.zeros((2 * len(shapes), 2 * n, 2 * n))
    derivatives[: len(shapes), n:, :n] = -shapes
    derivatives[len(shapes) :, n:, n:] = -shapes
    return derivatives


def wall_height(parameters: Array, problem: Objective) -> float:
    """Return the value of the wall; inf where a model is not stable by the margin or a bound is reached."""
    n = len(problem.mass)
    state = state_matrix(problem.mass, *split(parameters, n)) + MARGIN * np.eye(2 * n)
    if not np.linalg.eigvals(state).real.max() < 0.0:
        return float("inf")
    slack = _slacks(parameters, problem)
    if np.any(slack <= 0.0):
        return float("inf")
    sign, value = np.linalg.slogdet(_lyapunov(state, -np.eye(2 * n)[None])[0])
    return float(value - np.sum(np.log(slack))) if sign > 0.0 else float("inf")


def wall(parameters: Array, problem: Objective, derivatives: Array) -> Wall:
    """Return the wall with its slopes at a point where it is finite.

    Notes
    -----
    With S P + P S^T = -I, S^T Q + Q S = -P^-1 and S_k = dS / dp_k: d log det P / dp_k = 2 tr(P Q S_k); the
    second derivatives follow from the same two equations with changed right sides.
    """
    n = len(problem.mass)
    state = state_matrix(problem.mass, *split(parameters, n)) + MARGIN * np.eye(2 * n)
    p = _lyapunov(state, -np.eye(2 * n)[None])[0]
    inverse = np.linalg.inv(p)
    q = _lyapunov(state.T, -inverse[None])[0]
    p_slopes = _lyapunov(state, -_twice(derivatives @ p))
    q_slopes = _lyapunov(state.T, inverse @ p_slopes @ inverse - _twice(q @ derivatives))
    gradient = 2.0 * np.einsum("ij,kji->k", p @ q, derivatives)
    products = p_slopes @ q + p @ q_slopes
    hessian = 2.0 * np.einsum("lij,kji->kl", products, derivatives)
    for bound, sense in ((problem.lower, 1.0), (problem.upper, -1.0)):
        finite = np.flatnonzero(np.isfinite(bound))
        slack = sense * (parameters - bound)[finite]
        gradient[finite] -= sense / slack
        hessian[finite, finite] += 1.0 / slack**2
    value = np.linalg.slogdet(p)[1] - np.sum(np.log(_slacks(parameters, problem)))
    return Wall(float(value), gradient, 0.5 * (hessian + hessian.T))


def _twice(matrices: Array) -> Array:
    return matrices + np.swapaxes(matrices, -1, -2)


def _slacks(parameters: Array, problem: Objective) -> Array:
    low, high = parameters - problem.lower, problem.upper - parameters
    return np.concatenate([low[np.isfinite(problem.lower)], high[np.isfinite(problem.upper)]])


def _lyapunov(state: Array, right: Array) -> Array:
    """Solve S X + X S^T = R for several symmetric R, (k, m, m)."""
    eye = np.eye(len(state))
    # the Kronecker sum of S with itself; np.kron took 40 % of a fit whose stability is active
    sums = state[:, None, :, None] * eye[:, None] + eye[:, None, :, None] * state[:, None]
    operator = sums.reshape(state.size, state.size)
    solution = np.linalg.solve(operator, right.reshape(len(right), -1).T).T.reshape(right.shape)
    return np.asarray(0.5 * (solution + np.swapaxes(solution, -1, -2)))


def stable_start(problem: Objective, begin: Array) -> Array:
    """Return ``begin``, which must have K, D > 0, if it is stable by the margin.

    Raises
    ------
    FittingError
        It is not: the bounds leave next to no damping or stiffness.
    """
    if np.isfinite(wall_height(begin, problem)):
        return begin
    raise FittingError.of(
        "the bounds",
        "wide enough for a stable model",
        "bounds that leave none",
        next_step="Widen {lower} or {upper}",
    )


def best_stable(problem: Objective, begin: Array, others: Sequence[Array]) -> tuple[Array, int, bool]:
    """Minimise the objective within the stable models, whose set is not convex, from several starts.

    Parameters
    ----------
    begin : ndarray, (p,)
        A stable model. The path from it begins where the barrier outweighs the objective, so that the first
        centre, and with it the valley that is followed, does not depend on it.
    others : sequence of ndarray, (p,)
        Stable models from which paths begin closer by, in valleys of their own.

    Returns
    -------
    parameters : ndarray, (p,)
        Stable by MARGIN.
    steps : int
    converged : bool
        Whether the objective had settled.
    """
    candidates = [follow_barrier(problem, begin, _FIRST)]
    for other in others:
        candidates += [follow_barrier(problem, other, weight) for weight in (1e-2, 1e-3)]
    parameters, _, converged = min(candidates, key=lambda path: problem.value(path[0]))
    return parameters, sum(steps for _, steps, _ in candidates), converged


def follow_barrier(problem: Objective, start: Array, weight: float) -> tuple[Array, int, bool]:
    """Follow the centres of a falling weight of the barrier from a stable start.

    Returns
    -------
    parameters : ndarray, (p,)
    steps : int
    converged : bool
        Whether the last steps of the weight changed the objective by less than 0.1 %.
    """
    derivatives = state_derivatives(problem.mass)
    now, steps, values = np.array(start), 0, [problem.value(start)]
    while True:
        now, count = _centre(problem, now, weight, derivatives)
        steps += count
        values.append(problem.value(now))
        if weight <= _LAST * (1.0 + 1e-9):
            break
        weight = max(weight / _GROWTH, _LAST)
    return now, steps, max(values[-4:]) - values[-1] <= _SETTLED * max(values[-1], _LAST)


def _centre(problem: Objective, start: Array, weight: float, derivatives: Array) -> tuple[Array, int]:
    """Minimise objective / weight + wall by Newton steps along which the curvature is made positive."""
    now = start
    for count in range(1, _MOST_STEPS + 1):
        level, gradient, hessian = problem.expansion(now)
        barrier = wall(now, problem, derivatives)
        slope = gradient / weight + barrier.gradient
        move = -descent(hessian / weight + barrier.hessian, slope)
        decrement = float(-slope @ move)
        if decrement < _CENTRED:
            return now, count
        before = level / weight + barrier.value
        length = 1.0
        while length > _SHORTEST:
            trial = now + length * move
            reached = problem.value(trial) / weight + wall_height(trial, problem)
            if reached <= before - 1e-4 * length * decrement:
                break
            length *= 0.5
        else:
            return now, count
        now = trial
    return now, _MOST_STEPS

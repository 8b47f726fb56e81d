"""Least squares within the stable models by a barrier that is smooth up to the limit of stability.

With the state matrix S of the model and a margin m, the equation ``(S + m I) P + P (S + m I)^T = -I`` has a
positive definite solution P if and only if every eigenvalue of S lies left of -m (Lyapunov's theorem,
e.g. Boyd et al. 1994, Linear Matrix Inequalities in System and Control Theory, section 2.6.3). S is linear in
K and D, so log det P is a smooth barrier of the stable set, which the largest real part itself is not: there
eigenvalues meet and split. Steps that would leave the set are shortened, so that every iterate is stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators.semidefinite_roots import descent
from legacy.fitting.model.parameter_vector import basis
from legacy.stapeskit.arrays import Array

# How far left of the imaginary axis every eigenvalue must lie, in units of the reference frequency.
MARGIN = 5e-7
# Weights of the barrier, in units of the objective: one that outweighs it, and the last.
_FIRST, _LAST = 1.0, 1e-9
_GROWTH = 4.0
_MOST_STEPS = 40
# A change of the objective over the last decades of the weight that counts as settled.
_SETTLED = 1e-3
_SHORTEST = 1e-12
# Newton decrement at the last centre, and at those on the way to it.
_CENTRED, _NEAR_CENTRE = 1e-6, 1e-2


class Objective(Protocol):
    """A quadratic objective within bounds (fitting.estimators.constrained.Quadratic)."""

    @property
    def lower(self) -> Array:
        """Return the lower bounds, (p,)."""

    @property
    def upper(self) -> Array:
        """Return the upper bounds, (p,)."""

    @property
    def state_slopes(self) -> Array:
        """Return the derivative of the state matrix by every parameter, (p, 2n, 2n)."""

    def expansion(self, parameters: Array) -> tuple[float, Array, Array]:
        """Return value, gradient and Hessian."""

    def value(self, parameters: Array) -> float:
        """Return the value."""


def state_derivatives(mass: Array) -> Array:
    """Return the derivative of the state matrix by every parameter, (p, 2n, 2n)."""
    n = len(mass)
    shapes = np.linalg.solve(mass, basis(n))
    derivatives = np.zeros((2 * len(shapes), 2 * n, 2 * n))
    derivatives[: len(shapes), n:, :n] = -shapes
    derivatives[len(shapes) :, n:, n:] = -shapes
    return derivatives


def wall_height(parameters: Array, problem: Objective) -> float:
    """Return log det P - sum log of the distances to finite bounds.

    It is inf where a model is not stable by the margin, so that P is not positive definite, or a bound is
    reached.
    """
    low, high = parameters - problem.lower, problem.upper - parameters
    slack = np.concatenate([low[np.isfinite(low)], high[np.isfinite(high)]])
    if np.any(slack <= 0.0):
        return float("inf")
    try:
        p = _solve(_lyapunov(parameters, problem), -np.eye(problem.state_slopes.shape[1]))
        root = np.linalg.cholesky(p)
    except np.linalg.LinAlgError:
        return float("inf")
    return float(2.0 * np.sum(np.log(root.diagonal())) - np.sum(np.log(slack)))


def wall_slopes(parameters: Array, problem: Objective) -> tuple[Array, Array]:
    """Return gradient (p,) and Hessian (p, p) of the wall at a point where it is finite.

    The Hessian is not always positive definite: the stable set is not convex.

    Notes
    -----
    With S P + P S^T = -I, S^T Q + Q S = -P^-1 and S_k = dS / dp_k: d log det P / dp_k = 2 tr(P Q S_k); the
    second derivatives follow from the same two equations with changed right sides.
    """
    derivatives = problem.state_slopes
    operator = _lyapunov(parameters, problem)  # transposed: of the equation of the transposed S
    p = _solve(operator, -np.eye(derivatives.shape[1]))
    inverse = np.asarray(np.linalg.inv(p))
    q = _solve(operator.T, -inverse)
    p_slopes = _solve(operator, -_add_transpose(derivatives @ p))
    q_slopes = _solve(operator.T, inverse @ p_slopes @ inverse - _add_transpose(q @ derivatives))
    gradient = 2.0 * np.einsum("ij,kji->k", p @ q, derivatives)
    products = p_slopes @ q + p @ q_slopes
    hessian = 2.0 * np.einsum("lij,kji->kl", products, derivatives)
    for bound, sense in ((problem.lower, 1.0), (problem.upper, -1.0)):
        finite = np.flatnonzero(np.isfinite(bound))
        slack = sense * (parameters - bound)[finite]
        gradient[finite] -= sense / slack
        hessian[finite, finite] += 1.0 / slack**2
    return gradient, 0.5 * (hessian + hessian.T)


def _add_transpose(matrices: Array) -> Array:
    return matrices + np.swapaxes(matrices, -1, -2)


def _lyapunov(parameters: Array, problem: Objective) -> Array:
    """Return the matrix of X -> (S + m I) X + X (S + m I)^T, (4n^2, 4n^2)."""
    slopes = problem.state_slopes
    eye = np.eye(slopes.shape[1])
    state = np.eye(len(eye), k=len(eye) // 2) + MARGIN * eye + np.tensordot(parameters, slopes, 1)
    # the Kronecker sum of S with itself; np.kron took 40 % of a fit whose stability is active
    sums = state[:, None, :, None] * eye[:, None] + eye[:, None, :, None] * state[:, None]
    return sums.reshape(state.size, state.size)


def _solve(operator: Array, right: Array) -> Array:
    """Return the symmetric solutions of symmetric right sides (..., 2n, 2n)."""
    solution = np.linalg.solve(operator, right.reshape(-1, len(operator)).T).T
    return 0.5 * _add_transpose(np.asarray(solution.reshape(right.shape)))


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
    now, steps, values = np.array(start), 0, [problem.value(start)]
    while True:
        now, count = _centre(problem, now, weight)
        steps += count
        values.append(problem.value(now))
        if weight <= _LAST * (1.0 + 1e-9):
            break
        weight = max(weight / _GROWTH, _LAST)
    return now, steps, max(values[-4:]) - values[-1] <= _SETTLED * max(values[-1], _LAST)


def _centre(problem: Objective, start: Array, weight: float) -> tuple[Array, int]:
    """Minimise objective / weight + wall by Newton steps along which the curvature is made positive."""
    now, height = start, wall_height(start, problem)
    for count in range(1, _MOST_STEPS + 1):
        level, gradient, hessian = problem.expansion(now)
        wall_gradient, wall_hessian = wall_slopes(now, problem)
        slope = gradient / weight + wall_gradient
        move = -descent(hessian / weight + wall_hessian, slope)
        decrement = float(-slope @ move)
        if decrement < (_CENTRED if weight <= _LAST else _NEAR_CENTRE):
            return now, count
        before = level / weight + height
        length = 1.0
        while length > _SHORTEST:
            trial = now + length * move
            height = wall_height(trial, problem)
            if problem.value(trial) / weight + height <= before - 1e-4 * length * decrement:
                break
            length *= 0.5
        else:
            return now, count
        now = trial
    return now, _MOST_STEPS

"""Iteratively reweighted equation error: Eq. 5 weighted by the noise of its own equations, Ce(p)^-1."""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators import pinv
from legacy.fitting.estimators.base import (
    Estimate,
    EstimatorOptions,
    Method,
    gram,
    least_squares,
    noise_precision,
    solve_symmetric,
    times,
    transposed_times,
)
from legacy.fitting.estimators.likelihood_kernel import EQUAL, MEASURED, expanded
from legacy.fitting.estimators.semidefinite_roots import (
    is_positive_definite,
    nearest_inside,
    shortest_distance,
)
from legacy.fitting.model.scaled_lines import (
    Lines,
    backward,
    cholesky,
    evaluate,
    forward,
    real_rows,
    regressor,
)
from legacy.stapeskit.arrays import Array

# A fit that needs more is reported as not converged.
_MOST_ITERATIONS = 60


def estimate(lines: Lines, options: EstimatorOptions, start: Array | None = None) -> Estimate:
    """Repeat p = argmin |Ce^-1/2 (A p - b)|^2 with Ce of the last p until it stays."""
    balanced = np.ones(lines.n)
    now = pinv.weighted(lines, balanced).parameters if start is None else start
    fixed = regressor(lines.dq, lines.factor)
    converged, count = False, 0
    while count < _MOST_ITERATIONS and not converged:
        count += 1
        factor = cholesky(evaluate(now, lines).noise)
        rows = real_rows(forward(factor, fixed))
        right = real_rows(forward(factor, lines.force))
        following = least_squares(rows, right)
        change = times(rows, following - now)
        now = following
        converged = bool(change @ change < options.tolerance)
    value = float(np.sum((times(rows, now) - right) ** 2))
    if not options.passive or is_positive_definite(now, lines.n):
        return Estimate(now, value, count, converged)
    hessian = gram(rows)
    passive_estimate, active = shortest_distance(now, hessian, nearest_inside(now, lines.n), lines.n)
    return Estimate(passive_estimate, value, count, converged, active)


def quick_start(lines: Lines) -> Array:
    """Return the first reweighted estimate, by normal equations: a start for ml."""
    plain = expanded(np.zeros(lines.parameters), lines, EQUAL)
    if plain is not None:
        begin = -solve_symmetric(plain.hessian, plain.gradient)
        weighted = expanded(begin, lines, MEASURED)
        if weighted is not None:
            return np.asarray(begin - solve_symmetric(weighted.hessian, weighted.gradient))
    fixed = regressor(lines.dq, lines.factor)
    rows = real_rows(fixed)
    begin = solve_symmetric(gram(rows), transposed_times(rows, real_rows(lines.force)))
    factor = cholesky(evaluate(begin, lines).noise)
    rows = real_rows(forward(factor, fixed))
    return solve_symmetric(gram(rows), transposed_times(rows, real_rows(forward(factor, lines.force))))


def scores(parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:  # noqa: ARG001
    """Return Re(A^H Ce^-1 e) of every line, (lines, p)."""
    state = evaluate(parameters, lines)
    factor = cholesky(state.noise)
    multiplier = backward(factor, forward(factor, state.residual))
    return np.einsum("ilp,il->lp", regressor(lines.dq, lines.factor).conj(), multiplier).real


METHOD = Method(
    "least squares of the equation error, reweighted by its own noise", estimate, scores, noise_precision
)

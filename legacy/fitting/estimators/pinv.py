"""Pseudo-inverse of the stacked equations in SI units: the paper's Eqs. 4 and 5.

The noisy difference dq is its regressor, so its estimate is attenuated however many lines there are.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators.base import (
    Estimate,
    EstimatorOptions,
    Method,
    fixed_precision,
    least_squares,
    times,
)
from legacy.fitting.model.scaled_lines import Lines, evaluate, real_rows, regressor
from legacy.stapeskit.arrays import Array


def estimate(
    lines: Lines,
    options: EstimatorOptions,  # noqa: ARG001
    start: Array | None = None,  # noqa: ARG001
) -> Estimate:
    """Return p = pinv(A) b with the rows of A p = b in SI units."""
    return weighted(lines, lines.row_weights)


def weighted(lines: Lines, row_weights: Array) -> Estimate:
    """Return the least squares solution for given weights (n,) of the scaled rows."""
    rows = real_rows(regressor(lines.dq, lines.factor) * row_weights[:, None, None])
    right = real_rows(lines.force * row_weights[:, None])
    parameters = least_squares(rows, right)
    return Estimate(parameters, float(np.sum((times(rows, parameters) - right) ** 2)), 1)


def scores(parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:  # noqa: ARG001
    """Return Re(A^H W e) of every line, (lines, p)."""
    return weighted_scores(parameters, lines, lines.row_weights)


def weighted_scores(parameters: Array, lines: Lines, row_weights: Array) -> Array:
    """Return Re(A^H W e) of every line for given weights (n,) of the scaled rows."""
    residual = evaluate(parameters, lines).residual * row_weights[:, None] ** 2
    return np.einsum("ilp,il->lp", regressor(lines.dq, lines.factor).conj(), residual).real


METHOD = Method(
    "the pseudo-inverse of the stacked equations of motion (Eq. 5 of the CURAC 2019 study, p. 98 ff.)",
    estimate,
    scores,
    lambda lines, _: fixed_precision(lines.row_weights, lines),
)

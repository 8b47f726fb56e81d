"""Whether residuals exceed noise and shared errors together.

Shared errors (registration, positions, mass) move the residuals of all lines. chi2 of channel noise alone
takes them for a misfit; here they are unknowns with their own covariance, to first order about the estimate.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import solve_symmetric
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.scaled_lines import Lines, forward, real_rows
from legacy.fitting.uncertainty.frequency_dependence import common_errors
from legacy.stapeskit.arrays import Array


def chi2_with_shared_errors(problem: Problem, lines: Lines, parameters: Array) -> float:
    """Return the least of 2 |r + J dp + S z|^2 + |z|^2 over dp and z.

    Parameters
    ----------
    parameters : ndarray, (p,)
        Scaled; K and D move only where they maximise the likelihood.

    Notes
    -----
    r are the residuals over their noise, S z their change by shared errors z of unit variance. It has as many
    degrees of freedom as chi2 of channel noise, 2 n lines - p.
    """
    now = ml.whiten(parameters, lines)
    residual = real_rows(now.residual)
    columns = [real_rows(now.corrected(lines))] if problem.method.likelihood else []
    free = len(parameters) if columns else 0
    for change, covariance in common_errors(problem, lines, parameters):
        columns.append(real_rows(forward(now.factor, change @ _root(covariance))))
    if len(columns) == (1 if free else 0):
        return 2.0 * float(residual @ residual)
    rows = np.concatenate(columns, axis=1)
    prior = np.concatenate([np.zeros(free), np.ones(rows.shape[1] - free)])
    step = -solve_symmetric(2.0 * rows.T @ rows + np.diag(prior), 2.0 * rows.T @ residual)
    remaining = residual + rows @ step
    return float(2.0 * (remaining @ remaining) + step @ (prior * step))


def _root(covariance: Array) -> Array:
    """Return F with F F^T the covariance, of parameters in different units."""
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    return np.asarray(size[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0))))

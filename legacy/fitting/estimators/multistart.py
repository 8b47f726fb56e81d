"""More starts where the data are weak: one descent may end in a side valley."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.fitting.estimators import constrained, irls, ml
from legacy.fitting.estimators.base import Estimate, EstimatorOptions, least_squares
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.scaled_lines import Lines, cholesky, evaluate, forward, real_rows, regressor
from legacy.stapeskit.arrays import Array

# Softest directions of the data along which starts are placed.
_DIRECTIONS = 3
_FLUID_ROUNDS = 3  # of weighted least squares, each with the noise at the last estimate


def improve(problem: Problem, lines: Lines, current: Estimate) -> Estimate:
    """Return the best ml estimate from the given one and from further starts.

    The starts are the convex solution with K, D >= 0, the reweighted equation error, and points two standard
    deviations away along the worst combinations.
    """
    options = problem.options
    starts = [
        constrained.estimate(lines, EstimatorOptions(constraint="psd")).parameters,
        irls.estimate(lines, EstimatorOptions(passive=False)).parameters,
    ]
    hessian, _ = ml.normal_equations(current.parameters, lines)
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(size, size))
    for place in range(min(_DIRECTIONS, len(values))):
        step = vectors[:, place] / size * np.sqrt(0.5 / max(values[place], 1e-12))
        starts += [current.parameters + 2.0 * step, current.parameters - 2.0 * step]
    free = replace(options, passive=False)
    tried = [ml.estimate(lines, free, start) for start in starts]
    best = min(tried, key=lambda fit: fit.objective)
    if best.objective >= current.objective * (1.0 - 1e-9):
        return current
    within_options = ml.estimate(lines, options, best.parameters)
    return within_options if within_options.objective < current.objective else current


def with_fluid(parameters: Array, lines: Lines) -> tuple[Array, float, float]:
    """Return a start with a mass of fluid on the first deflection: scaled K and D, the mass, and chi2.

    Parameters
    ----------
    parameters : ndarray, (p,)
        Where the noise of the equations is first taken.

    Notes
    -----
    Least squares of the equation error, biased by the noise of the deflection: a start of the likelihood.
    """
    fluid = np.zeros((lines.n, lines.count), dtype=complex)
    fluid[0] = -(lines.omega**2) * lines.dq[0]
    columns = np.concatenate([regressor(lines.dq, lines.factor), fluid[:, :, None]], axis=2)
    solution, misfit = np.append(parameters, 0.0), np.inf
    for _ in range(_FLUID_ROUNDS):
        factor = cholesky(evaluate(solution[:-1], lines).noise)
        rows, right = real_rows(forward(factor, columns)), real_rows(forward(factor, lines.force))
        if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(right))):
            break
        solution = least_squares(rows, right)
        misfit = float(np.sum((rows @ solution - right) ** 2))
    return solution[:-1], float(solution[-1]), misfit

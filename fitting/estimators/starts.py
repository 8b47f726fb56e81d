"""More starts where the data are weak: one descent may end in a side valley."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting.estimators import constrained, irls, ml
from fitting.estimators.base import Estimate, EstimatorOptions
from fitting.estimators.problem import Problem
from fitting.model.lines import Lines

_DIRECTIONS = 3


def improve(problem: Problem, lines: Lines, found: Estimate) -> Estimate:
    """Return the best ml estimate from the given one and from further starts.

    The starts are the convex solution with K, D >= 0, the reweighted equation error, and points two standard
    deviations away along the worst combinations.
    """
    options = problem.options
    starts = [
        constrained.estimate(lines, EstimatorOptions(constraint="psd")).parameters,
        irls.estimate(lines, EstimatorOptions(passive=False)).parameters,
    ]
    hessian, _ = ml.normal_equations(found.parameters, lines)
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(size, size))
    for place in range(min(_DIRECTIONS, len(values))):
        step = vectors[:, place] / size * np.sqrt(0.5 / max(values[place], 1e-12))
        starts += [found.parameters + 2.0 * step, found.parameters - 2.0 * step]
    free = replace(options, passive=False)
    tried = [ml.estimate(lines, free, start) for start in starts]
    best = min(tried, key=lambda one: one.objective)
    if best.objective >= found.objective * (1.0 - 1e-9):
        return found
    held = ml.estimate(lines, options, best.parameters)
    return held if held.objective < found.objective else found

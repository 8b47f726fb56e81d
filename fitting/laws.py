"""Fit under one damping law, or under all of them, compared by chi2 and BIC."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.estimators import ml
from fitting.estimators.base import Estimate, gram, solve_symmetric, transposed_times
from fitting.estimators.problem import Problem
from fitting.model.damping import DampingLaw
from fitting.model.laws import LAWS, law_of
from fitting.model.lines import forward, real_rows
from fitting.model.symmetric import entry_names, split
from fitting.uncertainty.covariance import chi2, degrees

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LawFit:
    """A fit under one damping law.

    Attributes
    ----------
    law : DampingLaw
    problem : Problem
    estimate : Estimate
    chi2 : float
    bic : float
        chi2 over the best law's chi2 per degree of freedom (when above 1) + unknowns ln(equations).
    exponent_sd : float or None
        Standard deviation of a fractional exponent, channel noise only.
    """

    law: DampingLaw
    problem: Problem
    estimate: Estimate
    chi2: float
    bic: float
    exponent_sd: float | None = None


def fit_law(problem: Problem, name: str, lower: Mapping[str, float], upper: Mapping[str, float]) -> LawFit:
    """Estimate under one damping law; an exponent is estimated by a one-dimensional search."""
    search = law_of(name).search
    if search is None:
        return _at(problem, DampingLaw(name), lower, upper)
    from scipy.optimize import minimize_scalar

    def objective(exponent: float) -> float:
        return _at(problem, DampingLaw(name, float(exponent)), lower, upper).estimate.objective

    found = minimize_scalar(objective, bounds=search, method="bounded", options={"xatol": 1e-6})
    best = _at(problem, DampingLaw(name, float(found.x)), lower, upper)
    return replace(best, exponent_sd=_exponent_sd(best))


def compare_laws(
    problem: Problem, lower: Mapping[str, float], upper: Mapping[str, float]
) -> tuple[LawFit, ...]:
    """Estimate under every damping law, with BIC made comparable by the best chi2 per degree of freedom."""
    found = [fit_law(problem, name, lower, upper) for name in LAWS]
    lines = problem.lines()
    spread = max(1.0, min(one.chi2 for one in found) / max(degrees(lines), 1))
    return tuple(replace(one, bic=_bic(one, spread)) for one in found)


def _at(problem: Problem, law: DampingLaw, lower: Mapping[str, float], upper: Mapping[str, float]) -> LawFit:
    made = problem.with_law(law)
    options = replace(made.options, lower=_bounds(made, lower, -np.inf), upper=_bounds(made, upper, np.inf))
    made = replace(made, options=options)
    estimate = made.solve()
    level = chi2(estimate.parameters, made.lines())
    fit = LawFit(law, made, estimate, level, 0.0)
    return replace(fit, bic=_bic(fit, 1.0))


def _bic(fit: LawFit, spread: float) -> float:
    observation = fit.problem.observation
    unknowns = len(fit.estimate.parameters) + fit.law.unknowns
    equations = 2 * fit.problem.n * len(observation.freq_hz)
    return float(fit.chi2 / spread + unknowns * np.log(equations))


def _bounds(problem: Problem, bounds: Mapping[str, float], default: float) -> Array | None:
    """Return bounds (SI by name) as scaled parameters."""
    if not bounds:
        return None
    names = entry_names(problem.n)
    filled = np.full(len(names), default)
    for name, value in bounds.items():
        filled[names.index(name)] = value / problem.units[names.index(name)]
    return filled


def _exponent_sd(fit: LawFit) -> float:
    """Return the sd of a fractional exponent: the Schur complement of its Fisher information."""
    lines = fit.problem.lines()
    now = ml.whiten(fit.estimate.parameters, lines)
    rows = real_rows(now.corrected(lines))
    _, damping = split(fit.estimate.parameters, lines.n)
    slope = fit.law.slope(lines.omega)
    extra = real_rows(forward(now.factor, slope * (damping @ lines.dq)))
    coupling = transposed_times(rows, extra)
    explained = float(coupling @ solve_symmetric(gram(rows), coupling))
    information = 2.0 * (float(extra @ extra) - explained)
    return 1.0 / max(information, 1e-300) ** 0.5

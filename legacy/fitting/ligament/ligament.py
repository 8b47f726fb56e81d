"""Fit K and D together with the height and tilt of the ligament's plane over the footplate centre.

A ring at the height h over the footplate centre couples x with gamma and z with alpha: Z_rc = Y Z_cc with
Y[alpha, z] = h, Y[gamma, x] = -h (r: y, alpha, gamma; c: x, z, beta). Eliminating the in-plane rows leaves

    w^2 (M_r - Y M_c) q_s = Z' (q_s - q_b)_r,    Z' = Z_rr - Y Z_cc Y^T,

where Z' = K' + s D' belongs to the plane of the ligament. No in-plane deflection enters, so that this also
holds for a ligament that is rigid in its plane. The in-plane rows alone then give K_cc and D_cc, with which
K = K' + Y K_cc Y^T about the footplate centre follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.equations import Equations, Term
from legacy.fitting.ligament.inplane_stiffness import COLUMNS, ROWS, scaled_law, semidefinite
from legacy.fitting.ligament.joint_fit import JointFit, equation_error_start, fit_joint, same_valley
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.ligament.ligament_fit import LigamentFit, coupling_units, ligament_in_si
from legacy.fitting.ligament.misfit import descend, explained_limit, fit_any, fit_with_noise, is_explained
from legacy.fitting.ligament.prior import Prior, coupling_prior
from legacy.fitting.ligament.semidefinite_joint_fit import fit_held
from legacy.fitting.model.observation import Observation
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import DOF_NAMES

_N = len(PRINCIPAL_DOF)
Extension = Callable[[JointLines], tuple[Term, ...]]
# Least size from which an outer search begins, in the unit of a term, how far it goes (logarithm), and the
# squared step, in units of the uncertainty, that is left after it.
_SMALLEST, _WIDTH, _SETTLED = 0.1, 1.5, 1e-3
# Steps at or below which a fit is not worth an outer search: those of a fit that only looks (a cause beside
# another one that explains the data).
_FEW = 20
# Fits with other noise of one that adds a term, and of one that only looks or starts far away: with the
# noise of the fit without it, and with the noise that is left.
MOST_ROUNDS, FEW_ROUNDS = 4, 2
# Computation: what is known of a law is held this many times more closely at first than it is known.
_PINNED = 1e3
Extended = tuple[JointLines, Equations, JointFit]


class NotWithin(Exception):
    """A fit does not come below the chi2 from which on it is of use."""


class NotPassive(Exception):
    """A fit settles where K' or D' is not positive semidefinite."""

    def __init__(self, chi2: float) -> None:
        super().__init__(chi2)
        self.chi2 = chi2


def applies(problem: Problem, both: Observation) -> bool:
    """Return whether mass matrix, motion, estimator and degrees of freedom are those of this model."""
    return (
        problem.observation.dof == PRINCIPAL_DOF
        and both.dof == DOF_NAMES
        and problem.inertia.complete
        and problem.base_mass is None
        and problem.method.likelihood
        and not problem.options.student
    )


def fit_ligament(
    problem: Problem,
    lines: JointLines,
    start: Array,
    extend: Extension | None = None,
    begun: tuple[Array, Array] | None = None,
    held: bool = False,
    within: float | None = None,
) -> LigamentFit | None:
    """Fit K, D, the coupling by the plane of the ligament and the shared errors together.

    Parameters
    ----------
    problem : Problem
        With the damping law; of the three degrees of freedom.
    lines : JointLines
        All six degrees of freedom of both bodies.
    start : ndarray, (12,)
        Scaled K and D of the plain model.
    extend : callable, optional
        Returns further unknowns of the lines.
    begun : (ndarray, ndarray), optional
        The first start with them: scaled K and D, and their values.
    held : bool
        Whether K' and D' are kept positive semidefinite, without further unknowns.
    within : float, optional
        Chi2 below which the fit is of use: a misfit is not fitted with more noise. Where another model
        explains the data already, only what is found from the first start can look like it.

    Returns
    -------
    LigamentFit or None
        None when the iteration does not settle.

    Raises
    ------
    NotWithin
        Chi2 does not come below ``within``.
    NotPassive
        It settles where K' or D' is not positive semidefinite, and they are not held.
    """
    equations = _piston_equations(problem, lines)
    begins = np.concatenate([start, scaled_law(problem).unknowns])
    terms = extend(lines) if extend is not None else ()
    prior = equations.prior.mean[len(begins) :]
    if held:
        others = np.concatenate([begins[len(start) :], prior, np.zeros(lines.errors)])
        fit, active = fit_held(lines, equations, start, others)
        return ligament_in_si(problem, lines, equations, fit, active)
    known, equations = equations.prior, _pin(equations, begins)
    fitted = None
    if terms and begun is not None:
        first = np.concatenate([begun[0], begins[len(start) :], prior])
        fitted = _prepare(lines, equations, first, terms, begun[1], within)
    if fitted is None or not (is_explained(fitted[2]) or (within is not None and fitted[2].chi2 < within)):
        limit = np.inf if terms and within is not None else within  # with a term chi2 can fall
        beside = within is not None and within < explained_limit(equations, lines.count)
        couplings = (prior,) if beside else (prior, np.zeros(_N * _N))
        joint = _from_valleys(lines, equations, begins, couplings, limit)
        if not terms:
            fitted = (lines, equations, joint) if joint is not None and joint.converged else None
        elif joint is not None:
            fitted = _choose_better(fitted, _from_all_starts(lines, equations, joint, terms))
    if fitted is not None and problem.law.known:
        fitted = _release(*fitted, known)
    if within is not None and (fitted is None or fitted[2].chi2 > within):
        raise NotWithin
    if fitted is None:
        return None
    if not semidefinite(fitted[2].parameters[: equations.entries]):
        raise NotPassive(fitted[2].chi2)
    return ligament_in_si(problem, *fitted)


def _pin(equations: Equations, begins: Array) -> Equations:
    """Return the equations with what is known of the law held where the start has it.

    Two times that are free from the start lead from most starts into one valley; held first, each ratio leads
    into its own.
    """
    place = slice(equations.entries + equations.law.free, equations.coupling.start)
    mean, root = equations.prior.mean.copy(), equations.prior.root.copy()
    mean[place] = begins[place]
    root[place, place] *= _PINNED
    return replace(equations, prior=Prior(mean, root))


def _release(lines: JointLines, equations: Equations, fit: JointFit, known: Prior) -> Extended | None:
    """Return the fit that goes on with the law's unknowns as they are known."""
    place = slice(equations.entries + equations.law.free, equations.coupling.start)
    mean, root = equations.prior.mean.copy(), equations.prior.root.copy()
    mean[place], root[place, place] = known.mean[place], known.root[place, place]
    free = replace(equations, prior=Prior(mean, root))
    joint = _converge(
        lambda: fit_with_noise(lines, free, fit.parameters, partial(descend, free), fit, FEW_ROUNDS)
    )
    return None if joint is None else (lines, free, joint)


def _from_valleys(
    lines: JointLines,
    equations: Equations,
    begins: Array,
    couplings: tuple[Array, ...],
    within: float | None,
) -> JointFit | None:
    """Return the fit from the first coupling that settles; those that lead to one valley are tried once.

    Without shared errors, which costs little, starts show whether they lead to the same valley. A misfit is
    fitted with as much noise, unless only a chi2 below ``within`` is of use.
    """
    joint: JointFit | None = None
    limit = explained_limit(equations, lines.count) if within is None else within
    minima: list[JointFit] = []
    for coupling in couplings:
        bare = fit_joint(
            lines.without_errors(), equations, np.concatenate([begins, coupling]), 1e-2, known=minima
        )
        if any(same_valley(bare, other) for other in minima):
            continue
        minima.append(bare)
        begin = np.concatenate([bare.parameters, np.zeros(lines.errors)])
        joint = fit_joint(lines, equations, begin, within=limit)
        if joint.converged:
            break
    if joint is not None and (within is not None or (joint.converged and is_explained(joint))):
        return joint
    start = np.concatenate([begins, couplings[0]])
    return fit_with_noise(lines, equations, start, partial(descend, equations))


def _from_all_starts(
    lines: JointLines, equations: Equations, fit: JointFit, terms: tuple[Term, ...]
) -> Extended | None:
    """Return the best fit with further unknowns from nothing and from the other starts of each.

    A start far from nothing is prepared by a fit of the other unknowns at that value. A fit that explains the
    data ends the search.
    """
    best = extended_fit(lines, equations, fit, terms)
    for place, term in enumerate(terms):
        for value in term.starts:
            if best is not None and is_explained(best[2]) and not term.nuisances:
                return best
            begin = np.zeros(len(terms))
            begin[place] = value
            best = _choose_better(best, _prepare(lines, equations, fit.parameters, terms, begin))
    return best


def _choose_better(first: Extended | None, other: Extended | None) -> Extended | None:
    if first is None or other is None:
        return other if first is None else first
    return other if other[2].chi2 < first[2].chi2 - 1e-6 else first


def _prepare(
    lines: JointLines,
    equations: Equations,
    start: Array,
    terms: tuple[Term, ...],
    begin: Array,
    within: float | None = None,
) -> Extended | None:
    """Return a fit with further unknowns from values of theirs, at which the others are fitted first."""
    applied = (lines, equations)
    for term, value in zip(terms, begin, strict=True):
        applied = term.apply(float(value), *applied)
    try:
        near = equation_error_start(*applied, start)
        there = fit_any(*applied, near) if within is None else fit_joint(*applied, near)
    except np.linalg.LinAlgError:
        return None
    return extended_fit(lines, equations, there, terms, begin)


def extended_fit(
    lines: JointLines,
    equations: Equations,
    fit: JointFit,
    terms: tuple[Term, ...],
    begin: Array | None = None,
    most: int = 60,
    rounds: int = MOST_ROUNDS,
    within: float = np.inf,
) -> Extended | None:
    """Minimise with further unknowns, from values ``begin`` (0) of theirs; None if it needs more steps.

    Where the data are not explained by as much noise as stated, ``rounds`` is the most fits with other noise;
    0 keeps to the stated one. Only a chi2 below ``within`` is of use.
    """
    lines = lines.with_nuisances(tuple(name for term in terms for name in term.nuisances))
    start = np.insert(fit.parameters, equations.unknowns, np.zeros(len(terms)) if begin is None else begin)
    value = 0.0 if begin is None else float(begin[0])
    extended = equations.with_terms(terms)
    descent = partial(descend, extended, most=most, within=within)
    before = fit if rounds else replace(fit, noise=1.0)
    joint = _converge(lambda: fit_with_noise(lines, extended, start, descent, before, rounds))
    if joint is None and len(terms) == 1 and terms[0].nuisances and value and most > _FEW:
        joint = _converge(lambda: _profile(lines, equations, terms[0], fit, value))
    return None if joint is None else (lines, extended, joint)


def _converge(fit: Callable[[], JointFit]) -> JointFit | None:
    """Return a fit that converges; None for others and where there is no likelihood."""
    try:
        joint = fit()
    except np.linalg.LinAlgError:
        return None
    return joint if joint.converged else None


def _profile(lines: JointLines, equations: Equations, term: Term, fit: JointFit, middle: float) -> JointFit:
    """Minimise over the value of one term in an outer search, along a valley too curved for joint steps.

    With a mass at the head all of K and D grow, while its place, and with it the direction of the valley,
    depends on the mass. The noise is that of the fit without it.
    """
    from scipy.optimize import minimize_scalar

    place = equations.unknowns
    fits: dict[float, JointFit] = {}

    def profile(logarithm: float) -> float:
        applied = term.apply(float(np.exp(logarithm)), lines, equations)
        wide = replace(applied[0], covariance=fit.noise * applied[0].covariance)
        settled = [tried for tried, inner in fits.items() if inner.converged]
        if settled:
            begin = fits[min(settled, key=lambda tried: abs(tried - logarithm))].parameters
        else:
            begin = equation_error_start(*applied, fit.parameters)
        inner = fit_joint(wide, applied[1], begin)
        if settled and not inner.converged:
            again = fit_joint(wide, applied[1], equation_error_start(*applied, fit.parameters))
            inner = again if again.converged or again.chi2 < inner.chi2 else inner
        fits[logarithm] = inner
        return inner.chi2

    size = np.log(max(abs(middle), _SMALLEST))
    bounds = (size - _WIDTH, size + _WIDTH)
    minimize_scalar(profile, bounds=bounds, method="bounded", options={"xatol": 1e-2})
    best = min(fits, key=lambda tried: fits[tried].chi2)
    start = np.insert(fits[best].parameters, place, np.exp(best))
    return fit_joint(lines, equations.with_terms((term,)), start, tolerance=_SETTLED)


def _piston_equations(problem: Problem, lines: JointLines) -> Equations:
    """Return the equations of y, alpha and gamma with unknown coupling to x, z and beta."""
    rows, columns = np.eye(DOFS)[ROWS], np.eye(DOFS)[COLUMNS]
    law = scaled_law(problem)
    first = np.concatenate([np.full(_N * (_N + 1), np.inf), law.prior_sd])
    mean, covariance = coupling_prior()
    unit = coupling_units(lines).ravel()
    root = np.zeros((len(first) + _N * _N,) * 2)
    root[: len(first), : len(first)] = np.diag(1.0 / first)
    root[len(first) :, len(first) :] = np.linalg.cholesky(np.linalg.inv(covariance / np.outer(unit, unit))).T
    prior = Prior(np.concatenate([np.zeros(_N * (_N + 1)), law.unknowns, mean.ravel() / unit]), root)
    return Equations(rows, rows, columns, np.zeros((0, _N, DOFS)), law, prior)

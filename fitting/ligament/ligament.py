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

import numpy as np
from numpy.typing import NDArray

from fitting.estimators.problem import Problem
from fitting.ligament.equations import Equations, Term
from fitting.ligament.inplane_stiffness import COLUMNS, ROWS, semidefinite
from fitting.ligament.joint_fit import JointFit, fit_joint
from fitting.ligament.joint_lines import DOFS, JointLines, joint_lines
from fitting.ligament.ligament_fit import LigamentFit, coupling_units, ligament_in_si
from fitting.ligament.prior import Prior, coupling_prior
from fitting.model.observation import Observation
from fitting.model.principal_axes import PRINCIPAL_DOF
from stapeskit.spatial import DOF_NAMES

Array = NDArray[np.float64]
_N = len(PRINCIPAL_DOF)
Extension = Callable[[JointLines], tuple[Term, ...]]


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
    both: Observation,
    start: Array,
    extend: Extension | None = None,
    needed: bool = True,
    begun: tuple[Array, Array] | None = None,
) -> LigamentFit | None:
    """Fit K, D, the coupling by the plane of the ligament and the shared errors together.

    Parameters
    ----------
    problem : Problem
        With the damping law; of the three degrees of freedom.
    both : Observation
        All six degrees of freedom of both bodies.
    start : ndarray, (12,)
        Scaled K and D of the plain model.
    extend : callable, optional
        Returns further unknowns of the lines.
    needed : bool
        Whether they are always in the model, or only where there is no result without them.
    begun : (ndarray, ndarray), optional
        Another start with them: scaled K and D, and their values.

    Returns
    -------
    LigamentFit or None
        None when the iteration does not settle, or settles where K' or D' is not positive semidefinite.
    """
    lines = joint_lines(problem, both)
    equations = _piston_equations(problem, lines)
    begins = np.concatenate([start, [problem.law.exponent] * problem.law.unknowns])
    joint = None
    for coupling in (equations.prior.mean[len(begins) :], np.zeros(_N * _N)):
        joint = fit_joint(lines, equations, np.concatenate([begins, coupling]))
        if joint.converged:
            break
    good = joint is not None and joint.converged and semidefinite(joint.parameters[: equations.entries])
    if extend is not None and joint is not None and (needed or not good):
        terms = extend(lines)
        fitted = _from_all_starts(lines, equations, joint, terms)
        if begun is not None:
            first = np.concatenate([begun[0], begins[len(start) :], equations.prior.mean[len(begins) :]])
            fitted = _better(fitted, _prepared(lines, equations, first, terms, begun[1]))
        if fitted is None or not semidefinite(fitted[1].parameters[: equations.entries]):
            return None
        return ligament_in_si(problem, lines, *fitted)
    return ligament_in_si(problem, lines, equations, joint) if good and joint is not None else None


def _from_all_starts(
    lines: JointLines, equations: Equations, fit: JointFit, terms: tuple[Term, ...]
) -> tuple[Equations, JointFit] | None:
    """Return the best fit with further unknowns from nothing and from the other starts of each.

    A start far from nothing is prepared by a fit of the other unknowns at that value.
    """
    best = extended_fit(lines, equations, fit, terms)
    for place, term in enumerate(terms):
        for value in term.starts:
            begin = np.zeros(len(terms))
            begin[place] = value
            best = _better(best, _prepared(lines, equations, fit.parameters, terms, begin))
    return best


Extended = tuple[Equations, JointFit]


def _better(one: Extended | None, other: Extended | None) -> Extended | None:
    if one is None or other is None:
        return other if one is None else one
    return other if other[1].chi2 < one[1].chi2 - 1e-6 else one


def _prepared(
    lines: JointLines, equations: Equations, start: Array, terms: tuple[Term, ...], begin: Array
) -> Extended | None:
    """Return a fit with further unknowns from values of theirs, at which the others are fitted first."""
    applied = (lines, equations)
    for term, value in zip(terms, begin, strict=True):
        applied = term.apply(float(value), *applied)
    try:
        there = fit_joint(*applied, start)
    except np.linalg.LinAlgError:
        return None
    return extended_fit(lines, equations, there, terms, begin)


def extended_fit(
    lines: JointLines,
    equations: Equations,
    fit: JointFit,
    terms: tuple[Term, ...],
    begin: Array | None = None,
) -> tuple[Equations, JointFit] | None:
    """Minimise with further unknowns, from values ``begin`` (0) of theirs; None when it does not settle."""
    extended = equations.with_terms(terms)
    begin = np.zeros(len(terms)) if begin is None else begin
    start = np.insert(fit.parameters, equations.unknowns, begin)
    try:
        joint_fit = fit_joint(lines, extended, start)
    except np.linalg.LinAlgError:
        return None
    return (extended, joint_fit) if joint_fit.converged else None


def _piston_equations(problem: Problem, lines: JointLines) -> Equations:
    """Return the equations of y, alpha and gamma with unknown coupling to x, z and beta."""
    rows, columns = np.eye(DOFS)[ROWS], np.eye(DOFS)[COLUMNS]
    free = _N * (_N + 1) + problem.law.unknowns
    mean, covariance = coupling_prior()
    unit = coupling_units(lines).ravel()
    root = np.zeros((_N * _N, free + _N * _N))
    root[:, free:] = np.linalg.cholesky(np.linalg.inv(covariance / np.outer(unit, unit))).T
    prior = Prior(np.concatenate([np.zeros(free), mean.ravel() / unit]), root)
    return Equations(rows, rows, columns, np.zeros((0, _N, DOFS)), problem.law, prior)

"""The one call: stiffness and damping from motion and mass, with uncertainty, diagnostics and warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from legacy.fitting.budget import budget_of, without_rounding
from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.diagnosis import model_error
from legacy.fitting.causes.model_error import minimum_error
from legacy.fitting.errors import FittingError
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.multistart import improve
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.fluid_mass import FLUID, choose_fluid
from legacy.fitting.inplane_load import AUTO, LOAD, InplaneChoice, choose_inplane_load
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.law_fits import (
    LawFit,
    best_of_each,
    fit_at,
    fit_law,
    fits_of_laws,
    rescale_bic,
    start_of_law,
    with_ligament,
)
from legacy.fitting.ligament.joint_lines import JointLines, joint_lines
from legacy.fitting.ligament.ligament import NotWithin, applies
from legacy.fitting.ligament.misfit import is_explained
from legacy.fitting.ligament.profile_spread import profile_spread
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.laws import LAWS
from legacy.fitting.model.model import modes
from legacy.fitting.model.observation import observe, observe_both
from legacy.fitting.model.parameter_vector import split
from legacy.fitting.model.range_checks import check_motion, check_result, unsolvable
from legacy.fitting.model.scaled_lines import Lines, Scale
from legacy.fitting.options import COMPARE, KDOptions
from legacy.fitting.result_checks import cause_notices, result_warnings
from legacy.fitting.uncertainty.covariance import chi2
from legacy.fitting.uncertainty.frequency_dependence import fewer_bands, frequency_dependence
from legacy.fitting.uncertainty.identifiability import Identifiability, identifiability
from legacy.fitting.uncertainty.profile import profile_intervals
from legacy.fitting.uncertainty.shared_misfit import chi2_with_shared_errors
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES
from legacy.stapeskit.warnings import Notice, unique

# Relative sd of the worst combination from which minimisation over the other entries settles nowhere, so that
# there is no profile; only the Fisher intervals, which are enormous then, are given.
_HOPELESS = 3.0
# Laws that are fitted to a misfit, out of those that are compared: the search for its cause begins at one of
# them, and the fits with a mass of fluid try all. Chosen by judgement, to save time; tried on two simulated
# ears alone (benchmarks/model_errors.py, a delay and a phase): 4 changes nothing, with 1 another law is
# chosen in one of them.
_NEAREST = 2
WITH_LIGAMENT = "the plane of the ligament is estimated together with K and D"
NOT_SETTLED = "the fit with the plane of the ligament did not settle on positive semidefinite K and D"


def fit_kd(
    motion: RigidMotion,
    mass: MassMatrix | Array,
    options: KDOptions | None = None,
    base_mass: Array | None = None,
) -> KDFit:
    """Estimate stiffness and damping of the suspension of a rigid body.

    Parameters
    ----------
    motion : RigidMotion
        Of structure and base about the footplate centre, in footplate axes.
    mass : MassMatrix or ndarray
        About the same point in the same axes; an array is (n, n) in the order of ``options.dof``, or (6, 6).
    options : KDOptions, optional
    base_mass : ndarray, (n, n), optional
        Mass M_tb coupled to the base motion: w^2 (M q_s + M_tb q_b) = Z dq; SI.

    Returns
    -------
    KDFit

    Raises
    ------
    FittingError
        Motion, mass and options do not fit together, or the data cannot determine the unknowns at all.
    KinematicsError
        A body is missing.
    """
    try:
        return _fit(motion, mass, options or KDOptions(), base_mass)
    except np.linalg.LinAlgError as fault:
        raise unsolvable() from fault


def _fit(motion: RigidMotion, mass: MassMatrix | Array, options: KDOptions, base_mass: Array | None) -> KDFit:
    if options.dof_reordered and not isinstance(mass, MassMatrix):
        step = f"Write {','.join(options.dof)} and order rows and columns of the matrix so"
        raise FittingError.of(
            "{dof}",
            f"in the order {','.join(DOF_NAMES)} where a plain mass matrix counts by it",
            "another",
            "",
            step,
        )
    inertia = inertia_of(mass, options.dof)
    observation = observe(
        motion,
        options.dof,
        options.structure,
        options.base,
        options.band_hz,
        options.exclude_hz,
        with_load=options.inplane != "ignore" or inertia.complete,
    )
    check_motion(observation)
    scale = Scale.of(observation, inertia.rows(observation.dof, ()))
    settings = EstimatorOptions(options.robust, options.constraint)
    problem = Problem(observation, inertia, scale, DampingLaw(), options.estimator, settings, base_mass)
    measured = _measured_lines(motion, options, problem)
    if options.causes and measured is None:
        raise FittingError(_not_joint(options))
    plain, laws, choice, undetermined = _laws(problem, options, measured)
    best = min(laws, key=lambda fit: (fit.ligament is None, not fit.law.physical, fit.bic))
    diagnosis, fluid, off = None, None, np.zeros((24, 0))
    if best.ligament is not None and measured is not None:
        best, diagnosis, fluid, laws = choose_fluid(best, plain, measured, options, laws)
        if best.ligament is not None:
            parts = (model_error(diagnosis, best.ligament), _minima(best), profile_spread(best.ligament))
            off = np.concatenate(parts, axis=1)
            best = replace(best, ligament=best.ligament.with_model_error(off[12:]))
        laws = tuple(best if law.law.name == best.law.name else law for law in laws)
    problem = best.problem
    lines = problem.lines()
    known = identifiability(best.estimate.parameters, lines, problem.units)
    if known.weak and problem.method.likelihood and best.ligament is None:
        estimate = improve(problem, lines, best.estimate)
        best = replace(best, estimate=estimate, chi2=chi2(estimate.parameters, lines))
        laws = tuple(best if law.law.name == best.law.name else law for law in laws)
        known = identifiability(estimate.parameters, lines, problem.units)
    fit = _result(motion, options, problem, choice, laws, best, lines, known, off[:12])
    fit = replace(fit, diagnosis=diagnosis, fluid=fluid)
    fit = replace(fit, notices=unique([*fit.notices, *cause_notices(fit)]))
    notices = [*fit.notices, *_undetermined_laws(undetermined), *_ambiguous_law_notices(fit)]
    return replace(fit, undetermined=undetermined, notices=unique(notices))


def _minima(best: LawFit) -> Array:
    """Return columns (24, k) of the error where the data do not decide between the minima under a law."""
    assert best.ligament is not None  # noqa: S101
    others = [fit for fit in best.others if fit.ligament is not None and fit.law.physical]
    level = max(1.0, best.ligament.joint.level)
    weights = np.exp([-0.5 * max(fit.chi2 - best.chi2, 0.0) / level for fit in others])
    columns = [
        np.sqrt(weight / (1.0 + weights.sum())) * minimum_error(best.ligament, fit.ligament)
        for weight, fit in zip(weights, others, strict=True)
        if fit.ligament is not None
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((24, 0))


def _measured_lines(motion: RigidMotion, options: KDOptions, problem: Problem) -> JointLines | None:
    """Return the motion of both bodies where the plane of the ligament is to be estimated."""
    if options.inplane != AUTO:
        return None
    both = observe_both(motion, options.structure, options.base, options.band_hz, options.exclude_hz)
    return joint_lines(problem, both) if applies(problem, both) else None


def _not_joint(options: KDOptions) -> Fault:
    return Fault(
        "{correct} and {fluid} y",
        "left out unless motion and mass matrix have all six degrees of freedom",
        ", ".join(options.causes),
        next_step="Run points2dof with all degrees of freedom and give {mass} mass.json",
    )


def _laws(
    problem: Problem, options: KDOptions, measured: JointLines | None
) -> tuple[tuple[LawFit, ...], tuple[LawFit, ...], InplaneChoice, dict[str, str]]:
    """Fit the damping law that was asked for, or all of them, with the ligament's plane where it applies.

    Returns
    -------
    plain : tuple of LawFit
        Fits without the plane of the ligament.
    fits : tuple of LawFit
    choice : InplaneChoice
    undetermined : dict of str to str
    """
    if measured is not None:
        loaded, choice = choose_inplane_load(problem, LOAD)
        fits, undetermined = _fits(loaded, options, partial(start_of_law, fluid=FLUID in options.causes))
        settled = _joint_fits(fits, measured, options)
        if options.causes and not settled:
            raise FittingError(_without_result(options))
        for fit in fits:
            if settled and fit.law.name not in {other.law.name for other in settled}:
                undetermined[fit.law.name] = NOT_SETTLED
        if any(fit.ligament is not None for fit in settled):
            laws = best_of_each(rescale_bic(settled))
            return fits, laws, replace(choice, reason=WITH_LIGAMENT), undetermined
    chosen, choice = choose_inplane_load(problem, options.inplane)
    if measured is not None:
        choice = replace(choice, reason=f"{choice.reason}; {NOT_SETTLED}")
    fits, undetermined = _fits(chosen, options, fit_law)
    return fits, best_of_each(fits), choice, undetermined


def _joint_fits(fits: tuple[LawFit, ...], measured: JointLines, options: KDOptions) -> tuple[LawFit, ...]:
    """Return the fits with the plane of the ligament that settle.

    Where laws are compared and one explains the data, those that do not stay without the plane; where none
    does, only those that come nearest are fitted with it.
    """
    from scipy.special import chdtri

    if options.damping == COMPARE and not options.causes:
        near = []
        for fit in fits:
            try:
                joint = _fit_ligament(
                    fit, measured, options, float(chdtri(fit.n_dof, calibrated("causes.misfit_p")))
                )
            except NotWithin:
                joint = fit
            near += [] if joint is None else [joint]
        if any(fit.ligament is not None and fit.law.physical for fit in near):
            return tuple(near)
        fits = tuple(sorted(fits, key=lambda fit: fit.bic))
        joints = [_fit_ligament(fit, measured, options) for fit in fits[:_NEAREST]]
        return (*(joint for joint in joints if joint is not None), *fits[_NEAREST:])
    return tuple(
        joint for joint in (_fit_ligament(fit, measured, options) for fit in fits) if joint is not None
    )


def _fit_ligament(
    fit: LawFit, measured: JointLines, options: KDOptions, within: float | None = None
) -> LawFit | None:
    """Return a fit with the plane of the ligament; None where it does not settle.

    Where the free minimum has no positive semidefinite K and D, they are held so, or a mass of fluid makes
    them so where that is worth its unknown (criterion of Schwarz). Where the fit with fluid explains the
    data, and the free minimum is already worse than a held fit could make up for, the held fit is left out.
    """
    free = with_ligament(fit, measured, options.causes, within=within)
    if free.ligament is not None or options.causes:
        return free if free.ligament is not None else None
    tried = []
    if options.fluid == "auto":
        start = start_of_law(fit.problem, fit.law.name, options.lower, options.upper, fit.law.ratio, True)
        fluid = with_ligament(start, measured, (FLUID,), within=within)
        if fluid.ligament is not None and is_explained(fluid.ligament.joint):
            largest = fluid.bic - (free.bic - free.chi2)  # chi2 up to which a held fit would be chosen
            if free.outside > max(1.0, fluid.ligament.joint.level) * largest:
                return fluid
        tried.append(fluid)
    with suppress(np.linalg.LinAlgError):
        tried.append(with_ligament(fit, measured, held=True))
    settled = rescale_bic(joint for joint in tried if joint.ligament is not None)
    return min(settled, key=lambda joint: joint.bic) if settled else None


def _without_result(options: KDOptions) -> Fault:
    return Fault(
        "{correct} and {fluid} y",
        "causes with which K and D are positive semidefinite",
        ", ".join(options.causes),
        next_step="Leave one of them out",
    )


def _fits(
    problem: Problem, options: KDOptions, fit: Callable[..., LawFit]
) -> tuple[tuple[LawFit, ...], dict[str, str]]:
    names = LAWS if options.damping == COMPARE else (options.damping,)
    return fits_of_laws(problem, names, options.lower, options.upper, fit)


def _ambiguous_law_notices(fit: KDFit) -> list[Notice]:
    """Return a warning about damping laws between which the data do not decide."""
    others = fit.laws_alike
    if not others:
        return []
    text = (
        f"The damping law is undetermined: the data do not tell {fit.law.name} from {' or '.join(others)} "
        f"damping. K and D are those under {fit.law.name}; their intervals include what the others would "
        "change."
    )
    return [Notice("law_ambiguous", text)]


def _undetermined_laws(laws: Mapping[str, str]) -> list[Notice]:
    """Return a warning about damping laws that could not be fitted."""
    if not laws:
        return []
    listed = "; ".join(f"{name} ({reason})" for name, reason in laws.items())
    return [
        Notice("law_undetermined", f"These damping laws could not be fitted and are not compared: {listed}.")
    ]


def _result(
    motion: RigidMotion,
    options: KDOptions,
    problem: Problem,
    choice: InplaneChoice,
    laws: tuple[LawFit, ...],
    best: LawFit,
    lines: Lines,
    known: Identifiability,
    off: Array,
) -> KDFit:
    """Assemble a result: matrices, uncertainty, modes, axes, warnings."""
    scaled, ligament = best.estimate.parameters, best.ligament
    stiffness, damping = split(scaled * problem.units, problem.n)
    if ligament is not None:
        stiffness, damping = ligament.stiffness, ligament.damping
    budget = budget_of(problem, lines, best, off)
    budget = replace(
        budget,
        covariance=without_rounding(budget.covariance, stiffness, damping),
        noise=without_rounding(budget.noise, stiffness, damping),
    )
    check_result(stiffness, damping, budget.covariance, budget.noise)
    mode_list = modes(problem.vibrating_mass, stiffness, damping, problem.law)
    fit = KDFit(
        options,
        options.dof,
        problem.mass,
        stiffness,
        damping,
        problem.law,
        laws,
        best.estimate,
        budget.covariance,
        budget.noise,
        budget,
        mode_list,
        best.chi2,
        best.n_dof,
        choice,
        known,
        problem.observation,
        problem,
        (),
        joint_chi2=best.chi2 if ligament is not None else chi2_with_shared_errors(problem, lines, scaled),
        ligament=ligament,
        plain=None if ligament is None else _fit_without_plane(best, options),
    )
    if (
        options.profile
        and ligament is None
        and known.weak
        and known.worst < _HOPELESS
        and best.estimate.converged
        and budget.method == "fisher"
    ):
        ends = profile_intervals(lines, best.estimate, problem.options, budget.widened)
        fit = replace(fit, profile=ends * problem.units[:, None])
    if options.bands:
        local = frequency_dependence(problem, lines, best.estimate, budget.widened, options.bands)
        fit = replace(fit, frequency=local)
    notices = fewer_bands(lines.count, options.bands)
    return replace(fit, notices=unique([*motion.notices, *result_warnings(fit), *notices]))


def _fit_without_plane(best: LawFit, options: KDOptions) -> LawFit:
    """Return what the three degrees of freedom alone give, without in-plane motion, under the same law."""
    problem = replace(best.problem, coupling=None, observation=best.problem.observation.without_load())
    return fit_at(problem, best.law, options.lower, options.upper)


__all__ = ["KDFit", "KDOptions", "fit_kd"]

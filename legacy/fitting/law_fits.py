"""Fit under one damping law, or under all of them, compared by chi2 and BIC."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.catalogue import term_of
from legacy.fitting.causes.correction import corrected_problem
from legacy.fitting.causes.setting import Setting
from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import Estimate, gram, solve_symmetric
from legacy.fitting.estimators.multistart import with_fluid
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.equations import Term
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.fitting.ligament.ligament import NotPassive, fit_ligament
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.laws import LAWS, law_of
from legacy.fitting.model.parameter_vector import entry_names, split
from legacy.fitting.model.scaled_lines import forward, real_rows
from legacy.fitting.uncertainty.covariance import chi2, degrees
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.quantities import MILLIGRAM

# Exponents or times at which a law is tried before a joint fit; the fit goes on from the best of them. Chosen
# by judgement.
_STARTS = 6


@dataclass(frozen=True)
class LawFit:
    """A fit under one damping law.

    Attributes
    ----------
    bic : float
        chi2 over the best law's chi2 per degree of freedom (when above 1) + unknowns ln(equations).
    law_covariance : ndarray, (unknowns, unknowns)
        Of the unknowns of the law, channel noise only; with a ligament their variances, from all sources.
    ligament : LigamentFit or None
        The joint fit with the plane of the ligament; chi2 is its then.
    others : tuple of LawFit
        Further minima under the same law.
    outside : float
        Chi2 of the joint fit that was left since its K or D is not positive semidefinite; 0 where none was.
    """

    law: DampingLaw
    problem: Problem
    estimate: Estimate
    chi2: float
    bic: float
    law_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    ligament: LigamentFit | None = None
    others: tuple[LawFit, ...] = field(default=(), repr=False)
    outside: float = 0.0

    @property
    def n_dof(self) -> int:
        """Degrees of freedom of chi2."""
        if self.ligament is not None:
            return self.ligament.n_dof
        return degrees(self.problem.lines()) - self.law.free

    @property
    def law_sd(self) -> Array:
        """Standard deviations of the unknowns of the law."""
        return np.sqrt(np.diag(self.law_covariance))

    @property
    def exponent_sd(self) -> float | None:
        """Standard deviation of an estimated exponent or time."""
        return float(self.law_sd[0]) if self.law_covariance.size else None


def fit_law(
    problem: Problem, name: str, lower: Mapping[str, float], upper: Mapping[str, float], ratio: float = 0.0
) -> LawFit:
    """Estimate under one damping law; what it leaves open is estimated by a search."""
    search = law_of(name).search
    if search is None:
        return fit_at(problem, DampingLaw(name), lower, upper)
    from scipy.optimize import minimize, minimize_scalar

    unit, sd = 1.0 / problem.scale.omega, DampingLaw(name).prior_sd

    def law_at(unknowns: Array) -> DampingLaw:
        return DampingLaw(name).with_unknowns(unknowns).scaled(unit)

    def objective(unknowns: Array) -> float:
        fit = fit_at(problem, law_at(unknowns), lower, upper)
        off = float(np.sum(((unknowns - usual) / sd) ** 2))
        # A prior weighs against chi2; an estimator's own objective may have any scale.
        return (fit.estimate.objective if unweighed else 0.5 * fit.chi2) + 0.5 * off

    usual = DampingLaw(name, ratio=ratio).unknowns
    unweighed = problem.method.likelihood or not np.any(np.isfinite(sd))
    best = usual.copy()
    optimum = minimize_scalar(
        lambda exponent: objective(np.array([exponent, *best[1:]])),
        bounds=search,
        method="bounded",
        options={"xatol": 1e-6},
    )
    best[0] = optimum.x
    if len(best) > 1:
        best = minimize(objective, best, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-4}).x
    fit = fit_at(problem, law_at(best), lower, upper)
    return replace(fit, law_covariance=_law_covariance(fit))


def start_of_law(
    problem: Problem,
    name: str,
    lower: Mapping[str, float],
    upper: Mapping[str, float],
    ratio: float = 0.0,
    fluid: bool = False,
) -> LawFit:
    """Return the best fit under a law at a few of the exponents or times that it may have.

    Two times start where they relax at either side of the middle of the band.
    With ``fluid`` it is the best one from which a fit with a mass of fluid goes on: without that mass a
    relaxation time comes out below zero, and the fit with it would stay there.
    """
    search = law_of(name).search
    if search is None:
        return fit_law(problem, name, lower, upper)
    ends = np.linspace(*search, _STARTS + 1)
    places = [ratio**-0.5] if ratio else ends[:-1] + 0.5 * np.diff(ends)
    laws = [DampingLaw(name, float(at), ratio).scaled(1.0 / problem.scale.omega) for at in places]
    free = replace(problem, options=replace(problem.options, passive=False))
    tried = [fit_at(free, law, lower, upper) for law in laws]
    if fluid:
        chi2_with_fluid = [with_fluid(fit.estimate.parameters, fit.problem.lines())[2] for fit in tried]
        return fit_at(problem, laws[int(np.argmin(chi2_with_fluid))], lower, upper)
    best = None
    for first in sorted(tried, key=lambda fit: fit.chi2):
        if best is not None and best.chi2 <= first.chi2:  # no K, D >= 0 fits better than it does
            break
        passive_fit = fit_at(problem, first.law, lower, upper)
        best = passive_fit if best is None or passive_fit.chi2 < best.chi2 else best
    assert best is not None  # noqa: S101
    return best


def fits_of_laws(
    problem: Problem,
    names: Iterable[str],
    lower: Mapping[str, float],
    upper: Mapping[str, float],
    fit: Callable[..., LawFit] = fit_law,
) -> tuple[tuple[LawFit, ...], dict[str, str]]:
    """Estimate under damping laws; a law with two times from each of its ratios.

    Parameters
    ----------
    lower, upper : mapping of str to float
        Bounds.
    fit : callable
        `fit_law`, or `start_of_law` where a joint fit goes on from it.

    Returns
    -------
    fits : tuple of LawFit
    undetermined : dict of str to str
        Why a law has no fit, by its name.

    Raises
    ------
    FittingError
        No law has a fit; the fault of the first.
    """
    fits, faults = [], {}
    for name in names:
        try:
            fits += [fit(problem, name, lower, upper, ratio) for ratio in law_of(name).ratios or (0.0,)]
        except (FittingError, np.linalg.LinAlgError) as fault:
            faults[name] = fault
    if not fits:
        raise next(iter(faults.values()))
    comparable = rescale_bic(fits) if len(fits) > 1 else tuple(fits)
    return comparable, {name: str(fault) for name, fault in faults.items()}


def best_of_each(fits: Iterable[LawFit]) -> tuple[LawFit, ...]:
    """Return the best fit of each law, with its other minima."""
    of_law: dict[str, list[LawFit]] = {}
    for fit in sorted(fits, key=lambda fit: (fit.ligament is None, fit.bic)):
        of_law.setdefault(fit.law.name, []).extend([fit, *fit.others])
    return tuple(replace(of_law[name][0], others=tuple(of_law[name][1:])) for name in LAWS if name in of_law)


def rescale_bic(fits: Iterable[LawFit]) -> tuple[LawFit, ...]:
    """Return the fits with BIC made comparable by the best chi2 per degree of freedom."""
    fits = tuple(fits)
    spread = max(1.0, min(fit.chi2 / max(fit.n_dof, 1) for fit in fits))
    return tuple(replace(fit, bic=_bic(fit, spread)) for fit in fits)


def indistinguishable_laws(best: LawFit, laws: Iterable[LawFit]) -> tuple[str, ...]:
    """Return the laws between which and the law of the best fit the data do not decide.

    A law that contains the best one as a special case does not count: the simpler law is kept until the
    data contradict it. Unknowns of a law that have a prior do not count as free.
    """
    names = []
    for other in laws:
        same = other.law.name == best.law.name or best.law.name in other.law.law.includes
        if same or not other.law.physical or (best.ligament is not None and other.ligament is None):
            continue
        equations = 2 * best.problem.n * len(best.problem.observation.freq_hz)
        chosen = (other.law.known - best.law.known) * np.log(equations)
        if other.bic - best.bic - chosen < calibrated("causes.look_alike_chi2"):
            names.append(other.law.name)
    return tuple(names)


def with_ligament(
    fit: LawFit,
    measured: JointLines,
    names: tuple[str, ...] = (),
    sizes: Mapping[str, float] | None = None,
    held: bool = False,
    within: float | None = None,
) -> LawFit:
    """Return a fit extended by the plane of the ligament and the shared errors, or itself if that fails.

    Parameters
    ----------
    measured : JointLines
        Motion of both bodies without units.
    names : tuple of str
        Causes of the catalogue that are part of the model.
    sizes : mapping of str to float, optional
        Where the fit starts as well, in the units of the causes.
    held : bool
        Whether K and D are kept positive semidefinite, without causes.
    within : float, optional
        Chi2 below which the fit is of use; a misfit is left as it is.

    Raises
    ------
    NotWithin
        Chi2 does not come below ``within``.
    """
    problem = fit.problem
    begun = None
    if "fluid" in names:
        parameters, fluid, _ = with_fluid(fit.estimate.parameters, problem.lines())
        size = MILLIGRAM.of(fluid * float(problem.scale.root_mass[0]) ** 2)
        begun = (parameters, np.array([size if name == "fluid" else 0.0 for name in names]))

    def extend(lines: JointLines) -> tuple[Term, ...]:
        setting = Setting(lines, lines.omega * problem.scale.omega, problem.inertia.matrix)
        terms = [term_of(name, setting) for name in names]
        more = sizes or {}
        return tuple(
            replace(term, starts=(*term.starts, more[term.name])) if term.name in more else term
            for term in terms
        )

    start = fit.estimate.parameters
    try:
        ligament = fit_ligament(problem, measured, start, extend if names else None, begun, held, within)
    except NotPassive as fault:
        return replace(fit, outside=fault.chi2)
    if ligament is None:
        return fit
    extended = LawFit(
        ligament.law,
        corrected_problem(problem, ligament),
        ligament.estimate,
        ligament.chi2,
        0.0,
        np.diag(ligament.law_sd**2),
        ligament,
    )
    return replace(extended, bic=_bic(extended, 1.0))


def fit_at(
    problem: Problem, law: DampingLaw, lower: Mapping[str, float], upper: Mapping[str, float]
) -> LawFit:
    """Estimate under one damping law with its exponent or time as it is."""
    same = problem.with_law(law)
    options = replace(same.options, lower=_bounds(same, lower, -np.inf), upper=_bounds(same, upper, np.inf))
    same = replace(same, options=options)
    estimate = same.solve()
    level = chi2(estimate.parameters, same.lines())
    fit = LawFit(law, same, estimate, level, 0.0)
    return replace(fit, bic=_bic(fit, 1.0))


def _bic(fit: LawFit, spread: float) -> float:
    observation = fit.problem.observation
    unknowns = len(fit.estimate.parameters) + len(fit.law.unknowns)
    if fit.ligament is not None:
        unknowns += len(fit.ligament.terms)
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


def _law_covariance(fit: LawFit) -> Array:
    """Return the covariance of the law's unknowns: the inverse Schur complement of their information."""
    lines = fit.problem.lines()
    now = ml.whiten(fit.estimate.parameters, lines)
    rows = real_rows(now.corrected(lines))
    _, damping = split(fit.estimate.parameters, lines.n)
    omega = fit.problem.scale.omega
    slopes = fit.law.scaled(omega).slopes(lines.omega)
    extra = np.stack(
        [real_rows(forward(now.factor, slope * (damping @ lines.dq))) for slope in slopes], axis=1
    )
    across = rows.T @ extra
    information = 2.0 * (extra.T @ extra - across.T @ solve_symmetric(gram(rows), across))
    information += np.diag(fit.law.prior_sd**-2.0)
    units = fit.law.units(omega)
    return np.asarray(np.linalg.pinv(information) * np.outer(units, units))

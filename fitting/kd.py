"""The one call: stiffness and damping from motion and mass, with uncertainty, diagnostics and warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fitting.bands import USUAL_BANDS, FrequencyDependence, frequency_dependence
from fitting.budget import Budget, Derived, budget_of, derived_quantities
from fitting.damping import LAWS, DampingLaw
from fitting.errors import FittingError
from fitting.estimators import ESTIMATORS, Estimate, EstimatorOptions
from fitting.identifiability import Identifiability, identifiability
from fitting.inertia import inertia_of
from fitting.inplane import CHOICES, InplaneChoice, choose
from fitting.laws import LawFit, compare_laws, fit_law
from fitting.lines import Lines, Scale
from fitting.model import Modes, modes, passive
from fitting.observation import Observation, observe
from fitting.problem import Problem
from fitting.profile import profile_intervals
from fitting.starts import improve
from fitting.symmetric import entry_names, join, split
from fitting.uncertainty import chi2, degrees
from fitting.verdicts import verdicts
from kinematics.errors import raise_all, sentence
from kinematics.mass_record import MassMatrix
from kinematics.motion import RigidMotion
from kinematics.notices import Notice, unique
from kinematics.spatial import DOF_NAMES

Array = NDArray[np.float64]
COMPARE = "compare"
# Relative sd of the worst combination from which minimisation over the other entries settles nowhere, so that
# there is no profile; the Fisher intervals, which are enormous then, stand alone.
_HOPELESS = 3.0


@dataclass(frozen=True)
class KDOptions:
    """Choices of a fit; the defaults are those of the command.

    Attributes
    ----------
    dof : tuple of str
        Degrees of freedom of the model, in the order of DOF_NAMES.
    structure, base : str
        Names of the two bodies.
    estimator : str
        ``ml``, ``irls``, ``pinv`` or ``constrained``.
    robust : str
        ``none`` or ``t4`` (ml only).
    damping : str
        ``viscous``, ``hysteretic``, ``fractional`` or ``compare``.
    inplane : str
        ``auto``, ``load`` or ``ignore``.
    band_hz : (float, float), optional
    exclude_hz : sequence of (float, float)
    constraint : str
        ``eigenvalues`` or ``psd`` (constrained only).
    lower, upper : mapping of str to float
        Bounds of entries in SI by name, e.g. ``{"K11": 100.0}`` (constrained only).
    bands : int
        Parts of the band in which K and D are compared with those of the whole; 0 for none.
    profile : bool
        Whether to look for profile likelihood intervals where the data are weak.

    Raises
    ------
    FittingError
        A choice is unknown, or contradicts another.
    """

    dof: tuple[str, ...] = ("y", "alpha", "gamma")
    structure: str = "stapes"
    base: str = "base"
    estimator: str = "ml"
    robust: str = "none"
    damping: str = "viscous"
    inplane: str = "auto"
    band_hz: tuple[float, float] | None = None
    exclude_hz: Sequence[tuple[float, float]] = ()
    constraint: str = "eigenvalues"
    lower: Mapping[str, float] = field(default_factory=dict)
    upper: Mapping[str, float] = field(default_factory=dict)
    bands: int = USUAL_BANDS
    profile: bool = True

    def __post_init__(self) -> None:
        faults = []
        for option, value, known in (
            ("--estimator", self.estimator, ESTIMATORS),
            ("--robust", self.robust, ("none", "t4")),
            ("--damping", self.damping, (*LAWS, COMPARE)),
            ("--inplane", self.inplane, CHOICES),
            ("--constraint", self.constraint, ("eigenvalues", "psd")),
        ):
            if value not in known:
                faults.append(sentence(option, f"one of {', '.join(known)}", value))
        if self.bands not in (0, *range(2, 101)):
            faults.append(sentence("--bands", "0, or 2 to 100 parts of the band", self.bands))
        if self.robust != "none" and self.estimator != "ml":
            faults.append(
                sentence(
                    "--robust t4",
                    "given with --estimator ml",
                    self.estimator,
                    next_step="Leave one of the two out",
                )
            )
        if (self.lower or self.upper) and self.estimator != "constrained":
            faults.append(
                sentence(
                    "--lower and --upper",
                    "given with --estimator constrained",
                    self.estimator,
                    next_step="Give --estimator constrained, or leave the bounds out",
                )
            )
        ranges = [("--exclude", one) for one in self.exclude_hz]
        ranges += [("--band", self.band_hz)] if self.band_hz is not None else []
        for option, (low, high) in ranges:
            if not 0.0 <= low < high:
                faults.append(
                    sentence(
                        option,
                        "a range of frequencies, low before high",
                        f"{low:g} to {high:g} Hz",
                        next_step=_range_step(option, low, high),
                    )
                )
        if tuple(name for name in DOF_NAMES if name in self.dof) != tuple(self.dof) or not self.dof:
            wanted = f"different names in the order {', '.join(DOF_NAMES)}"
            faults.append(sentence("--dof", wanted, ",".join(self.dof) or "nothing"))
        names = entry_names(len(self.dof))
        for option, bounds in (("--lower", self.lower), ("--upper", self.upper)):
            for name in bounds:
                if name not in names:
                    faults.append(
                        sentence(
                            option,
                            f"an entry out of {', '.join(names)}",
                            name,
                            next_step="Count rows and columns in the order of --dof; K and D are symmetric",
                        )
                    )
                elif not np.isfinite(bounds[name]):
                    faults.append(sentence(f"{option} {name}", "a finite number in SI", bounds[name]))
                elif option == "--upper" and name[1] == name[2] and bounds[name] <= 0.0:
                    step = "K and D have no negative diagonals; leave the bound out or give a positive one"
                    faults.append(sentence(f"--upper {name}", "positive", f"{bounds[name]:g}", "", step))
        for name in set(self.lower) & set(self.upper):
            if self.lower[name] >= self.upper[name]:
                faults.append(
                    sentence(
                        f"--lower {name}",
                        f"below {self.upper[name]:g}",
                        f"{self.lower[name]:g}",
                        next_step=f"Swap --lower and --upper of {name}, or leave one out",
                    )
                )
        raise_all(FittingError, faults)


def _range_step(option: str, low: float, high: float) -> str:
    """Return what to write instead of a range that is none."""
    if 0.0 <= high < low:
        return f"Write {option} {high:g}{',' if option == '--band' else '-'}{low:g}"
    return "Give two different frequencies in Hz that are not negative"


@dataclass(frozen=True)
class KDFit:
    """Stiffness and damping with everything that is known about them.

    Attributes
    ----------
    options : KDOptions
    dof : tuple of str, (n,)
    mass, stiffness, damping : ndarray, (n, n)
        SI.
    law : DampingLaw
    laws : tuple of LawFit
        Every damping law that was tried.
    estimate : Estimate
        In scaled parameters.
    covariance, noise_covariance : ndarray, (p, p)
        Of the parameters K11, K12, ..., Dnn: of all sources, and of channel noise alone; SI.
    budget : Budget
    derived : Derived
        Modes and principal axes with their uncertainty.
    modes : Modes
    chi2 : float
    n_dof : int
        2 n lines - unknowns.
    inplane : InplaneChoice
    identifiability : Identifiability
    observation : Observation
        The lines that were fitted.
    problem : Problem
    notices : tuple of Notice
    profile : ndarray, (p, 2), or None
        95 % profile likelihood intervals of the parameters, channel noise alone, SI; where the data are weak
        but not hopeless.
    frequency : FrequencyDependence, or None
        Local factors of K and D over the band; None without ``options.bands`` or with too few lines.
    """

    options: KDOptions
    dof: tuple[str, ...]
    mass: Array
    stiffness: Array
    damping: Array
    law: DampingLaw
    laws: tuple[LawFit, ...]
    estimate: Estimate
    covariance: Array
    noise_covariance: Array
    budget: Budget
    derived: Derived
    modes: Modes
    chi2: float
    n_dof: int
    inplane: InplaneChoice
    identifiability: Identifiability
    observation: Observation
    problem: Problem
    notices: tuple[Notice, ...]
    profile: Array | None = None
    frequency: FrequencyDependence | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters: K11, K12, ..., Dnn."""
        return entry_names(len(self.dof))

    @property
    def standard_deviation(self) -> tuple[Array, Array]:
        """Standard deviation of K and of D from all sources, (n, n) each, SI."""
        return split(np.sqrt(np.diag(self.covariance)), len(self.dof))

    @property
    def noise_standard_deviation(self) -> tuple[Array, Array]:
        """The same from channel noise alone."""
        return split(np.sqrt(np.diag(self.noise_covariance)), len(self.dof))

    @property
    def intervals(self) -> Array:
        """95 % intervals of the parameters from all sources, (p, 2), SI.

        1.96 standard deviations to either side; with a profile, its ends take the place of the channel
        noise's and the other sources are added in quadrature.
        """
        values = join(self.stiffness, self.damping)
        variance = np.diag(self.covariance)
        if self.profile is None:
            reach = 1.96 * np.sqrt(variance)
            return np.column_stack([values - reach, values + reach])
        others = 1.96**2 * np.maximum(variance - np.diag(self.noise_covariance), 0.0)
        below = np.hypot(np.maximum(values - self.profile[:, 0], 0.0), np.sqrt(others))
        above = np.hypot(np.maximum(self.profile[:, 1] - values, 0.0), np.sqrt(others))
        return np.column_stack([values - below, values + above])

    @property
    def passive(self) -> tuple[bool, bool]:
        """Whether K and D are positive semidefinite."""
        return passive(self.stiffness), passive(self.damping)

    @property
    def lines(self) -> Lines:
        """The scaled equations that were solved."""
        return self.problem.lines()


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
    options = options or KDOptions()
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
    scale = Scale.of(observation, inertia.rows(observation.dof, ()))
    settings = EstimatorOptions(options.robust, options.constraint)
    problem = Problem(observation, inertia, scale, DampingLaw(), options.estimator, settings, base_mass)
    problem, choice = choose(problem, options.inplane)
    laws = _laws(problem, options)
    best = min(laws, key=lambda one: one.bic)
    problem = best.problem
    lines = problem.lines()
    known = identifiability(best.estimate.parameters, lines, problem.units)
    if known.weak and problem.name == "ml":
        estimate = improve(problem, lines, best.estimate)
        best = replace(best, estimate=estimate, chi2=chi2(estimate.parameters, lines))
        laws = tuple(best if one.law.name == best.law.name else one for one in laws)
        known = identifiability(estimate.parameters, lines, problem.units)
    return _result(motion, options, problem, choice, laws, best, lines, known)


def _laws(problem: Problem, options: KDOptions) -> tuple[LawFit, ...]:
    """Fit the damping law that was asked for, or all of them."""
    if options.damping == COMPARE:
        return compare_laws(problem, options.lower, options.upper)
    return (fit_law(problem, options.damping, options.lower, options.upper),)


def _result(
    motion: RigidMotion,
    options: KDOptions,
    problem: Problem,
    choice: InplaneChoice,
    laws: tuple[LawFit, ...],
    best: LawFit,
    lines: Lines,
    known: Identifiability,
) -> KDFit:
    """Put a result together: matrices, uncertainty, modes, axes, verdicts."""
    scaled = best.estimate.parameters
    stiffness, damping = split(scaled * problem.units, problem.n)
    budget = budget_of(problem, lines, best)
    found = modes(problem.mass, stiffness, damping, problem.law)
    derived = derived_quantities(problem, stiffness, damping, budget)
    unknowns = lines.parameters + (1 if problem.law.name == "fractional" else 0)
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
        derived,
        found,
        chi2(scaled, lines),
        degrees(lines) + lines.parameters - unknowns,
        choice,
        known,
        problem.observation,
        problem,
        (),
    )
    if options.profile and known.weak and known.worst < _HOPELESS and budget.method == "fisher":
        ends = profile_intervals(lines, best.estimate, problem.options, budget.widened)
        fit = replace(fit, profile=ends * problem.units[:, None])
    if options.bands:
        local = frequency_dependence(problem, lines, best.estimate, budget.widened, options.bands)
        fit = replace(fit, frequency=local)
    return replace(fit, notices=unique([*motion.notices, *verdicts(fit)]))

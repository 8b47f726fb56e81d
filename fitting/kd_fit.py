"""The choices of a fit of stiffness and damping, and what comes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fitting.budget import Budget, Derived
from fitting.errors import FittingError
from fitting.estimators import ESTIMATORS, estimator
from fitting.estimators.base import CONSTRAINTS, ROBUST, Estimate
from fitting.estimators.problem import Problem
from fitting.inplane import CHOICES, InplaneChoice
from fitting.laws import LawFit
from fitting.model.damping import DampingLaw
from fitting.model.laws import LAWS
from fitting.model.lines import Lines
from fitting.model.model import Modes, passive
from fitting.model.observation import Observation
from fitting.model.symmetric import entry_names, join, split
from fitting.uncertainty.bands import USUAL_BANDS, FrequencyDependence
from fitting.uncertainty.identifiability import Identifiability
from stapeskit.faults import Fault, raise_all
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
COMPARE = "compare"


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
        Of the table fitting.estimators.
    robust : str
        ``none`` or ``t4`` (ml only).
    damping : str
        Of the table fitting.model.laws, or ``compare``.
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
            ("--robust", self.robust, ROBUST),
            ("--damping", self.damping, (*LAWS, COMPARE)),
            ("--inplane", self.inplane, CHOICES),
            ("--constraint", self.constraint, CONSTRAINTS),
        ):
            if value not in known:
                faults.append(Fault(option, f"one of {', '.join(known)}", value))
        if self.bands not in (0, *range(2, 101)):
            faults.append(Fault("--bands", "0, or 2 to 100 parts of the band", self.bands))
        method = estimator(self.estimator) if self.estimator in ESTIMATORS else None
        if method is not None and self.robust in ROBUST and self.robust not in method.robust:
            able = [name for name in ESTIMATORS if self.robust in estimator(name).robust]
            faults.append(
                Fault(
                    f"--robust {self.robust}",
                    f"given with --estimator {' or '.join(able)}",
                    self.estimator,
                    next_step="Leave one of the two out",
                )
            )
        if (self.lower or self.upper) and method is not None and not method.bounded:
            able = [name for name in ESTIMATORS if estimator(name).bounded]
            faults.append(
                Fault(
                    "--lower and --upper",
                    f"given with --estimator {' or '.join(able)}",
                    self.estimator,
                    next_step=f"Give --estimator {able[0]}, or leave the bounds out",
                )
            )
        ranges = [("--exclude", one) for one in self.exclude_hz]
        ranges += [("--band", self.band_hz)] if self.band_hz is not None else []
        for option, (low, high) in ranges:
            if not 0.0 <= low < high:
                faults.append(
                    Fault(
                        option,
                        "a range of frequencies, low before high",
                        f"{low:g} to {high:g} Hz",
                        next_step=_range_step(option, low, high),
                    )
                )
        if tuple(name for name in DOF_NAMES if name in self.dof) != tuple(self.dof) or not self.dof:
            wanted = f"different names in the order {', '.join(DOF_NAMES)}"
            faults.append(Fault("--dof", wanted, ",".join(self.dof) or "nothing"))
        names = entry_names(len(self.dof))
        for option, bounds in (("--lower", self.lower), ("--upper", self.upper)):
            for name in bounds:
                if name not in names:
                    faults.append(
                        Fault(
                            option,
                            f"an entry out of {', '.join(names)}",
                            name,
                            next_step="Count rows and columns in the order of --dof; K and D are symmetric",
                        )
                    )
                elif not np.isfinite(bounds[name]):
                    faults.append(Fault(f"{option} {name}", "a finite number in SI", bounds[name]))
                elif option == "--upper" and name[1] == name[2] and bounds[name] <= 0.0:
                    step = "K and D have no negative diagonals; leave the bound out or give a positive one"
                    faults.append(Fault(f"--upper {name}", "positive", f"{bounds[name]:g}", "", step))
        for name in set(self.lower) & set(self.upper):
            if self.lower[name] >= self.upper[name]:
                faults.append(
                    Fault(
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

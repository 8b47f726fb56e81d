"""The result of a fit of stiffness and damping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from legacy.fitting.budget import Budget, Derived, derived_quantities
from legacy.fitting.causes.diagnosis import Diagnosis
from legacy.fitting.estimators.base import Estimate
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.fluid_mass import FluidChoice
from legacy.fitting.inplane_load import InplaneChoice
from legacy.fitting.law_fits import LawFit, indistinguishable_laws
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.model import Modes, passive
from legacy.fitting.model.observation import Observation
from legacy.fitting.model.parameter_vector import entry_names, join, split
from legacy.fitting.model.scaled_lines import Lines
from legacy.fitting.options import KDOptions
from legacy.fitting.uncertainty.frequency_dependence import FrequencyDependence
from legacy.fitting.uncertainty.identifiability import Identifiability
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice


@dataclass(frozen=True)
class KDFit:
    """Stiffness and damping with everything that is known about them.

    Attributes
    ----------
    dof : tuple of str, (n,)
    mass, stiffness, damping : ndarray, (n, n)
        SI.
    laws : tuple of LawFit
        Every damping law that was tried.
    estimate : Estimate
        In scaled parameters.
    covariance, noise_covariance : ndarray, (p, p)
        Of the parameters K11, K12, ..., Dnn: of all sources, and of channel noise alone; SI.
    n_dof : int
        2 n lines - unknowns.
    observation : Observation
        The lines that were fitted.
    profile : ndarray, (p, 2), or None
        95 % profile likelihood intervals of the parameters, channel noise alone, SI; where the data are weak
        but not hopeless.
    frequency : FrequencyDependence, or None
        Local factors of K and D over the band; None without ``options.bands`` or with too few lines.
    joint_chi2 : float or None
        Chi2 that takes the shared errors into account; the misfit is judged by it.
    ligament : LigamentFit or None
        The joint fit with the plane of the ligament; ``stiffness`` and ``damping`` are its own, about the
        footplate centre, while ``estimate`` and ``problem`` belong to the plane of the ligament.
    plain : LawFit or None
        With a ligament: what the three degrees of freedom alone give.
    diagnosis : Diagnosis or None
        What the scores say of every cause in the catalogue; with a ligament.
    fluid : FluidChoice or None
        What was decided about a mass of fluid; with a ligament.
    undetermined : mapping of str to str
        Why a damping law could not be fitted, by its name.
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
    joint_chi2: float | None = None
    ligament: LigamentFit | None = None
    plain: LawFit | None = None
    diagnosis: Diagnosis | None = None
    fluid: FluidChoice | None = None
    undetermined: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def derived(self) -> Derived:
        """Modes and principal axes with their uncertainty; computed where it is asked for."""
        return derived_quantities(self.problem, self.stiffness, self.damping, self.budget)

    @property
    def laws_alike(self) -> tuple[str, ...]:
        """Compared damping laws that the data do not distinguish from the chosen one."""
        best = next((law for law in self.laws if law.law == self.law), None)
        return () if best is None else indistinguishable_laws(best, self.laws)

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

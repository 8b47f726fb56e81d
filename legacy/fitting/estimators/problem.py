"""One fit as a whole: observation, mass, damping law and estimator, and its estimating equations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.fitting.estimators import estimator
from legacy.fitting.estimators.base import Estimate, EstimatorOptions, Method
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.inertia import Inertia
from legacy.fitting.model.observation import Observation
from legacy.fitting.model.scaled_lines import Lines, Scale, assemble
from legacy.stapeskit.arrays import Array, ComplexArray


@dataclass(frozen=True)
class Problem:
    """Everything that the estimate is a function of.

    Attributes
    ----------
    law : DampingLaw
        In SI.
    name : str
        Of the estimator.
    base_mass : ndarray, (n, n), optional
        Mass coupled to the base motion, SI.
    coupling : ndarray, (n, c), optional
        Y of fitting.ligament: the mass rows become M_r - Y M_c, SI.
    fluid : ndarray, (n, n), optional
        Mass M_f on the deflection, Z = K + s D - w^2 M_f, SI: M + M_f on the structure, -M_f on the base.
    """

    observation: Observation
    inertia: Inertia
    scale: Scale
    law: DampingLaw
    name: str
    options: EstimatorOptions
    base_mass: Array | None = None
    coupling: Array | None = None
    fluid: Array | None = None

    @property
    def method(self) -> Method:
        """The estimator."""
        return estimator(self.name)

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return len(self.observation.dof)

    @property
    def mass(self) -> Array:
        """Mass matrix of the chosen degrees of freedom, (n, n), SI."""
        return self.inertia.rows(self.observation.dof, ())

    @property
    def vibrating_mass(self) -> Array:
        """Mass matrix of free vibrations, the fluid on the deflection included, (n, n), SI."""
        return self.mass if self.fluid is None else self.mass + self.fluid

    @property
    def mass_on_base(self) -> Array | None:
        """Mass matrix that acts on the motion of the base, (n, n), SI; None without."""
        if self.fluid is None:
            return self.base_mass
        return -self.fluid if self.base_mass is None else self.base_mass - self.fluid

    @property
    def units(self) -> Array:
        """What scaled parameters are multiplied by to become SI, (p,)."""
        return self.scale.parameter_units(self.law)

    def lines(self, change: ComplexArray | None = None, mass_change: Array | None = None) -> Lines:
        """Return the scaled equations, with q (lines, m) or the inertial parameters (10,) changed."""
        observation = self.observation if change is None else self.observation.shifted(change)
        return assemble(observation, self.mass_rows(mass_change), self.scale, self.law, self.mass_on_base)

    def mass_rows(self, mass_change: Array | None = None) -> Array:
        """Return the mass matrix of the equations, [M_rr, M_rc] less the coupling's part, (n, n + c), SI."""
        dof, load_dof = self.observation.dof, self.observation.load_dof
        rows = self.inertia.rows(dof, load_dof, mass_change)
        if self.fluid is not None:
            rows = rows.copy()
            rows[:, : len(dof)] += self.fluid
        if self.coupling is None:
            return rows
        others = self.inertia.rows((*dof, *load_dof), (), mass_change)[len(dof) :]
        return np.asarray(rows - self.coupling @ others)

    def solve(self, start: Array | None = None) -> Estimate:
        """Estimate the scaled parameters."""
        return self.method.estimate(self.lines(), self.options, start)

    def gradient(self, parameters: Array, lines: Lines) -> Array:
        """Return the sum of the estimating equations (p,) at scaled parameters."""
        method = self.method
        if method.gradient is not None:
            return method.gradient(parameters, lines, self.options)
        return np.asarray(method.scores(parameters, lines, self.options).sum(axis=0))

    def with_observation(self, observation: Observation) -> Problem:
        """Return the same problem of other lines."""
        return replace(self, observation=observation)

    def with_law(self, law: DampingLaw) -> Problem:
        """Return the same problem under another damping law."""
        return replace(self, law=law)

"""The corrected problem of three degrees of freedom that belongs to a joint fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.joint_lines import DOFS
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.observation import Observation
from legacy.stapeskit.spatial import dof_indices, parameters_from_matrix


def corrected_problem(problem: Problem, ligament: LigamentFit) -> Problem:
    """Return the problem with law, coupling, fluid, and corrected motion and mass of a joint fit.

    Parameters
    ----------
    ligament : LigamentFit
        Factors on K and D (drift, level) are not part of the problem and cannot be corrected.
    """
    corrected = replace(problem.with_law(ligament.law), coupling=ligament.coupling, fluid=ligament.fluid)
    if not ligament.terms:
        return corrected
    lines = ligament.applied
    if lines.factors is not None:
        corrected = corrected.with_observation(_multiply(problem.observation, lines.factors))
    matrix = lines.mass * np.outer(lines.root_mass, lines.root_mass)
    if not np.allclose(matrix, problem.inertia.matrix, rtol=1e-12, atol=0.0):
        inertia = problem.inertia
        parameters = None if inertia.parameters is None else parameters_from_matrix(matrix)
        corrected = replace(corrected, inertia=replace(inertia, matrix=matrix, parameters=parameters))
    return corrected


def _multiply(observation: Observation, factors: np.ndarray) -> Observation:
    """Return the lines with every motion multiplied by the factor (lines, 12) of its body and direction."""
    structure = dof_indices((*observation.dof, *observation.load_dof))
    base = [DOFS + place for place in dof_indices(observation.dof)]
    own = factors[:, structure + base]
    derivatives = observation.shared_derivatives
    return replace(
        observation,
        q=observation.q * own,
        covariance=observation.covariance * (own[:, :, None] * own.conj()[:, None, :]),
        shared_derivatives=None if derivatives is None else derivatives * own,
    )

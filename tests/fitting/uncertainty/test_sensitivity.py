"""The exact derivatives of the estimating equations against finite differences, for every estimator."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.observation import observe
from legacy.fitting.model.scaled_lines import Scale
from legacy.fitting.uncertainty.sensitivity import contract, slope_by_motion
from tests.fitting.cases import DOF, six_dof_mass, six_dof_motion


@pytest.mark.parametrize("with_load", [False, True])
@pytest.mark.parametrize(
    ("name", "robust"),
    [("ml", "none"), ("ml", "t4"), ("irls", "none"), ("pinv", "none"), ("constrained", "none")],
)
def test_slope_by_motion_is_that_of_the_equations(name: str, robust: str, with_load: bool) -> None:
    observation = observe(six_dof_motion(0.05, 0, lines=60), DOF, with_load=with_load)
    inertia = inertia_of(six_dof_mass(), DOF)
    scale = Scale.of(observation, inertia.rows(DOF, ()))
    problem = Problem(observation, inertia, scale, VISCOUS, name, EstimatorOptions(robust))
    found = problem.solve().parameters
    rng = np.random.default_rng(1)
    draw = rng.standard_normal((2, 3, *observation.q.shape))
    changes = (draw[0] + 1j * draw[1]) * np.abs(observation.q).mean(axis=0)
    exact = contract(slope_by_motion(problem, problem.lines(), found), changes)
    step = 1e-5
    for place, change in enumerate(changes):
        ahead = problem.gradient(found, problem.lines(step * change))
        behind = problem.gradient(found, problem.lines(-step * change))
        difference = (ahead - behind) / (2.0 * step)
        assert np.abs(exact[:, place] - difference).max() < 3e-5 * np.abs(difference).max()

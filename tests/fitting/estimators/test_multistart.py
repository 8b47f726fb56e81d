"""Further starts: they find the optimum from a side valley, and a mass of fluid from its own equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.multistart import improve, with_fluid
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.observation import observe
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.model.scaled_lines import Scale
from tests.fitting.cases import DOF, D, K, M, paper_motion


def problem_of(noise: float, seed: int | None, lines: int) -> Problem:
    observation = observe(paper_motion(noise, seed, lines), DOF)
    scale = Scale.of(observation, M)
    return Problem(observation, inertia_of(M, DOF), scale, VISCOUS, "ml", EstimatorOptions())


@pytest.mark.parametrize("mass", [0.0, 0.3, 2.0])
def test_equations_without_noise_give_back_k_d_and_the_mass_of_fluid(mass: float) -> None:
    problem = problem_of(0.01, None, 60)
    lines = problem.lines()
    fluid = np.zeros_like(lines.force)
    fluid[0] = -(lines.omega**2) * mass * lines.dq[0]
    truth = join(K, D) / problem.units
    start = truth * np.linspace(0.7, 1.4, len(truth))
    parameters, found, left = with_fluid(start, replace(lines, force=lines.force + fluid))
    assert found == pytest.approx(mass, abs=1e-8)
    assert parameters == pytest.approx(truth, rel=1e-6, abs=1e-9)
    assert left < 1e-12


def test_a_side_valley_is_left_and_the_optimum_is_kept() -> None:
    problem = problem_of(0.3, 4, 30)
    lines = problem.lines()
    best = problem.solve()
    assert improve(problem, lines, best).objective <= best.objective
    aside = replace(best, parameters=1.3 * best.parameters, objective=best.objective + 50.0)
    again = improve(problem, lines, aside)
    assert again.objective == pytest.approx(best.objective, rel=1e-9)
    assert again.parameters == pytest.approx(best.parameters, rel=1e-4, abs=1e-6)


def test_what_it_returns_is_an_estimate_of_the_same_options() -> None:
    """Starts are tried without constraints; the answer keeps K and D where the options ask for it."""
    problem = problem_of(0.5, 1, 12)
    lines = problem.lines()
    current = problem.solve()
    better = improve(problem, lines, current)
    assert ml.estimate(lines, problem.options, better.parameters).objective <= better.objective * (1 + 1e-9)
    assert better.objective <= current.objective

"""The constrained estimator: one optimum from every start, stable, certified, within its bounds."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import constrained, pinv
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.semidefinite_roots import nearest_inside, smallest_eigenvalues
from legacy.fitting.estimators.stability import MARGIN, wall_height, wall_slopes
from legacy.fitting.model.model import modes
from legacy.fitting.model.parameter_vector import split
from legacy.fitting.model.scaled_lines import (
    Lines,
)
from tests.fitting.cases import DOF, K, M, paper_motion
from tests.fitting.estimators.test_estimators import OPTIONS, lines_of, weak_lines


def test_constrained_finds_one_optimum_from_every_start() -> None:
    lines, _ = lines_of(paper_motion(), M, DOF)
    rng = np.random.default_rng(1)
    best = constrained.estimate(lines, OPTIONS)
    for _ in range(6):
        start = nearest_inside(2.0 * rng.standard_normal(12), 3, 0.2)
        found = constrained.estimate(lines, OPTIONS, start)
        assert found.objective == pytest.approx(best.objective, rel=1e-9)
        assert np.allclose(found.parameters, best.parameters, atol=1e-7)


def test_constrained_finds_one_optimum_with_stability_active() -> None:
    seen = 0
    for seed in range(40):
        lines = weak_lines(seed)
        best = constrained.estimate(lines, OPTIONS)
        if "stability" not in best.active:
            continue
        seen += 1
        problem = constrained.reduce(lines, OPTIONS)
        assert constrained.largest_real(best.parameters, problem) == pytest.approx(-1e-6, abs=1e-6)
        rng = np.random.default_rng(seed)
        for _ in range(6):
            start = nearest_inside(2.0 * rng.standard_normal(12), 3, 0.2)
            found = constrained.estimate(lines, OPTIONS, start)
            assert found.objective == pytest.approx(best.objective, rel=1e-7)
            assert np.allclose(found.parameters, best.parameters, atol=1e-4)
        if seen == 2:
            return
    pytest.fail("no case with the stability constraint active")


def printed_damping_lines(noise: float, seed: int | None, dof: tuple[str, ...] = DOF) -> Lines:
    """Data of a truth that is unstable and not passive: the paper's M and K with D as printed."""
    from legacy.fitting.examples.paper import PAPER_DAMPING_PRINTED
    from sample_volumes.shaken_stapes import driven_base, simulated_motion

    freq = np.linspace(400.0, 5000.0, 60)
    rng = None if seed is None else np.random.default_rng(seed)
    places = [DOF.index(name) for name in dof]
    mass, stiffness, damping = (part[np.ix_(places, places)] for part in (M, K, PAPER_DAMPING_PRINTED))
    motion = simulated_motion(mass, stiffness, damping, dof, freq, driven_base(freq, dof), noise, rng)
    return lines_of(motion, mass, dof)[0]


@pytest.mark.parametrize(("noise", "seed", "dof"), [(1e-4, None, DOF), (0.05, 0, DOF), (0.05, 1, DOF[:2])])
def test_constrained_is_stable_even_where_the_truth_is_not(noise, seed, dof) -> None:
    lines = printed_damping_lines(noise, seed, dof)
    n = len(dof)
    free = pinv.weighted(lines, np.ones(n)).parameters
    assert not modes(lines.mass, *split(free, n)).stable
    convex = constrained.estimate(lines, EstimatorOptions(constraint="psd"))
    best = constrained.estimate(lines, OPTIONS)
    assert modes(lines.mass, *split(best.parameters, n)).max_real_1_s <= -MARGIN
    assert best.converged
    assert "stability" in best.active
    assert best.objective < convex.objective
    rng = np.random.default_rng(3)
    for _ in range(1 if n == 3 else 4):
        start = nearest_inside(2.0 * rng.standard_normal(n * (n + 1)), n, 0.2)
        found = constrained.estimate(lines, OPTIONS, start)
        assert found.objective == pytest.approx(best.objective, rel=1e-3)
        assert modes(lines.mass, *split(found.parameters, n)).max_real_1_s <= -MARGIN


def test_constrained_is_stable_within_bounds_too() -> None:
    lines = printed_damping_lines(0.05, 0)
    lower, upper = np.full(12, -np.inf), np.full(12, np.inf)
    lower[0], upper[6] = 2.5, 8.0
    found = constrained.estimate(lines, EstimatorOptions(lower=lower, upper=upper))
    assert np.all(found.parameters > lower)
    assert np.all(found.parameters < upper)
    assert modes(lines.mass, *split(found.parameters, 3)).max_real_1_s <= -MARGIN
    assert found.parameters[6] == pytest.approx(8.0, abs=0.05)


def test_wall_of_stability_has_the_slopes_it_says() -> None:
    problem = constrained.reduce(printed_damping_lines(0.05, 0), OPTIONS)
    at = nearest_inside(np.random.default_rng(5).standard_normal(12), 3, 0.2)
    at = np.maximum(at, np.where(np.isfinite(problem.lower), 0.05, -np.inf))
    gradient, hessian = wall_slopes(at, problem)
    for place in range(12):
        step = np.zeros(12)
        step[place] = 1e-5
        rise = wall_height(at + step, problem) - wall_height(at - step, problem)
        assert rise / 2e-5 == pytest.approx(gradient[place], rel=1e-4, abs=1e-4)
        slope = (wall_slopes(at + step, problem)[0] - wall_slopes(at - step, problem)[0]) / 2e-5
        assert np.allclose(slope, hessian[place], rtol=1e-3, atol=1e-3 * np.abs(hessian).max())


def test_psd_constraint_is_certified() -> None:
    """The certificate bounds the distance to the optimum, and the multipliers fulfil the conditions."""
    seen = 0
    for seed in range(20):
        lines = weak_lines(seed)
        found = constrained.estimate(lines, EstimatorOptions(constraint="psd"))
        assert found.certificate is not None
        assert found.certificate < 1e-8
        assert min(smallest_eigenvalues(found.parameters, 3)) > 0.0
        if not found.active:
            continue
        seen += 1
        problem = constrained.reduce(lines, OPTIONS)
        _, gradient, _ = problem.expansion(found.parameters)
        for part, matrix in zip(split(gradient, 3), split(found.parameters, 3), strict=True):
            multiplier = 0.5 * (part + np.diag(np.diag(part)))
            assert np.linalg.eigvalsh(multiplier)[0] > -1e-6
            assert abs(np.sum(multiplier * matrix)) < 1e-6
    assert seen > 0


def test_bounds_hold_and_are_named() -> None:
    lines, units = lines_of(paper_motion(), M, DOF)
    lower = np.full(12, -np.inf)
    lower[0] = 1800.0 / units[0]
    for constraint in ("eigenvalues", "psd"):
        found = constrained.estimate(lines, EstimatorOptions(constraint=constraint, lower=lower))
        assert found.parameters[0] * units[0] == pytest.approx(1800.0, rel=1e-5)
        if constraint == "eigenvalues":
            assert found.active == ("K11_lower",)


def test_impossible_bounds_are_refused() -> None:
    lines, units = lines_of(paper_motion(), M, DOF)
    lower, upper = np.full(12, -np.inf), np.full(12, np.inf)
    lower[1], upper[0], upper[3] = 10.0 / units[1], 1000.0 / units[0], 1e-3 / units[3]
    with pytest.raises(FittingError, match="the bounds must be wide enough"):
        constrained.estimate(lines, EstimatorOptions(constraint="psd", lower=lower, upper=upper))

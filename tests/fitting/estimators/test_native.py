"""The compiled expansion against its twin in numpy, and fits with and without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting import native
from legacy.fitting.estimators import irls, ml
from legacy.fitting.estimators.base import EstimatorOptions, gram, transposed_times
from legacy.fitting.estimators.likelihood_kernel import CORRECTED, DISTANCES, EQUAL, MEASURED, expanded
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.observation import observe
from legacy.fitting.model.scaled_lines import Lines, Scale, cholesky, evaluate, forward, real_rows, regressor
from tests.fitting.cases import DOF, M, paper_motion

OPTIONS = EstimatorOptions()


def some_lines(n: int, count: int, seed: int = 0) -> tuple[Lines, np.ndarray]:
    """Lines of any size with full Hermitian covariances, and parameters near one."""
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    root = draw(2 * n, 2 * n, count)
    whole = np.einsum("ikl,jkl->ijl", root, root.conj()) + 4.0 * np.eye(2 * n)[:, :, None]
    omega = np.linspace(0.5, 2.0, count)
    lines = Lines(
        omega,
        VISCOUS.factor(omega),
        draw(n, count),
        draw(n, count),
        np.ascontiguousarray(whole[:n]),
        np.ascontiguousarray(whole[n:, n:]),
        np.eye(n),
        np.ones(n),
    )
    return lines, rng.standard_normal(n * (n + 1))


def close(one: np.ndarray, other: np.ndarray, tolerance: float = 1e-12) -> None:
    assert np.max(np.abs(one - other)) <= tolerance * np.max(np.abs(other))


def test_the_kernels_were_built():
    assert native.compiled() is not None, "the kernels were not built: python hatch_build.py"


@pytest.mark.parametrize("n", range(1, 7))
@pytest.mark.parametrize("count", [1, 7, 8, 41])
def test_expansion_is_its_twin(n, count):
    lines, parameters = some_lines(n, count)
    now = ml.whiten(parameters, lines)
    rows, residual = real_rows(now.corrected(lines)), real_rows(now.residual)
    found = expanded(parameters, lines, CORRECTED)
    close(found.distance, now.distance)
    close(found.hessian, gram(rows))
    close(found.gradient, transposed_times(rows, residual))
    close(expanded(parameters, lines, DISTANCES).distance, now.distance)
    weights = (4.0 + 2 * n) / (4.0 * 1.7 + 2.0 * now.distance)
    root = np.sqrt(np.tile(np.tile(weights, n), 2))
    robust = expanded(parameters, lines, CORRECTED, 4.0 * 1.7)
    close(robust.hessian, gram(rows * root[:, None]))
    close(robust.gradient, transposed_times(rows * root[:, None], residual * root))


@pytest.mark.parametrize("n", [1, 3, 5])
def test_the_start_is_its_twin(n):
    lines, parameters = some_lines(n, 23)
    fixed = regressor(lines.dq, lines.factor)
    plain = expanded(np.zeros_like(parameters), lines, EQUAL)
    close(plain.hessian, gram(real_rows(fixed)))
    close(plain.gradient, -transposed_times(real_rows(fixed), real_rows(lines.force)))
    state = evaluate(parameters, lines)
    rows = real_rows(forward(cholesky(state.noise), fixed))
    measured = expanded(parameters, lines, MEASURED)
    close(measured.hessian, gram(rows))
    close(measured.gradient, rows.T @ real_rows(forward(cholesky(state.noise), state.residual)))


def test_noise_that_is_not_positive_definite_is_infinitely_far():
    lines, parameters = some_lines(3, 9)
    broken = lines.sff.copy()
    broken[:, :, 4] = -1e6 * np.eye(3)
    lines = replace(lines, sff=broken)
    distance = expanded(parameters, lines, DISTANCES).distance
    assert np.isinf(distance[4])
    with np.errstate(all="ignore"):
        assert np.array_equal(np.isinf(distance), np.isinf(ml.whiten(parameters, lines).distance))


def test_selected_lines_need_not_lie_in_a_row():
    lines, parameters = some_lines(3, 30)
    part = lines.select(np.arange(0, 30, 2))
    close(expanded(parameters, part, DISTANCES).distance, ml.whiten(parameters, lines).distance[::2])


def test_fits_are_the_same_without_the_kernels(monkeypatch):
    observation = observe(paper_motion(0.05, 3), DOF)
    problem = Problem(observation, inertia_of(M, DOF), Scale.of(observation, M), VISCOUS, "ml", OPTIONS)
    lines = problem.lines()

    def fits() -> list[np.ndarray]:
        robust = EstimatorOptions(robust="t4")
        start = irls.quick_start(lines)
        return [start, *(ml.estimate(lines, one).parameters for one in (OPTIONS, robust))]

    compiled = fits()
    monkeypatch.setattr("legacy.fitting.estimators.likelihood_kernel.compiled", lambda: None)
    for one, other in zip(compiled, fits(), strict=True):
        close(one, other, 1e-9)

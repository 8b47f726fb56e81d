"""Intervals where the noise of the motion is large: coverage by Monte Carlo, and the trace by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.regressor_noise import information, regressor_noise
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import KDOptions
from legacy.stapeskit.records.motion import RigidMotion
from tests.fitting.cases import DOF, D, K, M, paper_motion


def noisy(share: float, seed: int, lines: int = 200) -> RigidMotion:
    """Equal noise at every line, a share of the piston motion of the stapes; the base has half of it."""
    exact = paper_motion(0.01, None, lines)
    level = share * np.sqrt(np.mean(np.abs(exact.q[0, 0, :, 0]) ** 2)) * np.array([1.0, 1e3, 1e3])
    covariance = np.zeros_like(exact.covariance)
    for body, part in ((0, 1.0), (1, 0.5)):
        covariance[0, body] = np.diag((level * part) ** 2 * 2.0)
    draws = np.random.default_rng(seed).standard_normal((2, *exact.q.shape))
    spread = np.stack([level, 0.5 * level])[None, :, None, :]
    return replace(exact, q=exact.q + spread * (draws[0] + 1j * draws[1]), covariance=covariance)


def test_the_noise_of_the_motion_is_what_the_hessian_has_too_much() -> None:
    """The mean Hessian at the truth is that of the exact motion plus the trace."""
    problem = fit_kd(noisy(0.05, 0), M, KDOptions(inplane="ignore", bands=0, profile=False)).problem
    truth = join(K, D) / problem.units
    exact = replace(problem, observation=_observed(problem, paper_motion(0.01, None))).lines()
    bare, _ = ml.normal_equations(truth, exact)
    found = []
    for seed in range(150):
        lines = replace(problem, observation=_observed(problem, noisy(0.05, seed))).lines()
        found.append(ml.normal_equations(truth, lines)[0])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    added = regressor_noise(truth, lines)
    assert np.all(np.abs(mean - bare - added) < 5.0 * error + 1e-9 * np.max(mean))
    assert np.max(np.diag(added) / np.diag(bare)) > 0.1


def _observed(problem, motion):
    from legacy.fitting.model.observation import observe

    kept = problem.observation
    made = observe(motion, DOF, with_load=False)
    return replace(made, covariance=kept.covariance)


@pytest.mark.parametrize(("share", "lines", "count"), [(0.05, 200, 50), (0.1, 30, 25)])
def test_intervals_hold_where_noise_is_large(share, lines, count) -> None:
    held = []
    for seed in range(count):
        fit = fit_kd(noisy(share, seed, lines), M, KDOptions(inplane="ignore", bands=0))
        inside = (fit.intervals[:, 0] <= join(K, D)) & (join(K, D) <= fit.intervals[:, 1])
        held.append(inside)
    assert np.mean(held) == pytest.approx(0.95, abs=0.035)


def test_exact_data_keep_all_information_and_gain_the_spread() -> None:
    hessian, noise = np.diag([2.0, 3.0]), np.diag([0.5, 0.0])
    known, spread = information(hessian, noise, 0.0)
    assert known == pytest.approx(hessian)
    assert spread == pytest.approx(hessian + noise)
    known, spread = information(hessian, noise, 3.0)
    assert known == pytest.approx(hessian - 3.0 * noise)
    assert spread == pytest.approx(hessian)
    known, _ = information(hessian, np.diag([2.5, 0.0]), 1.0)
    assert known == pytest.approx(np.diag([0.1, 3.0]))

"""chi2 that knows the shared errors: no false alarm where they alone make the residuals, and none missed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.options import KDOptions
from legacy.fitting.uncertainty.shared_misfit import chi2_with_shared_errors
from legacy.stapeskit.records.motion import SharedErrors
from tests.fitting.cases import M, paper_motion


def shifted(sd: float, stated: float, seed: int):
    """Motion at 0.2 % noise whose alpha is read through a wrong gain, sd of which is stated."""
    motion = paper_motion(0.002, seed, 80)
    slope = np.zeros((1, *motion.q.shape), dtype=complex)
    slope[0, :, 0, :, 1] = motion.q[:, 0, :, 1]
    wrong = motion.q + sd * np.random.default_rng(seed).standard_normal() * slope[0]
    shared = SharedErrors(("gain.alpha",), np.array([[stated**2]]), slope)
    return replace(motion, q=wrong, shared=shared)


def codes(fit) -> set[str]:
    return {notice.code for notice in fit.notices}


def test_shared_errors_alone_are_no_misfit() -> None:
    fits = [fit_kd(shifted(0.02, 0.02, seed), M, KDOptions(bands=0)) for seed in range(20)]
    assert not any("misfit" in codes(fit) for fit in fits)
    plain = [fit.chi2 / fit.n_dof for fit in fits]
    joint = [fit.joint_chi2 / fit.n_dof for fit in fits]
    assert np.median(plain) > 1.2
    assert np.mean(joint) == pytest.approx(1.0, abs=0.05)


def test_an_error_far_beyond_what_is_stated_is_a_misfit() -> None:
    fits = [fit_kd(shifted(0.2, 0.002, seed), M, KDOptions(bands=0)) for seed in range(5)]
    assert sum("misfit" in codes(fit) for fit in fits) >= 4


@pytest.mark.parametrize("estimator", ["ml", "pinv"])
def test_without_shared_errors_it_is_chi2(estimator: str) -> None:
    fit = fit_kd(paper_motion(0.01, 3, 60), M, KDOptions(bands=0, estimator=estimator))
    again = chi2_with_shared_errors(fit.problem, fit.lines, fit.estimate.parameters)
    assert again == pytest.approx(fit.chi2, rel=1e-9)

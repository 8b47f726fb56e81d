"""The number of independent parameters, and many tests at once."""

import numpy as np
import pytest

from legacy.pipeline.cohort.false_discovery import false_discovery
from legacy.pipeline.cohort.independent_parameters import independent_parameters


@pytest.mark.parametrize("n", [16, 40])
def test_planted_components_are_counted(n):
    """30 cohorts: a share of 95 % gives 26 or more in 99 of 100 such tests."""
    rng = np.random.default_rng(n)
    counts, covered = [], 0
    for seed in range(30):
        axes, _ = np.linalg.qr(rng.standard_normal((6, 2)))
        values = rng.standard_normal((n, 2)) @ (axes * [0.6, 0.3]).T + 0.08 * rng.standard_normal((n, 6))
        found = independent_parameters(values, np.tile(0.08**2 * np.eye(6), (n, 1, 1)), seed=seed)
        counts.append(found.estimate)
        covered += found.interval[0] <= 2 <= found.interval[1]
    assert counts.count(2) >= 26
    assert covered >= 26


def test_errors_alone_are_no_component():
    rng = np.random.default_rng(1)
    own = np.tile(0.1**2 * np.eye(5), (20, 1, 1))
    counts = [
        independent_parameters(0.1 * rng.standard_normal((20, 5)), own, seed=k).estimate for k in range(30)
    ]
    assert counts.count(0) >= 26


def test_q_values_are_those_of_benjamini_and_hochberg():
    p = np.array([0.01, 0.04, 0.03, np.nan, 0.005])
    assert false_discovery(p) == pytest.approx([0.02, 0.04, 0.04, np.nan, 0.02], nan_ok=True)
    assert false_discovery(np.array([])).size == 0

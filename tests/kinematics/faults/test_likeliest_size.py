"""The likeliest common size of errors, by the closed form of one of them and by simulated ones."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.faults.nuisance import likeliest_size

SIZES = np.geomspace(1e-4, 1.0, 4001)


@pytest.mark.parametrize(("score", "information"), [(30.0, 100.0), (300.0, 2000.0), (8.0, 100.0)])
def test_size_of_one_error_is_that_of_the_closed_form(score, information):
    variance = (2.0 * score**2 / information - 1.0) / (2.0 * information)
    size, gain = likeliest_size(np.array([score]), np.array([[information]]), SIZES)
    assert size == pytest.approx(np.sqrt(variance), rel=0.003)
    whole = 1.0 + 2.0 * variance * information
    assert gain == pytest.approx(score**2 * 2.0 * variance / whole - 0.5 * np.log(whole), rel=1e-4)


def test_no_error_gains_nothing():
    size, gain = likeliest_size(np.zeros(3), np.diag([1.0, 10.0, 100.0]), SIZES)
    assert size == SIZES[0]
    assert gain == pytest.approx(0.0, abs=1e-5)


def test_correlated_errors_have_their_size():
    rng = np.random.default_rng(2)
    sizes = []
    for _ in range(40):
        root = rng.normal(size=(30, 30))
        information = 1e4 * (root @ root.T + 0.1 * np.eye(30))
        errors = 0.03 * rng.normal(size=30)
        noise = np.linalg.cholesky(0.5 * information) @ rng.normal(size=30)
        sizes.append(likeliest_size(information @ errors + noise, information, SIZES)[0])
    assert np.mean(sizes) == pytest.approx(0.03, rel=0.06)

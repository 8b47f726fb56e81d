"""Minimisation at many points at once: closed forms of quadratic and quartic functions."""

import numpy as np
import pytest

from legacy.pipeline.cohort.minimise import minimise

H = np.array([[4.0, 1.0], [1.0, 3.0]])
CENTRE = np.array([0.3, -0.7])
WIDE = np.full(2, 10.0)


def quadratic(points):
    away = points - CENTRE
    return 0.5 * np.einsum("gi,ij,gj->g", away, H, away) + 2.0


def test_a_quadratic_has_its_minimum_and_curvature():
    best = minimise(quadratic, np.array([[5.0, 5.0]]), np.ones(2), -WIDE, WIDE)
    assert best.point == pytest.approx(CENTRE, abs=1e-6)
    assert best.value == pytest.approx(2.0, abs=1e-10)
    assert best.curvature == pytest.approx(H, rel=1e-4)


def test_a_bound_holds_the_minimum():
    best = minimise(quadratic, np.array([[2.0, 2.0]]), np.ones(2), np.array([1.0, -10.0]), WIDE)
    assert best.point[0] == pytest.approx(1.0)
    assert best.point[1] == pytest.approx(CENTRE[1] - H[0, 1] / H[1, 1] * (1.0 - CENTRE[0]), abs=1e-5)


def test_the_lower_of_two_minima_is_returned():
    def two(points):
        x = points[:, 0]
        return (x**2 - 1.0) ** 2 + 0.1 * x

    best = minimise(two, np.array([[0.9], [-0.9]]), np.ones(1), np.array([-3.0]), np.array([3.0]))
    root = np.roots([4.0, 0.0, -4.0, 0.1]).real.min()
    assert best.point[0] == pytest.approx(root, abs=1e-6)

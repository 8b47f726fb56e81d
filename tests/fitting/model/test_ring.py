"""The ring test against closed forms of a circle and a rectangle, and against springs on the rim."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ring_ears import PISTON, ring
from fitting.examples.paper import PAPER_STIFFNESS
from fitting.examples.paper_page import FOOTPLATE_MM
from fitting.model.ring import ellipse_mm, ring_stiffness, ring_test


def test_a_circle_has_half_the_polar_moment_and_converges_with_the_square_of_the_step() -> None:
    exact = np.diag([2.0 * np.pi, np.pi, np.pi])
    errors = [np.abs(ring_stiffness(ellipse_mm(2.0, 2.0, n))[0] - exact).max() for n in (50, 100)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_a_rectangle_is_exact_wherever_it_lies() -> None:
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0]])
    stiffness, length = ring_stiffness(corners)
    assert length == 8.0
    about_z = 2.0 * 3.0**3 / 3.0 + 1.0 * 3.0**2
    assert stiffness[2, 2] == pytest.approx(about_z, rel=1e-14)
    assert stiffness[0, 1] == pytest.approx(-0.5 * 8.0, rel=1e-14)
    assert stiffness[0, 2] == pytest.approx(1.5 * 8.0, rel=1e-14)


def test_it_is_a_ring_of_normal_springs_and_gives_back_its_stiffness_per_length() -> None:
    springs = ring(0.0, 0.0, 2.0e5, np.zeros(3), np.zeros(3))[np.ix_(PISTON, PISTON)]
    test = ring_test(springs, springs[0, 0] * (1.0 + 0.3j), ellipse_mm(2.8, 1.3))
    assert test is not None
    assert test.shear_pa == pytest.approx(2.0e5, rel=2e-3)
    assert test.rocking_ratio == pytest.approx((1.0, 1.0), abs=2e-3)
    assert test.loss_factor == pytest.approx(0.3)


def test_the_paper_s_rocking_stiffness_exceeds_that_of_a_uniform_ring() -> None:
    test = ring_test(PAPER_STIFFNESS, complex(PAPER_STIFFNESS[0, 0]), ellipse_mm(*FOOTPLATE_MM))
    assert test is not None
    print(test.rocking_ratio)
    assert 2.0 < min(test.rocking_ratio) < max(test.rocking_ratio) < 3.5


def test_without_an_outline_there_is_none() -> None:
    assert ring_test(PAPER_STIFFNESS, 1.0 + 0j, None) is None

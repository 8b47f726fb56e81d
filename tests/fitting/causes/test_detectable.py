"""From which size on an error is seen, and by how much an error of its place hides it."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.causes.detectable import POWER_80, detectable_size


def test_without_nuisances_it_is_the_minimal_detectable_bias() -> None:
    assert detectable_size(0.2, 3.0) == pytest.approx(0.2 * (3.0 + POWER_80))


def test_nuisances_that_look_unlike_hide_nothing() -> None:
    information = np.diag([25.0, 7.0, 3.0])
    assert detectable_size(0.2, 3.0, information) == pytest.approx(detectable_size(0.2, 3.0), rel=1e-6)


def test_a_cause_is_found_where_chi2_rises_over_all_errors_of_its_place() -> None:
    """The rise of chi2, minimised over the nuisances by brute force, is the squared threshold."""
    root = np.array([[5.0, 0.0], [0.5, 0.2]])
    information = root @ root.T
    size = detectable_size(float(1.0 / np.sqrt(information[0, 0])), 3.0, information)
    place = np.linspace(-60.0, 60.0, 240_001)
    both = np.stack([np.ones_like(place), place])
    rise = size**2 * np.einsum("ip,ij,jp->p", both, information, both) + place**2
    assert rise.min() == pytest.approx((3.0 + POWER_80) ** 2, rel=1e-3)


def test_what_its_place_can_hide_wholly_is_never_found() -> None:
    information = np.array([[25.0, 50.0], [50.0, 100.0]])
    assert detectable_size(0.2, 3.0, information) == float("inf")


def test_nuisances_that_are_one_are_no_singular_matrix():
    nuisances = np.ones((3, 3))
    information = (
        np.block([[np.ones((1, 1)), np.full((1, 3), 0.5)], [np.full((3, 1), 0.5), nuisances]]) * 1e30
    )
    size = detectable_size(1e-15, 3.0, information)
    assert np.isfinite(size)
    assert size > detectable_size(1e-15, 3.0)


def test_a_hidden_cause_is_never_seen():
    assert detectable_size(1.0, 3.0, np.ones((2, 2))) == np.inf

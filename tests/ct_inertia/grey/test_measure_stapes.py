"""The measurement of a cut: volume, centre and second moments of a blurred ball in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.air_level import Guess
from legacy.ct_inertia.grey.measure_stapes import measure_stapes
from tests.ct_inertia.balls import AIR, BONE, ball, cut_of, places, volume_of
from tests.oracles import ellipsoid_moments

RADIUS, SPACING, SIGMA = 0.5, 0.04, 0.048
CENTRE = np.array([0.011, -0.007, 0.019])


def measured(noise=0.0, seed=1):
    x, y, z = places((40, 40, 40), SPACING)
    share = ball(np.sqrt((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2 + (z - CENTRE[2]) ** 2), RADIUS, SIGMA)
    volume = volume_of(share, SPACING, noise, seed)
    shown = (volume.array - AIR) / (BONE - AIR)
    return measure_stapes(volume, cut_of(shown, share > 0.5), Guess(AIR, BONE))


def test_a_ball_has_the_moments_of_its_closed_form():
    moments = measured(noise=30.0).moments
    truth = ellipsoid_moments(np.full(3, RADIUS))
    middle = 0.5 * 39 * SPACING + CENTRE
    assert moments.volume_mm3 == pytest.approx(truth.volume, rel=5e-4)
    assert np.allclose(moments.centroid_mm, middle, atol=3e-4)
    assert np.allclose(moments.second_mm5, truth.second, atol=2e-3 * truth.second[0, 0])


def test_blur_and_levels_are_those_of_the_scan():
    found = measured(noise=30.0)
    assert found.levels.air == pytest.approx(AIR, abs=5.0)
    assert found.levels.bone == pytest.approx(BONE, abs=20.0)
    assert found.sigma_mm == pytest.approx(SIGMA, rel=0.03)


def test_errors_of_the_volume_stay_within_what_is_stated():
    truth = ellipsoid_moments(np.full(3, RADIUS)).volume
    scores = []
    for seed in range(4):
        moments = measured(noise=400.0, seed=seed).moments
        sd = np.sqrt(sum(part[0, 0] for part in moments.contributions.values()))
        scores.append((moments.volume_mm3 - truth) / sd)
    assert np.max(np.abs(scores)) < 3.0
    assert np.std(scores) > 0.05


def test_grey_values_that_sum_to_nothing_are_refused():
    share = np.zeros((20, 20, 20))
    stapes = np.zeros(share.shape, dtype=bool)
    stapes[8:12, 8:12, 8:12] = True
    volume = volume_of(share, SPACING, 50.0)
    shown = (volume.array - AIR) / (BONE - AIR)
    with pytest.raises(CtInertiaError):
        measure_stapes(volume, cut_of(shown, stapes), Guess(AIR, BONE))

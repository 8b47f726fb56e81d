"""Grey values that change across a body: what a known slope does to the moments, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.bone_level import Bone
from legacy.ct_inertia.grey.partial_volume import Share, partial_volume_moments
from legacy.ct_inertia.grey.shading import air_slope_covariance, as_shares, slope_effect, unweighted_centre
from tests.ct_inertia.balls import AIR, BONE, ball, cut_of, places, volume_of
from tests.oracles import ellipsoid_moments

RADIUS, SPACING, SIGMA = 0.4, 0.04, 0.04
# Grey values of bone rise by so much of the contrast per mm along x.
SLOPE = 0.05


def shaded():
    x, y, z = places((32, 32, 32), SPACING)
    bare = ball(np.sqrt(x * x + y * y + z * z), RADIUS, SIGMA)
    return x, bare, volume_of(bare * (1.0 + SLOPE * x), SPACING)


def share_of(volume, bone=BONE):
    index = np.argwhere(np.ones(volume.array.shape, dtype=bool))[:, ::-1].astype(float)
    grey = volume.array.ravel().astype(float)
    return Share(index, grey, np.zeros(len(grey)), AIR, bone, 1.0, 1.0, SIGMA, 0.0)


def test_the_centre_without_the_weight_of_a_slope_is_the_middle():
    _, bare, volume = shaded()
    moments = partial_volume_moments(share_of(volume), volume.scan_from_index)
    middle = 0.5 * 31 * SPACING
    ball_moments = ellipsoid_moments(np.full(3, RADIUS))
    blurred = ball_moments.second[0, 0] / ball_moments.volume + SIGMA**2
    assert moments.centroid_mm[0] - middle == pytest.approx(SLOPE * blurred, rel=1e-4)
    bone = Bone(BONE, 1.0, 1.0, "test", slope=np.array([SLOPE * (BONE - AIR), 0.0, 0.0]))
    centre = unweighted_centre(moments, bone, AIR, volume, cut_of(bare, bare > 0.5))
    assert np.allclose(centre, middle, atol=2e-4)


def test_the_step_of_a_slope_moves_the_centre_as_the_slope_does():
    _, _, volume = shaded()
    share = share_of(volume)
    moments = partial_volume_moments(share, volume.scan_from_index)
    bone = Bone(BONE, 1.0, 1.0, "test", slope=np.array([SLOPE * (BONE - AIR), 0.0, 0.0]))
    step = slope_effect(share, bone, volume, moments)
    middle = 0.5 * 31 * SPACING
    assert step[0] == pytest.approx(0.0, abs=1e-6)
    assert step[1] == pytest.approx(moments.centroid_mm[0] - middle, rel=0.02)
    assert np.allclose(step[2:4], 0.0, atol=1e-6)
    volume_share, distance_mm, _ = as_shares(step, moments)
    assert volume_share < 1e-6
    assert distance_mm == pytest.approx(np.linalg.norm(step[1:4]))


def test_air_that_slopes_adds_the_covariance_of_that_slope():
    _, _, volume = shaded()
    share = share_of(volume)
    moments = partial_volume_moments(share, volume.scan_from_index)
    flat = air_slope_covariance(share, Air(AIR, 1.0, 1.0, 1.0, 0.0), volume, moments)
    sloped = air_slope_covariance(
        share, Air(AIR, 1.0, 1.0, 1.0, 0.0, slope=(20.0, 0.0, 0.0)), volume, moments
    )
    assert np.all(flat == 0.0)
    assert np.linalg.matrix_rank(sloped, tol=1e-12 * np.abs(sloped).max()) == 1
    assert sloped[1, 1] > 0.0
    half = air_slope_covariance(share, Air(AIR, 1.0, 1.0, 1.0, 0.0, slope=(10.0, 0.0, 0.0)), volume, moments)
    assert np.allclose(sloped, 4.0 * half)

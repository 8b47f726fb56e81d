"""Rigid motion between paired points: recovered exactly, never a reflection, with its covariance."""

import numpy as np
import pytest

from legacy.stapeskit.alignment.paired_points import kabsch, pair_weights, pose_covariance, refined
from legacy.stapeskit.frames import rotation_from_vector

POINTS = np.random.default_rng(0).normal(size=(7, 3))
ROTATION, SHIFT = rotation_from_vector([0.4, -1.1, 0.7]), np.array([3.0, -2.0, 0.5])


def test_a_motion_is_recovered_whatever_the_weights():
    weights = np.random.default_rng(1).uniform(0.1, 3.0, 7)
    rotation, shift, mirrored = kabsch(POINTS, POINTS @ ROTATION.T + SHIFT, weights)
    assert np.allclose(rotation, ROTATION, atol=1e-12)
    assert np.allclose(shift, SHIFT, atol=1e-12)
    assert not mirrored


def test_a_mirror_image_gives_a_rotation_and_is_reported():
    rotation, _, mirrored = kabsch(POINTS, POINTS * [1.0, 1.0, -1.0], np.ones(7))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert mirrored


def test_equal_variances_change_nothing():
    target = POINTS @ ROTATION.T + SHIFT + 0.05 * np.random.default_rng(2).normal(size=(7, 3))
    first = kabsch(POINTS, target, np.ones(7))[:2]
    var = np.full((7, 3), 0.01)
    again = refined(POINTS, target, *first, var, 2.0 * var)
    assert np.allclose(again[0], first[0], atol=1e-9)
    assert np.allclose(again[1], first[1], atol=1e-9)


def test_the_covariance_at_the_centroid_is_that_of_a_mean():
    centred = POINTS - POINTS.mean(axis=0)
    weights = pair_weights(np.eye(3), np.full((7, 3), 0.04), np.zeros((7, 3)))
    covariance = pose_covariance(centred, weights)
    assert np.allclose(covariance[:3, :3], np.eye(3) * 0.04e-6 / 7)
    moments = (centred * 1e-3).T @ (centred * 1e-3)
    assert np.allclose(covariance[3:, 3:], 0.04e-6 * np.linalg.inv(np.trace(moments) * np.eye(3) - moments))
    assert np.allclose(covariance[:3, 3:], 0.0, atol=1e-18)

"""Moments: closed forms of a ball, the parallel axis theorem, and covariances against simulation."""

import numpy as np
import pytest

from ct_inertia.bodies import Moments
from ct_inertia.grey.moments import (
    blur_covariance,
    by_octants,
    common,
    effect,
    integrals,
    noise_covariance,
    partial_volume_moments,
    voxel_moments,
)
from stapeskit.faults import StapeskitError
from tests.bodies.body_scenes import Ball

TURNED = np.array(
    [[0.02, 0.003, 0.0, 1.0], [-0.003, 0.02, 0.0, 2.0], [0.0, 0.0, 0.03, -1.0], [0.0, 0.0, 0.0, 1.0]]
)


def test_moments_of_a_blurred_ball_are_those_of_the_ball():
    ball = Ball(blur=1.3)
    moments = partial_volume_moments(
        ball.share().astype(np.float32), np.diag([*ball.spacing, 1.0]), ball.sigma**2 * np.eye(3)
    )
    second = ball.volume * ball.radius**2 / 5.0
    assert moments.volume_mm3 == pytest.approx(ball.volume, rel=2e-5)
    assert moments.centroid_mm == pytest.approx(ball.centre, abs=1e-5)
    assert moments.second_mm5 == pytest.approx(second * np.eye(3), abs=3e-4 * second)


def test_integrals_are_sums_over_voxels():
    amount = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)
    index = np.argwhere(np.ones(amount.shape, dtype=bool))[:, ::-1]
    away = index @ TURNED[:3, :3].T + TURNED[:3, 3] - [1.0, 2.0, -0.9]
    weight = amount.ravel().astype(float) * abs(np.linalg.det(TURNED[:3, :3]))
    products = np.einsum("n,ni,nj->ij", weight, away, away)
    expected = [weight.sum(), *(weight @ away), *products[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]]
    assert integrals(amount, TURNED, np.array([1.0, 2.0, -0.9])) == pytest.approx(
        expected, rel=1e-5, abs=1e-12
    )


def test_bricks_have_moments_of_their_own():
    mask = np.zeros((9, 9, 9), dtype=bool)
    mask[2:6, 3:5, 1:8] = True
    moments = voxel_moments(mask, np.diag([0.1, 0.2, 0.3, 1.0]))
    sides = np.array([7 * 0.1, 2 * 0.2, 4 * 0.3])
    assert moments.volume_mm3 == pytest.approx(np.prod(sides))
    assert moments.second_mm5 == pytest.approx(np.diag(np.prod(sides) * sides**2 / 12.0), rel=1e-6, abs=1e-9)


def example():
    second = np.array([[0.3, 0.05, -0.02], [0.05, 0.5, 0.04], [-0.02, 0.04, 0.2]])
    root = np.random.default_rng(3).normal(size=(10, 10)) * 1e-3
    return Moments(1.7, np.array([0.4, -0.3, 0.8]), second, {"noise": root @ root.T})


def test_volume_parameters_follow_the_parallel_axis_theorem():
    moments, about = example(), np.array([0.1, 0.2, -0.5])
    values, _ = moments.volume_parameters(about)
    arm, volume = (moments.centroid_mm - about) * 1e-3, moments.volume_m3
    tensor = 1e-15 * moments.inertia_mm5 + volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    assert values[1:4] == pytest.approx(volume * arm, rel=1e-9, abs=0.0)
    products = [tensor[0, 1], tensor[1, 2], tensor[0, 2]]
    assert values[4:] == pytest.approx([*np.diag(tensor), *products], rel=1e-9, abs=0.0)


def test_covariance_of_volume_parameters_is_that_of_small_changes():
    moments, about = example(), np.array([0.1, 0.2, -0.5])
    values, covariances = moments.volume_parameters(about)
    vector, steps = moments.vector(), []
    for k in range(10):
        moved = vector.copy()
        moved[k] += 1e-6
        second = np.zeros((3, 3))
        second[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]] = moved[4:]
        second = second + second.T - np.diag(np.diag(second))
        steps.append((Moments(moved[0], moved[1:4], second).volume_parameters(about)[0] - values) / 1e-6)
    jacobian = np.array(steps).T
    expected = jacobian @ moments.contributions["noise"] @ jacobian.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.all(np.abs(covariances["noise"] - expected) < 1e-4 * scale)


def test_noise_covariance_is_that_of_simulated_noise():
    ball = Ball(radius=0.2, voxel=0.03)
    share, transform = ball.share().astype(np.float32), np.diag([*ball.spacing, 1.0])
    own, spread = share > 1e-3, ball.sigma**2 * np.eye(3)
    clean = partial_volume_moments(np.where(own, share, 0), transform, spread)
    rng = np.random.default_rng(5)
    noisy = []
    for _ in range(200):
        some = share + 0.05 * rng.standard_normal(share.shape).astype(np.float32)
        noisy.append(partial_volume_moments(np.where(own, some, 0), transform, spread).vector())
    ratio = np.std(noisy, axis=0) / np.sqrt(
        np.diag(noise_covariance(0.05, own, transform, clean, ball.sigma))
    )
    assert np.all(np.abs(ratio - 1.0) < 0.25), ratio  # 5 deviations of 200 draws


def test_octants_share_what_is_common():
    ball = Ball()
    share, transform = ball.share().astype(np.float32), np.diag([*ball.spacing, 1.0])
    moments = partial_volume_moments(share, transform, ball.sigma**2 * np.eye(3))
    whole, parts = common(share, transform, moments), by_octants(share, transform, moments)
    assert np.sqrt(whole[0, 0]) == pytest.approx(ball.volume, rel=1e-4)
    assert parts[0, 0] == pytest.approx(whole[0, 0] / 8.0, rel=0.15)
    assert effect(share, transform, moments)[1:4] == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("volume", [0.0, -1.0])
def test_a_body_without_volume_is_refused(volume):
    with pytest.raises(StapeskitError) as error:
        Moments(volume, np.zeros(3), np.eye(3))
    assert error.value.faults[0].thing == "the measured body"


def test_an_uncertain_blur_is_as_uncertain_along_every_direction():
    """V (sigma (1 + e))^2 has the standard deviation 2 V sigma^2 sd(e) along any line."""
    body = Moments(1.7, np.zeros(3), np.eye(3))
    covariance = blur_covariance(body, 0.02, 0.05)
    for direction in np.random.default_rng(5).standard_normal((20, 3)):
        u, v, w = direction / np.linalg.norm(direction)
        along = np.array([0, 0, 0, 0, u * u, v * v, w * w, 2 * u * v, 2 * v * w, 2 * u * w])
        assert np.sqrt(along @ covariance @ along) == pytest.approx(2.0 * 1.7 * 0.02**2 * 0.05)

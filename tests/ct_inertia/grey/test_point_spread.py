"""Correcting the point spread keeps the integral, and inverts the operators that it is the inverse of."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.grey.point_spread import equalise_blur, retrieve_phase

SPACING = np.array([0.02, 0.03, 0.04])


def moments(grey):
    """Sum, and covariance along x, y, z in mm2, of grey values."""
    place = np.indices(grey.shape).reshape(3, -1)[::-1] * SPACING[:, None]
    weight = grey.ravel().astype(float)
    away = place - (place @ weight / weight.sum())[:, None]
    return weight.sum(), (away * weight) @ away.T / weight.sum()


def test_a_point_gets_the_widest_blur_in_all_directions():
    point = np.zeros((41, 51, 61), dtype=np.float32)
    point[20, 25, 30] = 1.0
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    covariance = turn @ np.diag([0.03**2, 0.05**2, 0.09**2]) @ turn.T
    total, more = moments(equalise_blur(point, covariance, SPACING))
    assert total == pytest.approx(1.0, abs=1e-4)
    assert more + covariance == pytest.approx(0.09**2 * np.eye(3), abs=3e-5)


def test_the_border_mirrors_grey_values():
    flat = np.full((12, 14, 16), 7.0, dtype=np.float32)
    assert equalise_blur(flat, np.diag([1e-4, 4e-4, 9e-4]), SPACING) == pytest.approx(flat, rel=1e-5)
    assert retrieve_phase(flat, 1e-3, SPACING) == pytest.approx(flat, rel=1e-5)


def test_phase_retrieval_inverts_one_minus_the_laplacian():
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.standard_normal((40, 40, 40)), 3.0).astype(np.float64)
    length2 = 0.03**2
    second = sum(np.gradient(np.gradient(smooth, h, axis=a), h, axis=a) for a, h in enumerate(SPACING[::-1]))
    restored = retrieve_phase((smooth - length2 * second).astype(np.float32), length2, SPACING)
    inner = (slice(8, -8),) * 3
    assert restored[inner] == pytest.approx(smooth[inner], abs=0.03 * np.abs(smooth).max())

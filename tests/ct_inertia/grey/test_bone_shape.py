"""Moments of a shape behind grey values that vary: a ball whose grey value rises along a line."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from legacy.ct_inertia.bodies import STAPES
from legacy.ct_inertia.grey.bone_shape import shape_moments
from legacy.ct_inertia.surface.moments import Moments
from tests.ct_inertia.balls import AIR, BONE, ball, places, volume_of
from tests.ct_inertia.grey.test_thin_walls import surface_of
from tests.oracles import ellipsoid_moments

RADIUS, SPACING, SIGMA = 0.4, 0.02, 0.02


class Labels:
    """Labels of a whole scan."""

    def __init__(self, inside):
        self.inside = inside
        self.first_index, self.end_index = np.zeros(3, dtype=np.int64), np.array(inside.shape[::-1])

    def read(self, low, high):
        z, y, x = (slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        return np.where(self.inside[z, y, x], STAPES, 0)


@pytest.mark.parametrize(("level", "slope"), [(1.0, 0.0), (1.03, 0.1), (0.97, -0.2)])
def test_the_shape_is_the_ball_whatever_its_grey_values(level, slope):
    x, y, z = places((56, 56, 56), SPACING)
    bare = ball(np.sqrt(x * x + y * y + z * z), RADIUS, SIGMA)
    volume = volume_of(bare * (level + slope * x), SPACING)
    truth = ellipsoid_moments(np.full(3, RADIUS))
    middle = np.full(3, 0.5 * 55 * SPACING)
    along = np.array([slope, 0.0, 0.0])
    seen = Moments(
        level * truth.volume, middle + truth.second @ along / (level * truth.volume), level * truth.second
    )
    bodies = SimpleNamespace(
        volume=volume, labels=Labels(bare > 0.5), psf_sigma_mm=SIGMA, moments=seen, stapes=surface_of(bare)
    )
    shape = shape_moments(bodies, AIR, BONE)
    assert shape.volume_mm3 == pytest.approx(truth.volume, rel=2e-3)
    assert np.allclose(shape.centroid_mm, middle, atol=2e-4)
    assert np.allclose(shape.second_mm5, truth.second, atol=4e-3 * truth.second[0, 0])

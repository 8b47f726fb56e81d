"""What fills closed voids is measured, air is air, and what the scan does not show is not called air."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.voids import closed_voids, empty_voids, void_notices
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume

H, NOISE = 0.03, 0.015
SHAPE = (30, 44, 44)
SPACING = np.full(3, H)


def scene(level, half_voxels=2.6, sigma=1.2, seed=0, noise=NOISE):
    """A disk of bone with a flat closed void of a level, blurred."""
    rng = np.random.default_rng(seed)
    z, y, x = np.indices(SHAPE) - np.array([14.7, 21.4, 21.8])[:, None, None, None]
    disk = np.clip(0.5 + np.minimum(16.0 - np.hypot(x, y), 7.5 - np.abs(z)), 0.0, 1.0)
    void = np.clip(0.5 + np.minimum(11.0 - np.hypot(x, y), half_voxels - np.abs(z)), 0.0, 1.0)
    bone, filling = gaussian_filter(disk - void, sigma), gaussian_filter(void, sigma)
    grey = (bone + level * filling + noise * rng.standard_normal(SHAPE)).astype(np.float32)
    nothing = np.zeros(SHAPE, dtype=bool)
    cut = Cut(np.zeros(3, dtype=np.int64), grey, grey > 0.5, nothing, nothing, "")
    width = H * np.sqrt(sigma**2 + 1 / 12)
    found = closed_voids(cut, SPACING, (Air(0.0, noise, 1e-3, 1.0, 0.0), 1.0), (width, 0.01 * width))
    return cut, found, filling, bone


@pytest.mark.parametrize(("level", "half"), [(0.15, 2.0), (0.3, 3.5)])
def test_the_level_of_a_filling_is_measured_and_subtracted(level, half):
    cut, found, _, bone = scene(level, half)
    assert found.level == pytest.approx(level, abs=2.5 * found.sd)
    assert 0.0 < found.sd < 0.1
    left = empty_voids(cut, found, 1.0)
    assert left.sum() == pytest.approx(bone.sum(), rel=0.004)


def test_voids_of_air_are_certain_where_they_are_wide():
    for seed in range(2):
        found = scene(0.0, 3.0, seed=seed)[1]
        assert (found.level, found.sd) == (0.0, 0.0)


def test_voids_as_narrow_as_the_blur_are_left_open():
    _, found, _, _ = scene(0.0, 1.3, 1.5, noise=0.05)
    assert found.level == 0.0
    assert found.sd > 0.02


def test_a_body_without_voids_has_none():
    nothing = np.zeros(SHAPE, dtype=bool)
    body = np.zeros(SHAPE, dtype=bool)
    body[8:20, 8:20, 8:20] = True
    cut = Cut(np.zeros(3, dtype=np.int64), body.astype(np.float32), body, nothing, nothing, "")
    assert closed_voids(cut, SPACING, (Air(0.0, NOISE, 1e-3, 1.0, 0.0), 1.0), (0.03, 1e-3)) is None


@pytest.mark.parametrize(("level", "codes"), [(0.3, ["void_filled"]), (0.0, [])])
def test_the_warning_tells_filled_from_dry(level, codes):
    cut, found, _, bone = scene(level, 3.5)
    volume = Volume(cut.grey, SPACING, np.zeros(3), np.eye(3))
    moments = Moments(float(bone.sum()) * H**3, np.zeros(3), np.eye(3), {})
    assert [notice.code for notice in void_notices(found, volume, moments)] == codes

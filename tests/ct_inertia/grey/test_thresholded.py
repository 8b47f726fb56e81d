"""A scan that was thresholded before it was given: told, and its uncertainty is that of the lost surface."""

import dataclasses

import numpy as np
import pytest

from legacy.ct_inertia.grey.thresholded import is_thresholded, with_threshold
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.surface.moments import Moments
from tests.ct_inertia.ears import AIR, BONE, ear
from tests.ct_inertia.solids import implicit_surface


def test_a_shift_of_a_ball_changes_its_moments_as_its_radius_does():
    radius, voxel = 0.7, 0.03
    surface = implicit_surface(
        lambda p: np.linalg.norm(p, axis=-1) - radius, (-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), 0.03
    )
    moments, notice = with_threshold(surface.moments(), surface, voxel)
    sd = np.sqrt(np.diag(moments.contributions["threshold"]))
    shift = voxel / np.sqrt(12.0)
    assert notice.code == "scan_thresholded"
    assert sd[0] == pytest.approx(4.0 * np.pi * radius**2 * shift, rel=5e-3)
    # S of a ball is 4 pi r^5 / 15 along each axis.
    assert sd[4:7] == pytest.approx(4.0 * np.pi * radius**4 / 3.0 * shift, rel=1e-2)
    assert np.max(sd[1:4]) < 1e-4 * shift


@pytest.mark.parametrize(("values", "told"), [((0.0, 1.0), True), ((0.0, 1.0, 2.0), True)])
def test_classes_are_told_from_grey_values(values, told):
    rng = np.random.default_rng(1)
    classes = rng.choice(np.array(values), size=(9, 8, 7))
    assert is_thresholded(classes) is told
    assert not is_thresholded(classes + 0.01 * rng.normal(size=classes.shape))


def test_a_thresholded_scan_says_so_and_covers_the_truth():
    case = ear(h=0.04)
    level = 0.5 * (AIR + BONE)
    binary = np.where(case.volume.array > level, np.uint8(255), np.uint8(0))
    bodies = find_bodies(dataclasses.replace(case.volume, array=binary))
    assert "scan_thresholded" in {notice.code for notice in bodies.notices}
    exact: Moments = case.stapes.moments()
    sd = np.sqrt(sum(part[0, 0] for part in bodies.moments.contributions.values()))
    assert abs(bodies.moments.volume_mm3 - exact.volume_mm3) < 2.0 * sd
    assert sd < 0.2 * exact.volume_mm3
    grey = find_bodies(case.volume)
    assert "scan_thresholded" not in {notice.code for notice in grey.notices}

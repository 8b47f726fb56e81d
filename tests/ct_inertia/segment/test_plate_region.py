"""The view of the plate: its place in the scan, its material, and the level that shows fluid."""

import numpy as np
import pytest

from legacy.ct_inertia.frames.plate_surface import _first
from legacy.ct_inertia.segment.plate_region import _box_of, _mean_inside, thinned


@pytest.mark.parametrize("step", [1, 2, 3, 5])
@pytest.mark.parametrize("thin", [1, 2, 3, 4])
def test_the_first_voxel_of_a_view_is_where_thinning_begins(step, thin):
    index = np.arange(60)[:, None, None] + np.zeros((1, 60, 60), dtype=int)
    view = thinned(thinned(index, step), thin)
    first = _first(np.array([step] * 3), np.array([step * thin] * 3))
    assert view[:3, 0, 0].tolist() == (first[0] + np.arange(3) * step * thin).tolist()


def test_the_level_of_a_body_is_the_mean_of_what_lies_beyond_the_reach_of_its_rim():
    region = np.zeros((24, 24, 24), dtype=bool)
    region[3:21, 3:21, 3:21] = True
    inner = np.zeros_like(region)
    inner[6:18, 6:18, 6:18] = True
    noise = np.random.default_rng(1).normal(0.0, 10.0, region.shape)
    grey = np.where(inner, 1000.0 + noise, np.where(region, 600.0, 0.0))
    assert _mean_inside(grey, region, 3, 900.0) == pytest.approx(1000.0, abs=4.0 * 10.0 / 12.0**1.5)
    assert _mean_inside(grey, region, 7, 900.0) == 900.0


def test_stray_voxels_widen_no_box():
    mask = np.zeros((40, 40, 40), dtype=bool)
    mask[10:20, 12:22, 14:24] = True
    mask[35, 35, ::4] = True
    assert _box_of(mask, 2) == (slice(8, 22), slice(10, 24), slice(12, 26))

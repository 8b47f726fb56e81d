"""An incus that has grown onto a stapes whose size both together still have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tifffile
import trimesh
from scipy.ndimage import gaussian_filter

from benchmarks import foreign_shapes as shapes
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.segment.find_stapes import find_stapes
from legacy.ct_inertia.segment.necks import necks
from sample_volumes.bodies import OPENEAR_STAPES
from sample_volumes.phantom import Ear, scene, write_scan

STEP = 0.035
FAMILIES = ("base", "thin", "gutter", "curved", "flat thin", "focus")


@pytest.fixture(scope="module")
def grid():
    axes = (np.arange(-1.9, 1.9, STEP), np.arange(-0.5, 4.9, STEP), np.arange(-1.1, 1.1, STEP))
    return tuple(place.astype(np.float32) for place in np.meshgrid(*axes, indexing="ij"))


def least_share(inside):
    seen = gaussian_filter(inside.astype(np.float32), 1.0) > 0.5
    found = necks(np.argwhere(seen) * STEP, np.full(3, STEP))
    return min((neck.share for neck in found), default=1.0), any(
        neck.narrow and neck.longer_than_head for neck in found
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_a_head_has_no_neck_as_narrow_as_what_has_grown_onto_it(family, grid):
    """Other shapes than those that the limit was chosen on."""
    rng = np.random.default_rng([FAMILIES.index(family), 71])
    anatomy = shapes.draw(family, rng)
    stapes = shapes.body(anatomy, grid) < 0.0
    reach = grid[1] < grid[1][stapes].max() + rng.uniform(0.5, 1.2)
    incus = (shapes.incus(anatomy, grid, -rng.uniform(0.02, 0.08)) < 0.0) & reach
    share, grown = least_share(stapes)
    assert share > 0.6
    assert not grown
    share, grown = least_share(stapes | incus)
    assert share < 0.5
    assert grown


def test_a_head_on_a_narrow_neck_is_left_whole(grid, tmp_path):
    """A neck of half the head's section, as a flat head has it; the head was cut off."""
    anatomy = shapes.Anatomy("base", head=(0.52, 0.2))
    x, y, z = grid
    stapes = shapes.body(anatomy, grid) < 0.0
    away = np.hypot(x, z)
    stapes &= ~((np.abs(y - 2.75) < 0.1) & (away > 0.29))
    stapes |= (np.abs(y - 3.05) < 0.2) & (np.hypot(x / 0.5, z / 0.4) < 1.0)
    share, _ = least_share(stapes)
    assert share < 0.55
    grey = gaussian_filter(np.pad(stapes, 6).transpose(2, 1, 0).astype(np.float32), 1.0)
    grey += 0.02 * np.random.default_rng(1).standard_normal(grey.shape, dtype=np.float32)
    tifffile.imwrite(tmp_path / "scan.tif", (20_000.0 * (grey + 1.0)).astype(np.uint16))
    sight = find_stapes(read_volume(tmp_path / "scan.tif", STEP), SearchOptions())
    assert not sight.at_neck
    assert sight.stapes.volume_mm3 == pytest.approx(stapes.sum() * STEP**3, rel=0.03)


@pytest.fixture
def seen(tmp_path):
    """Look at a small stapes whose incus has grown so far into it; None: without an incus."""
    mesh = trimesh.load_mesh(OPENEAR_STAPES)
    mesh.apply_transform(np.diag([1.03, 0.82, 0.95, 1.0]))
    mesh.export(tmp_path / "stapes.ply")
    usual = Ear(voxel_mm=(0.033,) * 3, gap_mm=0.12, noise=0.03, pose_seed=4, stapes=tmp_path / "stapes.ply")

    def seen(grown_mm):
        ear = replace(usual, incus_gap_mm=None if grown_mm is None else -grown_mm)
        write_scan(tmp_path / "scan.tif", scene(ear))
        return find_stapes(read_volume(tmp_path / "scan.tif", 0.033), SearchOptions())

    return seen


def test_it_is_cut_off_though_the_whole_has_the_size_of_a_stapes(seen):
    alone, *grown = (seen(grown_mm) for grown_mm in (None, 0.035, 0.07))
    assert not alone.at_neck
    for sight in grown:
        assert sight.at_neck
        assert sight.stapes.holes == 1
        assert sight.stapes.volume_mm3 == pytest.approx(alone.stapes.volume_mm3, rel=0.01)

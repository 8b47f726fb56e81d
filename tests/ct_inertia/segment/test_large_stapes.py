"""A large stapes is left whole: no narrow gap parts it, and no piece of it is taken for a smaller one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import foreign_scans as scans
from benchmarks import foreign_shapes as shapes
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.segment.find_stapes import find_stapes


@pytest.mark.parametrize("seed", [1, 4, 6, 8, 11, 12, 13, 15])
def test_a_large_stapes_in_its_window_is_not_cut(seed, tmp_path):
    rng = np.random.default_rng([seed, 5])
    anatomy = shapes.draw(("curved", "gutter", "base", "mirrored")[seed % 4], rng)
    scene = scans.Scene(voxel_um=40.0, noise=0.055, blur=1.1, gap_mm=0.12)
    truth = scans.make(replace(anatomy, scale=1.33), scene, rng, tmp_path / "scan.tif")
    sight = find_stapes(read_volume(tmp_path / "scan.tif", 0.04), SearchOptions())
    assert sight.stapes.volume_mm3 == pytest.approx(truth.volume_mm3, rel=0.04)
    assert [notice.code for notice in sight.notices] == ["stapes_uncertain"]

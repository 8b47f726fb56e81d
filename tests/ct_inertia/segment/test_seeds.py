"""A seed anywhere in the stapes finds what is found without one, on foreign shapes in their surroundings."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import foreign_scans as scans
from benchmarks import foreign_shapes as shapes
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.segment.find_stapes import find_stapes
from legacy.ct_inertia.volume.coarse_view import coarse_overview


def own_voxels(sight):
    return sight.pieces == sight.stapes.label


@pytest.mark.parametrize("seed", range(40, 44))
def test_a_seed_is_never_worse_than_none(seed, tmp_path):
    rng = np.random.default_rng(seed)
    anatomy = shapes.draw(("base", "asymmetric", "gutter", "thin")[seed % 4], rng)
    around = {"gap_mm": 0.09, "incus_mm": 0.07, "neighbour": rng.uniform(0.8, 1.2)}
    scene = scans.Scene(voxel_um=36.0, noise=0.03, **around)
    scans.make(anatomy, scene, rng, tmp_path / "scan.tif")
    volume = read_volume(tmp_path / "scan.tif", 0.036)
    glance = coarse_overview(volume)
    free = find_stapes(volume, SearchOptions(), glance)
    places = np.argwhere(own_voxels(free))
    for place in rng.choice(places, 6, replace=False):
        point = volume.scan_points(place[::-1] * free.scan.step + free.scan.step // 2)
        found = find_stapes(volume, SearchOptions(seed_mm=point), glance)
        both = np.count_nonzero(own_voxels(found) & own_voxels(free))
        assert both > 0.98 * np.count_nonzero(own_voxels(found) | own_voxels(free))
        assert [n.code for n in found.notices] == [n.code for n in free.notices]


def test_a_seed_in_air_is_refused(tmp_path):
    rng = np.random.default_rng(3)
    scans.make(shapes.draw("base", rng), scans.Scene(voxel_um=40.0), rng, tmp_path / "scan.tif")
    volume = read_volume(tmp_path / "scan.tif", 0.04)
    with pytest.raises(CtInertiaError) as refused:
        find_stapes(volume, SearchOptions(seed_mm=np.array([0.1, 0.1, 0.1])))
    assert "seed" in refused.value.faults[0].thing

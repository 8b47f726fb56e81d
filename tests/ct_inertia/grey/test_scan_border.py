"""A stapes that the scan cuts: the layer and the area of the cut are told, and that the budget lacks it."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.exports.mass_json import mass_json
from legacy.ct_inertia.grey.scan_border import border_notices, cut_layers
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.volume import Volume
from tests.ct_inertia.ears import ear


def test_layers_and_areas_of_a_block_in_a_corner():
    mask = np.zeros((8, 9, 10), dtype=bool)
    mask[5:, :3, 2:6] = True
    spacing = np.array([0.01, 0.02, 0.05])
    everywhere = (True, True, True)
    found = {(cut.axis, cut.end): cut.area_mm2 for cut in cut_layers(mask, spacing, everywhere, everywhere)}
    # 3 x 4 voxels of 0.05 x 0.01 mm, and of 0.02 x 0.01 mm.
    assert found == {("y", "first"): pytest.approx(0.006), ("z", "last"): pytest.approx(0.0024)}
    assert cut_layers(mask, spacing, everywhere, (False, False, False))[0].axis == "y"
    assert cut_layers(mask, spacing, (False,) * 3, (False,) * 3) == ()


def test_a_box_inside_the_scan_is_no_border():
    volume = Volume(np.zeros((20, 20, 20), np.float32), np.full(3, 0.02), np.zeros(3), np.eye(3))
    mask = np.ones((4, 4, 4), dtype=bool)
    none = np.zeros_like(mask)
    for first, told in (((3, 3, 3), []), ((16, 3, 0), ["last layer along x", "first layer along z"])):
        cut = Cut(np.array(first), mask.astype(np.float32), mask, none, none, "made")
        text = " ".join(notice.text for notice in border_notices(volume, cut))
        assert all(words in text for words in told)
        assert bool(text) == bool(told)
        assert text.count("0.0064 mm2") == len(told)


def test_the_cut_is_told_with_its_area_and_stands_in_the_budget(tmp_path):
    scan = ear(h=0.05, rays=4).volume
    index = np.argwhere(scan.array > 11000)
    short = scan.array[:, :, : index[:, 2].max() - 3]
    area = np.count_nonzero(short[:, :, -1] > 11000) * 0.05**2
    path = tmp_path / "short.tif"
    tifffile.imwrite(path, short.astype(np.uint16), photometric="minisblack")
    result = ct2mass(MassOptions(path, density=(1900.0, 60.0), spacing_mm=(0.05,)))
    (notice,) = [notice for notice in result.notices if notice.code == "touches_border"]
    assert "at the last layer along x (" in notice.text
    told = float(notice.text.partition("along x (")[2].partition(" mm2")[0])
    assert told == pytest.approx(area, rel=0.3)
    content = mass_json(result, second=False)
    assert "cut part not included" in content["uncertainty"]["not_included"]
    labels = replace(scan, array=(short > 11000).astype(np.uint8))
    alone = find_bodies(None, SearchOptions(labels=labels))
    assert any("label volume, at the last layer along x" in notice.text for notice in alone.notices)


def test_a_whole_stapes_has_no_cut_part_in_its_budget(tmp_path):
    scan = ear(h=0.05, rays=4).volume
    path = tmp_path / "whole.tif"
    tifffile.imwrite(path, scan.array.astype(np.uint16), photometric="minisblack")
    result = ct2mass(MassOptions(path, density=(1900.0, 60.0), spacing_mm=(0.05,)))
    missing = mass_json(result, second=False)["uncertainty"]["not_included"]
    assert [words.split(":")[0].split(" (")[0] for words in missing] == [
        "voxel size not included",
        "bare bone assumed",
        "linear grey scale assumed",
    ]

"""The phantom's own truth: rendered volumes against exact moments, poses, determinism, stored order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from legacy.stapeskit.spatial import check_inertia
from sample_volumes import bodies
from sample_volumes.coverage import crossings
from sample_volumes.phantom import Ear, Renderer, render, scene, truth, write_scan

COARSE = Ear(voxel_mm=(0.06, 0.06, 0.06))
ALONE = replace(COARSE, bone=False, plate=False, noise=0.0)


def rendered_moments(ear):
    placed = scene(ear)
    grey = Renderer(placed).contrast(0, placed.shape[2]).astype(float)
    z, y, x = np.indices(grey.shape)
    total = grey.sum()
    index = np.array([(grey * axis).sum() for axis in (x, y, z)]) / total
    return placed, total * np.prod(ear.voxel_mm), index * np.asarray(ear.voxel_mm)


def test_filled_part_of_a_box_is_its_volume_to_rounding():
    solid = bodies.box(np.array([1.3, 2.2, 0.7]), np.array([6.1, 4.9, 3.45]))
    grid = crossings(solid.vertices, solid.faces, (9, 8), 1)
    filled = grid.slab(0, 6)
    columns = (filled > 0).any(axis=0).sum()
    assert filled.sum() == pytest.approx(columns * (3.45 - 0.7), rel=1e-6)
    assert filled.min() >= 0.0
    assert filled.max() <= 1.0


def test_slabs_join_to_the_whole():
    solid = bodies.rod(np.array([2.0, 2.0, 1.0]), np.array([6.0, 7.0, 11.0]), 1.7)
    grid = crossings(solid.vertices, solid.faces, (10, 10), 3)
    whole = grid.slab(0, 14)
    parts = np.concatenate([grid.slab(0, 5), grid.slab(5, 4), grid.slab(9, 5)])
    np.testing.assert_allclose(parts, whole, atol=1e-6)


def test_rendered_stapes_has_the_volume_and_centre_of_its_mesh():
    placed, volume, centre = rendered_moments(replace(ALONE, voxel_mm=(0.03, 0.025, 0.04)))
    moments = bodies.stapes_in_footplate().moments()
    assert volume == pytest.approx(moments.volume_mm3, rel=1e-4)
    wanted = placed.scan_from_footplate.points(moments.centroid_mm)
    np.testing.assert_allclose(centre, wanted, atol=1e-4)


def test_truth_is_a_possible_body_of_the_stated_mass():
    behind = truth(scene(COARSE))
    matrix = np.array(behind["mass_matrix_si"])
    check_inertia(matrix)
    assert behind["mass_kg"] == pytest.approx(3.2e-6, rel=1e-4)
    assert matrix[0, 0] == pytest.approx(behind["volume_m3"] * 1382.4, rel=1e-12)


def test_truth_frames_agree_with_each_other_and_with_the_convention_for_the_plate():
    for seed in range(6):
        behind = truth(scene(replace(COARSE, pose_seed=seed, upright="xyz"[seed % 3])))
        frames = {
            key: np.array(behind[key])
            for key in ("scan_from_footplate", "scan_from_plate", "plate_from_footplate")
        }
        joined = frames["scan_from_plate"] @ frames["plate_from_footplate"]
        np.testing.assert_allclose(joined, frames["scan_from_footplate"], atol=1e-12)
        assert frames["scan_from_plate"][0, 0] > 0.0
        assert frames["plate_from_footplate"][1, 3] > 0.0


def test_noise_has_the_stated_size_and_does_not_depend_on_the_slabs():
    placed = scene(COARSE)
    whole = Renderer(placed).slices(0, 12)
    parts = np.concatenate([Renderer(placed).slices(0, 5), Renderer(placed).slices(5, 7)])
    assert np.mean(whole != parts) < 1e-3
    air = whole[:3].astype(float)
    assert air.mean() == pytest.approx(8000.0, abs=20.0)
    assert air.std() == pytest.approx(0.04 * 22000.0, rel=0.03)


def test_the_gap_is_kept_all_round():
    stapes = bodies.stapes_in_footplate()
    rim = stapes.vertices_mm[stapes.vertices_mm[:, 1] < 0.35][:, [0, 2]]
    widened = bodies.footplate_outline(stapes, 0.15)
    distance = np.linalg.norm(rim[:, None] - widened[None], axis=2).min()
    assert 0.1499 < distance < 0.16


def test_bridges_join_stapes_and_bone():
    from scipy.ndimage import label

    open_gap = replace(COARSE, gap_mm=0.3, plate=False, noise=0.0)
    counts = []
    for ear in (open_gap, replace(open_gap, bridges=2, bridge_radius_mm=0.15)):
        placed = scene(ear)
        counts.append(label(Renderer(placed).contrast(0, placed.shape[2]) > 0.5)[1])
    assert counts[0] == counts[1] + 1


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_mirrored_storage_is_the_reverse_order_of_slices(axis):
    plain = render(scene(ALONE))
    stored = render(scene(replace(ALONE, mirror=axis)))
    np.testing.assert_array_equal(np.flip(stored, axis="zyx".index(axis)), plain)


def test_scan_file_carries_its_spacing_and_can_be_mapped(tmp_path):
    placed = scene(replace(COARSE, voxel_mm=(0.06, 0.05, 0.08)))
    path = tmp_path / "scan.tif"
    write_scan(path, placed)
    with tifffile.TiffFile(path) as file:
        assert file.imagej_metadata["spacing"] == 0.08
        assert file.imagej_metadata["unit"] == "mm"
        resolution = [file.pages[0].tags[name].value for name in ("XResolution", "YResolution")]
        np.testing.assert_allclose([b / a for a, b in resolution], [0.06, 0.05], rtol=1e-6)
    mapped = tifffile.memmap(path, mode="r")
    assert mapped.shape == placed.shape[::-1]
    np.testing.assert_array_equal(mapped[5:9], Renderer(placed).slices(5, 4))

"""The working copy of a box of the scan: exact means, exact place, borders, clipped air."""

import numpy as np
import pytest

from legacy.ct_inertia.bodies import LabelledVolume
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.air_level import Surroundings, air_shell, measure_air, unclipped
from legacy.ct_inertia.grey.scan_border import border_notices
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.coarse_view import coarse_scan, material_levels, noise_of
from legacy.ct_inertia.volume.interior_histogram import interior
from legacy.ct_inertia.volume.volume import Volume
from legacy.ct_inertia.volume.working_copy import block_for, working_box
from tests.ct_inertia.ears import ear
from tests.ct_inertia.solids import random_rotation

SPACING = np.array([0.005, 0.008, 0.02])


def scan(shape, dtype=np.uint16, seed=0):
    rng = np.random.default_rng(seed)
    array = (rng.random(shape) * 60000).astype(dtype)
    return Volume(array, SPACING, np.array([1.0, -2.0, 3.0]), random_rotation(seed))


def integrals(volume, array, points_of):
    """Sum and first moments of grey values, scan coordinates."""
    z, y, x = np.indices(array.shape)
    points = points_of(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    weight = array.ravel().astype(float) * volume.voxel_mm3
    return np.array([weight.sum(), *(weight @ points)])


@pytest.mark.parametrize("dtype", [np.uint8, ">u2", np.int16, np.float32])
def test_integral_and_first_moments_are_those_of_the_voxels(dtype):
    volume = scan((10, 21, 40), dtype)
    assert block_for(SPACING, 0.024).tolist() == [4, 3, 1]
    box = working_box(volume, np.zeros(3, int), volume.size, 0.0, 0)
    assert box.block.tolist() == [4, 3, 1]
    assert box.shape == (10, 7, 10)
    fine = integrals(volume, volume.array, volume.scan_points)
    coarse = integrals(box.volume, box.grey, box.volume.scan_points)
    assert coarse[0] == pytest.approx(fine[0], rel=1e-6)
    # Within a block noise moves the first moment; of a field that is even there it does not.
    even = Volume(np.ones(volume.array.shape, dtype), SPACING, volume.origin_mm, volume.direction)
    flat = working_box(even, np.zeros(3, int), even.size, 0.0, 0)
    fine = integrals(even, even.array, even.scan_points)
    assert integrals(flat.volume, flat.grey, flat.volume.scan_points) == pytest.approx(fine, rel=1e-6)


def test_each_block_is_the_mean_of_its_voxels_in_its_middle():
    volume = scan((12, 40, 60))
    box = working_box(volume, np.array([21, 14, 4]), np.array([30, 20, 8]), 0.0, 1)
    x, y, z = box.first
    part = volume.array[z : z + 1, y : y + 3, x : x + 4]
    assert box.grey[0, 0, 0] == pytest.approx(part.mean(), rel=1e-6)
    middle = volume.scan_points(box.first + np.array([1.5, 1.0, 0.0]))
    assert box.volume.origin_mm == pytest.approx(middle, abs=1e-12)
    assert box.single[0, 0, 0] == volume.array[z, y + 1, x + 2]
    assert box.blocks_of(np.array([[x + 4, y + 2, z]])).tolist() == [[1, 0, 0]]


def test_the_box_ends_where_the_scan_ends():
    volume = scan((12, 40, 61))
    box = working_box(volume, np.array([41, 20, 4]), np.array([61, 40, 12]), 0.0, 1)
    assert (box.first + box.block * box.shape[::-1] == volume.size).all()
    begins, ends = box.at_border(volume)
    assert not begins.any()
    assert ends.all()
    whole = working_box(volume, np.zeros(3, int), volume.size, 0.0, 0)
    assert whole.block.tolist() == [1, 1, 1]  # 61 and 40 voxels leave a rest at both ends of the scan
    assert whole.single is None


@pytest.mark.parametrize(("start", "told"), [(0, True), (20, False), (41, True)])
def test_a_body_is_called_cut_off_where_the_scan_ends_not_where_the_box_does(start, told):
    volume = scan((12, 60, 61))
    low = np.array([start, 30, 5])
    box = working_box(volume, low, low + np.array([20, 6, 2]), 0.0, 1)
    stapes = np.zeros(box.shape, dtype=bool)
    stapes[1:-1, 1:-1, :] = True
    none = np.zeros_like(stapes)
    cut = Cut(np.zeros(3, int), box.grey, stapes, none, none, "made", (), box)
    assert [notice.code for notice in border_notices(volume, cut)] == ["touches_border"] * told


def test_voxels_that_are_not_finite_count_as_air_or_are_refused():
    volume = scan((4, 9, 16), np.float32)
    volume.array[1, 4, 4] = np.nan
    with pytest.raises(CtInertiaError, match="finite"):
        working_box(volume, np.zeros(3, int), volume.size, 0.0, 0)
    allowed = Volume(volume.array, SPACING, np.zeros(3), np.eye(3), nan_as_air=True)
    assert np.isfinite(working_box(allowed, np.zeros(3, int), volume.size, 0.0, 0).grey).all()


def test_a_scan_of_doubled_voxels_gives_the_same_stapes(tmp_path):
    once = ear(h=0.024, rays=2, margin=0.3).volume
    array = once.array.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    twice = Volume(array, once.spacing_mm / 2, once.origin_mm - once.spacing_mm / 4, once.direction)
    a, b = find_bodies(once), find_bodies(twice)
    assert b.moments.volume_mm3 == pytest.approx(a.moments.volume_mm3, rel=2e-4)
    assert b.moments.centroid_mm == pytest.approx(a.moments.centroid_mm, abs=2e-4)
    assert b.moments.inertia_mm5 == pytest.approx(a.moments.inertia_mm5, rel=5e-4, abs=5e-4)
    assert b.labels.spacing_mm == pytest.approx(once.spacing_mm / 2)
    fine, coarse = b.labels.mask(1).sum() / 8, a.labels.mask(1).sum()
    assert fine == pytest.approx(coarse, rel=2e-3)
    b.labels.write(tmp_path / "labels.nrrd")
    back = read_volume(tmp_path / "labels.nrrd")
    assert np.array_equal(back.array, b.labels.labels)
    assert back.origin_mm == pytest.approx(b.labels.origin_mm)
    assert back.direction == pytest.approx(twice.direction)


def test_labels_are_the_same_as_a_whole_and_in_slabs():
    labels = find_bodies(ear(h=0.06, rays=2, gap=0.15, plate_gap=0.3).volume).labels
    assert np.array_equal(np.concatenate(list(labels.slabs())), labels.labels)
    low = labels.first_index + 3
    part = labels.read(low, low + np.array([9, 8, 7]))
    assert np.array_equal(part, labels.labels[3:10, 3:11, 3:12])
    dense = LabelledVolume.of_array(labels.labels, labels.first_index, labels.grid)
    assert np.array_equal(np.concatenate(list(dense.slabs())), labels.labels)


@pytest.mark.parametrize("air", [0.5, 1.0, 2.0])
def test_clipped_air_is_seen_and_corrected_behind_means(air):
    rng = np.random.default_rng(3)
    noise = 400.0
    grey = air * noise + noise * rng.standard_normal((128, 128, 128))
    middle = np.abs(np.indices(grey.shape) - 64).max(axis=0) < 20
    grey[middle] += 20000.0
    volume = Volume(np.maximum(grey, 0).astype(np.uint16), np.full(3, 0.01), np.zeros(3), np.eye(3))
    box = working_box(volume, np.zeros(3, int), volume.size, 0.0, 0)
    assert box.block.tolist() == [2, 2, 2]
    bone = box.grey > 10000
    around = Surroundings(box.grey, bone, np.zeros_like(bone), box.volume.spacing_mm, box.single)
    distance = np.where(bone, 0.0, 1.0).astype(np.float32) * 0.2
    found = measure_air(around, air_shell(around, distance, 0.1), 0.0)
    assert found.clipped > 0.01
    assert found.level == pytest.approx(air * noise, abs=0.04 * noise)
    assert found.noise == pytest.approx(noise / np.sqrt(8), rel=0.1)
    corrected = unclipped(box.grey, ~bone, found)
    far = np.abs(np.indices(bone.shape) - 32).max(axis=0) > 14
    assert corrected[far].mean() == pytest.approx(air * noise, abs=0.05 * noise)


def test_noise_and_levels_are_those_put_in():
    rng = np.random.default_rng(4)
    grey = np.full((90, 80, 70), 5000.0) + 300.0 * rng.standard_normal((90, 80, 70))
    grey[30:45, 30:45, 30:45] += 9000.0
    grey[60:66, 20:60, 20:60] += 3000.0
    volume = Volume(grey.astype(np.float32), np.full(3, 0.05), np.zeros(3), np.eye(3))
    view = coarse_scan(volume)
    assert view.noise == pytest.approx(300.0, rel=0.03)
    assert noise_of(view.grey) == view.noise
    assert material_levels(view) == pytest.approx([5000.0, 8000.0, 14000.0], abs=60.0)


def test_the_interior_is_where_seven_voxels_agree():
    rng = np.random.default_rng(5)
    grey = (60000.0 + 50.0 * rng.standard_normal((20, 30, 40))).astype(np.float32)
    grey[:, :, 20:] -= 40000.0
    found = interior(grey, 100.0, 20.0)
    core = grey[1:-1, 1:-1, 1:-1].astype(float)
    cross = [core]
    for axis in range(3):
        for shift in (-1, 1):
            cross.append(np.roll(grey, shift, axis)[1:-1, 1:-1, 1:-1].astype(float))
    mean, scatter = np.mean(cross, axis=0), np.std(cross, axis=0, ddof=1)
    assert found.histogram.sum() == np.count_nonzero(scatter < 100.0)
    assert np.abs(found.centres[found.bins] - mean).max() < 10.5
    assert np.array_equal(found.near(60000.0, 1000.0), np.abs(mean - 60000.0) < 1000.0)

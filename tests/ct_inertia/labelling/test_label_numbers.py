"""Segments by name, islands, spacing of label files, and a stapes labelled alone over a plate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import foreign_scans as scans
from benchmarks import foreign_shapes as shapes
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.labelling.label_numbers import body_numbers, without_islands
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.read_scan import read_labels, read_volume
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.volume.volume import Volume


def labelled(names, array=None):
    array = np.ones((4, 4, 4), np.uint8) if array is None else array
    return Volume(array, np.full(3, 0.03), np.zeros(3), np.eye(3), segment_names=names)


@pytest.mark.parametrize(
    ("names", "stapes", "plate"),
    [
        ({}, 1, 2),
        ({1: "plate", 2: "stapes"}, 2, 1),
        ({3: "Left STAPES", 5: "excitation Plate", 1: "incus"}, 3, 5),
        ({1: "Segment_1", 2: "Segment_2"}, 1, 2),
        ({1: "stapes"}, 1, 2),
        ({1: "stapes", 2: "incus"}, 1, None),
        ({1: "footplate of the stapes", 2: "other bone"}, 1, None),
        ({2: "stapes"}, 2, None),
    ],
)
def test_names_win_over_numbers(names, stapes, plate):
    assert body_numbers(labelled(names), None, None) == (stapes, plate)
    assert body_numbers(labelled(names), 7, 8) == (7, 8)


@pytest.mark.parametrize(
    "part",
    ["footplate", "Stapes footplate", "foot plate", "Fußplatte", "crura", "anterior crus", "stapes head"],
)
def test_a_stapes_in_parts_is_refused(part):
    for names in ({1: "stapes", 2: part}, {3: part, 5: "Stapes"}):
        with pytest.raises(CtInertiaError) as refused:
            body_numbers(labelled(names), None, None)
        assert part in refused.value.faults[0].got
        assert body_numbers(labelled(names), 1, None)[0] == 1


@pytest.mark.parametrize("other", ["stapedius tendon", "stapes tendon", "incus crura", "annular ligament"])
def test_what_hangs_on_the_stapes_is_no_part_of_it(other):
    assert body_numbers(labelled({1: "stapes", 4: other}), None, None)[0] == 1


@pytest.mark.parametrize("names", [{1: "incus"}, {1: "stapes left", 2: "stapes right"}])
def test_names_that_say_something_else_are_refused(names):
    with pytest.raises(CtInertiaError) as refused:
        body_numbers(labelled(names), None, None)
    assert refused.value.faults[0].thing == "the label volume"


def test_one_number_for_two_bodies_is_refused():
    with pytest.raises(CtInertiaError):
        body_numbers(labelled({}), 3, 3)


@pytest.mark.parametrize("size", [1, 2, 4])
def test_small_islands_are_left_out_with_a_warning_and_large_ones_refused(size):
    array = np.zeros((40, 40, 40), np.uint8)
    array[5:25, 5:25, 5:25] = 1
    array[30 : 30 + size, 30 : 30 + size, 30 : 30 + size] = 1
    kept, notices = without_islands(labelled({}, array), 1)
    assert np.count_nonzero(kept) == 20**3
    assert [n.code for n in notices] == ["label_islands_left_out"]
    array[28:38, 28:38, 28:38] = 1
    with pytest.raises(CtInertiaError):
        without_islands(labelled({}, array), 1)


def test_a_label_number_needs_labels(tmp_path):
    with pytest.raises(CtInertiaError):
        MassOptions(scan=tmp_path / "scan.tif", density=(1900.0, None), stapes_label=2)


def test_a_label_file_keeps_its_own_spacing(tmp_path):
    import SimpleITK as sitk
    import tifffile

    image = sitk.GetImageFromArray(np.eye(8, dtype=np.uint8)[None].repeat(8, 0))
    image.SetSpacing((0.02, 0.02, 0.03))
    sitk.WriteImage(image, tmp_path / "own.nrrd")
    assert read_labels(tmp_path / "own.nrrd", 0.5).spacing_mm == pytest.approx([0.02, 0.02, 0.03])
    tifffile.imwrite(
        tmp_path / "none.tif", np.asarray(sitk.GetArrayFromImage(image)), photometric="minisblack"
    )
    assert read_labels(tmp_path / "none.tif", 0.5).spacing_mm == pytest.approx([0.5, 0.5, 0.5])


@pytest.mark.parametrize("seed", [30, 31, 32])
def test_a_stapes_labelled_alone_finds_the_plate_and_is_no_worse_than_without_labels(seed, tmp_path):
    anatomy = shapes.draw("base", np.random.default_rng(seed))
    scene = scans.Scene(voxel_um=32.0, noise=0.02, plate=0.35)
    truth = scans.make(anatomy, scene, np.random.default_rng(seed), tmp_path / "scan.tif")
    volume = read_volume(tmp_path / "scan.tif", 0.032)
    free = find_bodies(volume)
    assert free.plate is not None
    array = np.zeros(volume.array.shape, np.uint8)
    first, own = free.labels.first_index, np.asarray(free.labels.labels) == 1
    part = tuple(slice(int(f), int(f) + n) for f, n in zip(first[::-1], own.shape, strict=True))
    array[part] = own
    labels = replace(volume, array=array, notices=())
    found = find_bodies(volume, SearchOptions(labels=labels))
    assert found.plate is not None
    error, usual = (abs(b.moments.volume_mm3 / truth.volume_mm3 - 1.0) for b in (found, free))
    assert error < max(2.0 * usual, 0.005)

"""TIFFs that show 0 as white: bright and dark are exchanged, with a notice; labels stay as they are."""

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.read_scan import read_labels, read_volume
from tests.ct_inertia.ears import ear
from tests.ct_inertia.readers.writers import picture

# What a stored number counts as: from the other end of its range.
ENDS = {"u1": 255, "u2": 65535, "i2": -1, "f4": 0.0}


def codes(volume):
    return [notice.code for notice in volume.notices]


@pytest.mark.parametrize("packed", [None, "zlib"])
@pytest.mark.parametrize("dtype", ENDS)
def test_a_stack_is_turned(tmp_path, dtype, packed):
    array = picture(dtype)
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, array, photometric="miniswhite", compression=packed)
    volume = read_volume(path, 0.02)
    assert volume.array.dtype == array.dtype
    assert np.array_equal(np.asarray(volume.array).astype(float), ENDS[dtype] - array.astype(float))
    assert np.array_equal(np.asarray(volume.array[1:3, ::2, 2]), np.asarray(volume.array)[1:3, ::2, 2])
    assert codes(volume).count("white_is_zero") == 1


def test_a_folder_of_slices_is_turned(tmp_path):
    array = picture("u2")
    for k, plane in enumerate(array):
        tifffile.imwrite(tmp_path / f"slice{k:03d}.tif", plane, photometric="miniswhite")
    volume = read_volume(tmp_path, 0.02)
    assert np.array_equal(np.asarray(volume.array), 65535 - array)
    assert "white_is_zero" in codes(volume)


def test_usual_files_are_left_alone(tmp_path):
    tifffile.imwrite(tmp_path / "scan.tif", picture(), photometric="minisblack")
    assert "white_is_zero" not in codes(read_volume(tmp_path / "scan.tif", 0.02))


def test_labels_are_numbers_and_not_bright_or_dark(tmp_path):
    array = picture("u1")
    tifffile.imwrite(tmp_path / "labels.tif", array, photometric="miniswhite")
    labels = read_labels(tmp_path / "labels.tif", 0.02)
    assert np.array_equal(labels.array, array)
    assert "white_is_zero" not in codes(labels)


def test_an_ear_stored_dark_on_white_weighs_the_same(tmp_path):
    scan = ear(h=0.05, seed=3).volume
    grey = scan.array.astype(np.uint16)
    volumes = []
    for name, array, kind in (("as_is", grey, "minisblack"), ("turned", 65535 - grey, "miniswhite")):
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, array, photometric=kind)
        found = find_bodies(read_volume(path, 0.05))
        volumes.append(found.moments.volume_mm3)
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)
    assert "white_is_zero" in [notice.code for notice in found.notices]

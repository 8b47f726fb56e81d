"""Label files: the labels as they are, under a header that places them on the scan."""

import gzip

import numpy as np
import pytest
import SimpleITK as sitk

from legacy.ct_inertia.bodies import LabelledVolume
from legacy.ct_inertia.read_scan import read_labels
from legacy.ct_inertia.volume.label_file import packed_labels
from legacy.ct_inertia.volume.volume import Volume


def labelled(values, first=(0, 0, 0)):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    scan = Volume(values, np.array([0.01, 0.02, 0.03]), np.array([1.0, 2.0, 3.0]), turn)
    return LabelledVolume.of_array(values, np.array(first, dtype=np.int64), scan)


@pytest.mark.parametrize(
    "values",
    [
        (np.arange(7 * 8 * 9) % 5).astype(np.uint8).reshape(7, 8, 9),
        np.zeros((1, 1, 1), dtype=np.uint8),
        np.full((9, 40, 500), 3, dtype=np.uint8),
        np.random.default_rng(1).integers(0, 4, (33, 41, 52)).astype(np.uint8),
    ],
    ids=["above three", "one voxel", "one value", "noise"],
)
def test_unpacked_labels_are_those_given(values):
    if min(values.shape) < 2:
        values = np.pad(values, ((0, 1), (0, 1), (0, 1)))
    assert gzip.decompress(packed_labels(labelled(values))) == values.tobytes()


@pytest.mark.parametrize("name", ["labels.nrrd", "labels.seg.nrrd"])
def test_another_program_finds_them_in_their_place(tmp_path, name):
    values = np.zeros((4, 5, 6), dtype=np.uint8)
    values[1, 2, 3] = 2
    labels = labelled(values, (7, 8, 9))
    path = tmp_path / name
    labels.write(path)
    image = sitk.ReadImage(str(path))
    assert image.GetSpacing() == pytest.approx((0.01, 0.02, 0.03))
    assert np.array_equal(sitk.GetArrayFromImage(image), values)
    # Origin of the scan + direction * (index of the voxel in the scan * spacing).
    place = [1.0 - 0.02 * (8 + 2), 2.0 + 0.01 * (7 + 3), 3.0 + 0.03 * (9 + 1)]
    assert image.TransformIndexToPhysicalPoint((3, 2, 1)) == pytest.approx(place)


def test_a_segmentation_names_and_colours_its_segments(tmp_path):
    values = (np.arange(4 * 5 * 6) % 4).astype(np.uint8).reshape(4, 5, 6)
    labelled(values).write(tmp_path / "labels.seg.nrrd")
    image = sitk.ReadImage(str(tmp_path / "labels.seg.nrrd"))
    keys = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys() if key.startswith("Seg")}
    assert keys["Segmentation_MasterRepresentation"] == "Binary labelmap"
    named = {keys[f"Segment{n}_Name"]: int(keys[f"Segment{n}_LabelValue"]) for n in range(3)}
    assert named == {"stapes": 1, "plate": 2, "other bone": 3}
    for n in range(3):
        assert keys[f"Segment{n}_Layer"] == "0"
        assert keys[f"Segment{n}_Extent"] == "0 5 0 4 0 3"
        colour = [float(part) for part in keys[f"Segment{n}_Color"].split()]
        assert len(colour) == 3
        assert all(0.0 <= part <= 1.0 for part in colour)
    read = read_labels(tmp_path / "labels.seg.nrrd")
    assert read.segment_names == {1: "stapes", 2: "plate", 3: "other bone"}
    assert np.array_equal(read.array, values)

"""Label volumes: names win over numbers; what is written lies on the scan in other programs."""

import gzip

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from ct_inertia.exports.labels import SEGMENTS, write_crop, write_segmentation
from ct_inertia.find.label_volume import body_numbers
from ct_inertia.scan.open_scan import open_labels, open_scan
from stapeskit.faults import StapeskitError
from tests.scan_files import scan_writers as w
from tests.scan_files import scanner_writers as own
from tests.scan_files.scan_writers import SPACING, picture

AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_matrix() * SPACING
AFFINE[:3, 3] = 5.0, -6.0, 7.0
LABELS = (picture("u1") % 4).astype("u1")


def test_a_segmentation_is_read_back_by_others_and_by_us(tmp_path):
    path = tmp_path / "labels.seg.nrrd"
    write_segmentation(path, (LABELS[k : k + 3] for k in range(0, 7, 3)), LABELS.shape, AFFINE)
    image = sitk.ReadImage(str(path))
    assert np.array_equal(sitk.GetArrayFromImage(image), LABELS)
    for index in ((0, 0, 0), (4, 5, 6)):
        place = AFFINE[:3, :3] @ index + AFFINE[:3, 3]
        assert image.TransformIndexToPhysicalPoint(index) == pytest.approx(place)
    for number, (value, (name, colour)) in enumerate(SEGMENTS.items()):
        keys = {key: image.GetMetaData(f"Segment{number}_{key}") for key in ("Name", "Color", "LabelValue")}
        assert keys == {"Name": name, "Color": colour, "LabelValue": str(value)}
    labels, grid = open_labels(path)
    assert np.array_equal(labels, LABELS)
    assert grid.scan_from_index == pytest.approx(AFFINE)
    assert grid.segment_names == {value: name for value, (name, _) in SEGMENTS.items()}
    assert body_numbers(grid.segment_names, [1, 2, 3], None, None, "") == (1, 2)


@pytest.mark.parametrize("kind", ["u1", ">u2", "i2", "f4", "f8"])
def test_a_crop_is_read_back_at_its_place(tmp_path, kind):
    array = picture(kind)
    write_crop(
        tmp_path / "crop.nrrd", (array[k : k + 3] for k in range(0, 7, 3)), (7, 6, 5), array.dtype, AFFINE
    )
    scan = open_scan(tmp_path / "crop.nrrd")
    assert np.array_equal(scan.read(), picture(kind))
    assert scan.scan_from_index == pytest.approx(AFFINE)
    assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "crop.nrrd"))), picture(kind))


def layered(path, bone=False, packed=True):
    """A segmentation of 3D Slicer whose segments overlap: two layers; the second one may be all bone."""
    values = np.zeros((7, 6, 5, 2), np.uint8)
    values[1:4, ..., 0], values[4:6, ..., 0], values[0 if bone else 3 : 5, ..., 1] = 1, 2, 1
    steps = " ".join("(" + ",".join(f"{v:g}" for v in row) + ")" for row in np.diag(SPACING))
    text = (
        "NRRD0004\ntype: uint8\ndimension: 4\nspace: left-posterior-superior\nsizes: 2 5 6 7\n"
        f"space directions: none {steps}\nkinds: list domain domain domain\n"
        f"encoding: {'gzip' if packed else 'raw'}\n"
        "space origin: (1,2,3)\n"
    )
    for k, (value, layer, name) in enumerate(((1, 0, "stapes"), (2, 0, "plate"), (1, 1, "incus"))):
        text += f"Segment{k}_LabelValue:={value}\nSegment{k}_Layer:={layer}\nSegment{k}_Name:={name}\n"
    voxels = values.tobytes()
    path.write_bytes(text.encode() + b"\n" + (gzip.compress(voxels) if packed else voxels))
    return path


def test_a_layered_segmentation_becomes_one_label_volume(tmp_path):
    labels, grid = open_labels(layered(tmp_path / "a.seg.nrrd"))
    assert [int(labels[k, 0, 0]) for k in range(7)] == [0, 1, 1, 3, 3, 2, 0]
    assert grid.segment_names == {1: "stapes", 2: "plate", 3: "incus"}
    assert grid.spacing_mm == pytest.approx(SPACING)
    assert grid.origin_mm.tolist() == [1.0, 2.0, 3.0]
    (text,) = [notice.text for notice in grid.notices if notice.code == "file_read"]
    assert "1 stapes, 2 plate, 3 incus" in text


def test_a_segment_of_all_bone_does_not_cover_the_stapes_in_it(tmp_path):
    labels, _ = open_labels(layered(tmp_path / "a.seg.nrrd", bone=True, packed=False))
    assert [int(labels[k, 0, 0]) for k in range(7)] == [3, 1, 1, 1, 2, 2, 0]


def test_materials_name_the_labels_of_amira(tmp_path):
    path = own.amira(tmp_path / "a.am", LABELS, materials=("Exterior", "Plate", '"left Stapes"'))
    labels, grid = open_labels(path)
    assert np.array_equal(labels, LABELS)
    assert body_numbers(grid.segment_names, [1, 2, 3], None, None, "") == (2, 1)


def test_a_label_file_keeps_its_own_spacing(tmp_path):
    _, grid = open_labels(w.itk(tmp_path / "a.nii.gz", LABELS), 0.5)
    assert grid.spacing_mm == pytest.approx(SPACING)
    _, grid = open_labels(w.plain(tmp_path / "a.tif", LABELS), 0.5)
    assert grid.spacing_mm == pytest.approx([0.5] * 3)


def test_labels_must_be_whole_numbers(tmp_path):
    array = (picture("f4") > 20).astype("f4")
    labels, _ = open_labels(w.nrrd(tmp_path / "a.nrrd", array))
    assert labels.dtype.kind == "i"
    assert np.array_equal(labels, array)
    with pytest.raises(StapeskitError) as caught:
        open_labels(w.nrrd(tmp_path / "b.nrrd", array * 0.5))
    assert caught.value.faults[0].expected == "whole numbers"

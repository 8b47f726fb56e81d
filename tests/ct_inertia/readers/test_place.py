"""Spacing, origin, direction, units and order of slices, as each format tells them."""

import gzip
import json

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
from scipy.spatial.transform import Rotation

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_labels, read_volume
from legacy.ct_inertia.readers.raw_layout import RawLayout
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.writers import SPACING, check_corners, picture

TURN = Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_matrix()
ORIGIN = np.array([5.0, -6.0, 7.0])


@pytest.mark.parametrize("name", ["a.nrrd", "a.nhdr", "a.mha", "a.mhd", "a.nii", "a.nii.gz", "a.img"])
def test_direction_and_origin_are_those_of_simpleitk(tmp_path, name):
    f.itk_turned(tmp_path / name, picture(np.int16), TURN, ORIGIN)
    volume = read_volume(tmp_path / name)
    image = sitk.ReadImage(str(tmp_path / name))
    for index in ((0, 0, 0), (4, 5, 6), (4, 0, 3)):
        assert volume.scan_points(index) == pytest.approx(
            image.TransformIndexToPhysicalPoint(index), abs=1e-5
        )
    assert volume.direction == pytest.approx(TURN, abs=1e-5)


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("left-posterior-superior", (1, 1, 1)),
        ("LPS", (1, 1, 1)),
        ("right-anterior-superior", (-1, -1, 1)),
        ("RAS", (-1, -1, 1)),
        ("left-anterior-superior", (1, -1, 1)),
        ("LAS", (1, -1, 1)),
        ("scanner-xyz", (1, 1, 1)),
        ("3D-right-handed", (1, 1, 1)),
    ],
)
def test_an_nrrd_space_is_turned_into_lps(tmp_path, space, signs):
    vectors = TURN * SPACING
    if np.prod(signs) < 0:
        vectors = vectors * [1, -1, 1]
    told = " ".join("(" + ",".join(f"{v:.17g}" for v in column) + ")" for column in vectors.T)
    path = f.nrrd(
        tmp_path / "a.nrrd",
        picture(),
        spacings=None,
        space=space,
        **{"space directions": told, "space origin": "(1,2,3)", "space units": '"mm" "mm" "mm"'},
    )
    volume = read_volume(path)
    assert volume.origin_mm == pytest.approx(np.array([1, 2, 3]) * signs)
    expected = np.diag(signs) @ vectors
    assert volume.scan_from_index[:3, :3] == pytest.approx(expected)
    if space != "3D-right-handed" and space != "scanner-xyz":
        assert volume.handedness_confirmed
        image = sitk.ReadImage(str(path))
        assert volume.origin_mm == pytest.approx(image.GetOrigin())
        assert volume.direction.ravel() == pytest.approx(image.GetDirection(), abs=1e-6)


def test_nrrd_units_and_detached_data(tmp_path):
    array = picture()
    (tmp_path / "v.raw").write_bytes(b"line\n" + bytes(3) + array.tobytes())
    (tmp_path / "v.raw.gz").write_bytes(gzip.compress(array.tobytes()))
    for k, plane in enumerate(array):
        (tmp_path / f"s{k:03d}.raw").write_bytes(plane.tobytes())
    um = " ".join(f"{s * 1e3:g}" for s in SPACING)
    common = {"spacings": um, "units": '"um" "um" "um"'}
    headers = {
        "skip.nhdr": {"data file": "v.raw", "line skip": 1, "byte skip": 3},
        "back.nhdr": {"datafile": "v.raw", "byte skip": -1},
        "zip.nhdr": {"data file": "v.raw.gz", "encoding": "gzip"},
        "many.nhdr": {"data file": "s%03d.raw 0 6 1 2"},
        "list.nhdr": {"data file": "LIST 2\n" + "\n".join(f"s{k:03d}.raw" for k in range(7))},
    }
    for name, fields in headers.items():
        path = f.nrrd(tmp_path / name, array[:0], sizes="5 6 7", **common, **fields)
        path.write_text(path.read_text().rstrip() + "\n")
        volume = read_volume(path)
        assert volume.spacing_mm == pytest.approx(SPACING), name
        assert np.array_equal(np.asarray(volume.array), array), name


def test_a_metaimage_of_many_files(tmp_path):
    array = picture()
    for k, plane in enumerate(array):
        (tmp_path / f"s{k:03d}.raw").write_bytes(bytes(2) + plane.tobytes())
    names = "LIST\n" + "\n".join(f"s{k:03d}.raw" for k in range(7))
    for name, data in (("pattern.mhd", "s%03d.raw 0 6 1"), ("list.mhd", names)):
        path = f.meta(tmp_path / name, array, data=data, HeaderSize=2)
        assert np.array_equal(np.asarray(read_volume(path).array), array)
    path = f.meta(tmp_path / "size.mha", array, ElementSpacing=None, ElementSize="0.1 0.2 0.3")
    assert read_volume(path).spacing_mm == pytest.approx([0.1, 0.2, 0.3])
    path = f.meta(tmp_path / "both.mha", array, ElementSize="9 9 9", DistanceUnits="um")
    assert read_volume(path).spacing_mm == pytest.approx(SPACING * 1e-3)
    path = f.meta(tmp_path / "tif.mhd", array, data="a.tif")
    with pytest.raises(CtInertiaError, match=r"data files must be raw voxels; got a\.tif"):
        read_volume(path)


def test_nifti_sform_and_scaling(tmp_path):
    matrix = np.column_stack([np.diag([-1, -1, 1]) @ TURN * SPACING, [1.0, 2.0, 3.0]])
    volume = read_volume(f.nifti(tmp_path / "a.nii", picture(np.int16), sform=matrix))
    assert volume.handedness_confirmed
    assert volume.direction == pytest.approx(TURN, abs=1e-6)
    assert volume.origin_mm == pytest.approx([-1.0, -2.0, 3.0])
    volume = read_volume(f.nifti(tmp_path / "b.nii", picture(np.int16), slope=2.0, inter=-7.0))
    assert volume.array.dtype == np.float32
    assert np.array_equal(np.asarray(volume.array), picture() * 2.0 - 7.0)
    image = sitk.ReadImage(str(tmp_path / "b.nii"))
    assert np.array_equal(sitk.GetArrayFromImage(image), np.asarray(volume.array))
    volume = read_volume(f.nifti(tmp_path / "c.nii", picture(), unit=0))
    assert "unit_not_told" in {n.code for n in volume.notices}


@pytest.mark.parametrize("name", ["a.nrrd", "a.mha", "a.nii"])
def test_a_left_handed_direction_is_refused_and_mirror_undoes_it(tmp_path, name):
    f.itk_turned(tmp_path / name, picture(), np.diag([1.0, 1.0, -1.0]), [1.0, 2.0, 3.0])
    with pytest.raises(
        CtInertiaError, match=r"right-handed \(determinant \+1\); got the left-handed.*--mirror"
    ):
        read_volume(tmp_path / name)
    volume = read_volume(tmp_path / name, mirror="z")
    assert volume.direction == pytest.approx(np.eye(3))
    # The box stays where it was: it reached from z = 3 down; its lowest slice is now the first.
    assert volume.scan_points([0, 0, 0]) == pytest.approx([1.0, 2.0, 3.0 - 6 * SPACING[2]], abs=1e-6)
    check_corners(volume, origin=volume.origin_mm)
    other = read_volume(tmp_path / name, mirror="x")
    assert np.linalg.det(other.direction) == pytest.approx(1.0)
    assert "handedness_unconfirmed" in [notice.code for notice in other.notices]


def test_a_left_handed_space_and_a_sheared_grid_are_refused(tmp_path):
    path = f.nrrd(tmp_path / "a.nrrd", picture(), space="3D-left-handed")
    with pytest.raises(CtInertiaError, match="the space must be right-handed"):
        read_volume(path)
    sheared = np.eye(3, 4)
    sheared[0, 1] = 0.3
    with pytest.raises(CtInertiaError, match=r"orthonormal \(no shear\)"):
        read_volume(f.nifti(tmp_path / "a.nii", picture(), sform=sheared))


def test_a_given_spacing_overrides_with_a_notice(tmp_path):
    f.imagej(tmp_path / "a.tif", picture())
    volume = read_volume(tmp_path / "a.tif", 0.05)
    assert volume.spacing_mm.tolist() == [0.05] * 3
    assert "spacing_overridden" in [n.code for n in volume.notices]
    with pytest.raises(CtInertiaError, match="--spacing must be one or three positive"):
        read_volume(tmp_path / "a.tif", -1.0)
    with pytest.raises(CtInertiaError, match="--spacing must be one or three positive"):
        read_volume(tmp_path / "a.tif", (1.0, 2.0))


def test_resolution_tags_alone_do_not_tell_the_slice_distance(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", picture(), resolution=(500, 400), resolutionunit="CENTIMETER")
    with pytest.raises(CtInertiaError, match=r"0.02 x 0.025 mm in a slice but not the distance of slices"):
        read_volume(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("metadata", "known"),
    [
        ({"unit": "pixel", "spacing": 1.0}, "the ImageJ unit is pixel"),
        ({"unit": "mm", "finterval": 0.1}, r"no complete spacing \(0.02 x 0.025 mm in a slice\)"),
        ({}, "the ImageJ unit is not set"),
    ],
)
def test_an_incomplete_imagej_spacing_is_asked_for(tmp_path, metadata, known):
    x, y, _ = SPACING
    tifffile.imwrite(
        tmp_path / "a.tif",
        picture(),
        imagej=True,
        resolution=(1 / x, 1 / y),
        metadata=metadata | {"axes": "ZYX"},
    )
    with pytest.raises(CtInertiaError, match=f"{known}.*Give it in mm with --spacing"):
        read_volume(tmp_path / "a.tif")


def test_imagej_zero_and_negative_slice_distance(tmp_path):
    x, y, z = SPACING
    told = {"spacing": -z, "unit": "mm", "axes": "ZYX", "xorigin": 2.0, "zorigin": -3.0}
    tifffile.imwrite(tmp_path / "a.tif", picture(), imagej=True, resolution=(1 / x, 1 / y), metadata=told)
    volume = read_volume(tmp_path / "a.tif")
    assert volume.origin_mm == pytest.approx([-2.0 * x, 0.0, 3.0 * z])
    assert volume.spacing_mm == pytest.approx(SPACING)
    assert "negative_slice_distance" in {n.code for n in volume.notices}


def test_ome_positions_give_origin_and_missing_slice_distance(tmp_path):
    metadata = {"axes": "ZYX", "PhysicalSizeX": 20.0, "PhysicalSizeY": 25.0, "PhysicalSizeZ": 30.0}
    planes = {f"Position{axis}": [value] * 7 for axis, value in zip("XY", (1500.0, -250.0), strict=True)}
    planes["PositionZ"] = [500.0 + 30.0 * k for k in range(7)]
    planes |= {f"Position{axis}Unit": ["µm"] * 7 for axis in "XYZ"}
    tifffile.imwrite(tmp_path / "a.ome.tif", picture(), metadata=metadata | {"Plane": planes})
    assert read_volume(tmp_path / "a.ome.tif").origin_mm == pytest.approx([1.5, -0.25, 0.5])
    del metadata["PhysicalSizeZ"]
    tifffile.imwrite(tmp_path / "b.ome.tif", picture(), metadata=metadata | {"Plane": planes})
    assert read_volume(tmp_path / "b.ome.tif").spacing_mm == pytest.approx(SPACING)
    del planes["PositionZ"]
    tifffile.imwrite(tmp_path / "c.ome.tif", picture(), metadata=metadata | {"Plane": planes})
    with pytest.raises(CtInertiaError, match=r"the OME header says x 0.02 mm, y 0.025 mm"):
        read_volume(tmp_path / "c.ome.tif")


def test_slices_go_by_number_and_gaps_are_told(tmp_path):
    f.slices(tmp_path / "f", picture())
    (tmp_path / "f" / "rec_11.tif").unlink()
    tifffile.imwrite(tmp_path / "f" / "preview_001.tif", np.zeros((3, 3), np.uint8))
    volume = read_volume(tmp_path / "f", SPACING)
    assert np.array_equal(np.asarray(volume.array), np.delete(picture(), 3, axis=0))
    notices = {n.code: n.text for n in volume.notices}
    assert "number 11" in notices["slices_missing"]
    assert "files_ignored" in notices


def test_slices_in_steps_are_told(tmp_path):
    f.slices(tmp_path / "f", picture())
    for number in (9, 11, 13):
        (tmp_path / "f" / f"rec_{number}.tif").unlink()
    (notice,) = (n for n in read_volume(tmp_path / "f", SPACING).notices if n.code == "slices_in_steps")
    assert "steps of 2" in notice.text


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        ("[Reconstruction]\nPixel Size (um)=20\n", [0.02, 0.02, 0.02]),
        ("[Reconstruction]\r\nPixel Size (um)=20.0\r\nSection to Section Step=2\r\n", [0.02, 0.02, 0.04]),
        ("[Reconstruction]\nImage Pixel Size (um)=18\nPixel Size (um)=   20\n", [0.02] * 3),
        ("[Acquisition]\nImage Pixel Size (um)=9.9\nScaled Image Pixel Size (um)=20\n", [0.02] * 3),
        ("[Acquisition]\nImage Pixel Size (um)=20\n", [0.02] * 3),
    ],
)
def test_a_skyscan_log_tells_the_pixel_size(tmp_path, log, expected):
    f.skyscan(tmp_path / "f", picture())
    assert read_volume(tmp_path / "f").spacing_mm == pytest.approx([SPACING[0]] * 3)
    (tmp_path / "f" / "rec_.log").write_text(log, newline="")
    volume = read_volume(tmp_path / "f")
    assert volume.spacing_mm == pytest.approx(expected)
    assert "files_ignored" not in {n.code for n in volume.notices}


def test_dicom_rescaling_is_applied(tmp_path):
    f.dicom(tmp_path / "d", picture(np.int16), **{"0028|1052": "-1000", "0028|1053": "2"})
    volume = read_volume(tmp_path / "d")
    again = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(tmp_path / "d")))
    assert np.array_equal(np.asarray(volume.array), sitk.GetArrayFromImage(again))
    assert volume.spacing_mm == pytest.approx(SPACING)


def test_scanco_place_and_density(tmp_path):
    for write in (scanners.aim, scanners.aim30):
        volume = read_volume(write(tmp_path / "a.aim", picture(np.int16), position=(10, 20, -30)))
        assert volume.origin_mm == pytest.approx(SPACING * [10, 20, -30])
        text = {n.code: n.text for n in volume.notices}["density_in_header"]
        # 1600 mg HA/cm3 for a linear attenuation of 1/cm, stored 8192 times.
        assert "points_mg_ha_cm3 = [[0, -390], [16384, 2810]]" in text


def test_an_isq_density_in_the_extended_header(tmp_path):
    path = scanners.isq(tmp_path / "a.isq", picture(np.int16))
    data = bytearray(path.read_bytes())
    head, voxels = data[:512], data[1024:]
    head[508:512] = (6).to_bytes(4, "little")
    entry = bytearray(512)
    entry[8:24], entry[24:28] = b"Calibration     ", (2).to_bytes(4, "little")
    block = bytearray(1024)
    block[648:659] = b"mg HA/ccm\0\0"
    # 0.5 is 0x4000 in the first word of a VAX double, -390 = -1.5234375 * 2^8 is 0xC4C3.
    block[664:666], block[672:674] = (0x4000).to_bytes(2, "little"), (0xC4C3).to_bytes(2, "little")
    path.write_bytes(bytes(head + entry + bytes(0) + block + bytes(6 * 512 - 1536)) + voxels)
    volume = read_volume(path)
    assert np.array_equal(np.asarray(volume.array), picture(np.int16))
    assert "density = 0.5 * grey value / 4096 + -390 mg HA/ccm" in {
        n.code: n.text for n in volume.notices
    }.get("density_in_header", "")


def test_zarr_translations_and_missing_units(tmp_path):
    def shift(entry):
        entry["datasets"][0]["coordinateTransformations"].append(
            {"type": "translation", "translation": [3, 2, 1]}
        )
        entry["coordinateTransformations"] = [{"type": "scale", "scale": [2.0, 2.0, 2.0]}]

    for version in ("0.4", "0.5"):
        path = f.ome_zarr(tmp_path / f"{version}.zarr", picture(), version)
        f.zarr_attributes(path, shift)
        volume = read_volume(path)
        assert volume.spacing_mm == pytest.approx(2 * SPACING)
        assert volume.origin_mm == pytest.approx([0.002, 0.004, 0.006])
    path = f.ome_zarr(tmp_path / "none.zarr", picture(), unit="")
    with pytest.raises(CtInertiaError, match=r"a scale of 0.02 x 0.025 x 0.03 without a unit of length"):
        read_volume(path)
    assert read_volume(path, SPACING).spacing_mm == pytest.approx(SPACING)


def test_zarr_levels_collections_and_missing_chunks(tmp_path):
    path = f.ome_zarr(tmp_path / "a.zarr", picture())
    (level,) = read_volume(path).array.levels
    assert level.factors == (2, 2, 2)
    assert np.array_equal(np.asarray(level.array), picture()[::2, ::2, ::2])
    outer = tmp_path / "collection.zarr"
    outer.mkdir()
    (outer / ".zgroup").write_text('{"zarr_format": 2}')
    (outer / ".zattrs").write_text('{"bioformats2raw.layout": 3}')
    path.rename(outer / "0")
    assert np.array_equal(np.asarray(read_volume(outer).array), picture())
    chunk = next(p for p in (outer / "0" / "0").rglob("*") if p.is_file() and not p.name.startswith("."))
    chunk.unlink()
    notices = {n.code: n.text for n in read_volume(outer).notices}
    assert "1 of 8 chunks" in notices["chunks_not_stored"]


def test_raw_voxels_beside_a_header(tmp_path):
    array = picture()
    f.itk(tmp_path / "scan.mhd", array)
    assert np.array_equal(np.asarray(read_volume(tmp_path / "scan.raw").array), array)
    path = scanners.vgi(tmp_path / "ear.vgi", array)
    (tmp_path / "ear-0.vol").rename(tmp_path / "ear.vol")
    path.write_text(path.read_text().replace("ear-0.vol", "ear.vol"))
    assert read_volume(tmp_path / "ear.vol").spacing_mm == pytest.approx(SPACING)
    lone = f.raw(tmp_path / "lone.raw", array)
    with pytest.raises(
        CtInertiaError, match=r"in the folder of their header .* Give --shape NX,NY,NZ --dtype"
    ):
        read_volume(lone)
    with pytest.raises(CtInertiaError, match="raw voxels do not have it"):
        read_volume(lone, raw=RawLayout((5, 6, 7), "uint16"))


def test_a_layered_segmentation_becomes_one_label_volume(tmp_path):
    layered = np.zeros((7, 6, 5, 2), np.uint8)
    layered[1:4, ..., 0], layered[4:6, ..., 0], layered[3:5, ..., 1] = 1, 2, 1
    told = " ".join("(" + ",".join(f"{v:g}" for v in row) + ")" for row in np.diag(SPACING))
    text = (
        "NRRD0004\ntype: uint8\ndimension: 4\nspace: left-posterior-superior\nsizes: 2 5 6 7\n"
        f"space directions: none {told}\nkinds: list domain domain domain\nencoding: gzip\n"
        "space origin: (1,2,3)\n"
        "Segment0_LabelValue:=1\nSegment0_Layer:=0\nSegment0_Name:=stapes\n"
        "Segment1_LabelValue:=2\nSegment1_Layer:=0\nSegment1_Name:=plate\n"
        "Segment2_LabelValue:=1\nSegment2_Layer:=1\nSegment2_Name:=incus\n\n"
    )
    (tmp_path / "a.seg.nrrd").write_bytes(text.encode() + gzip.compress(layered.tobytes()))
    volume = read_labels(tmp_path / "a.seg.nrrd")
    assert volume.spacing_mm == pytest.approx(SPACING)
    assert volume.origin_mm.tolist() == [1.0, 2.0, 3.0]
    assert [int(volume.array[k, 0, 0]) for k in range(7)] == [0, 1, 1, 3, 3, 2, 0]
    assert "1 stapes, 2 plate, 3 incus" in {n.code: n.text for n in volume.notices}["segments_numbered"]


@pytest.mark.parametrize("name", ["a.seg.nrrd", "a.nii.gz", "a.mha"])
def test_label_volumes_of_slicer_and_itk_snap(tmp_path, name):
    labels = (picture(np.uint8) > 30).astype(np.uint8)
    f.itk(tmp_path / name, labels, packed=True)
    assert np.array_equal(read_labels(tmp_path / name).array, labels)


def test_json_metadata_of_the_writers_is_what_the_readers_expect(tmp_path):
    path = f.ome_zarr(tmp_path / "a.zarr", picture(), "0.5")
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    assert attributes["ome"]["multiscales"][0]["axes"][0] == {
        "name": "z",
        "type": "space",
        "unit": "micrometer",
    }

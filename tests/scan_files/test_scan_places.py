"""Spacing, origin, direction and units, as each format states them; the same rules of handedness for all."""

import gzip
from itertools import product

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import tifffile
from scipy.spatial.transform import Rotation

from ct_inertia.scan.open_scan import open_labels, open_scan
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.raw import RawLayout
from stapeskit.faults import StapeskitError
from tests.scan_files import scan_writers as w
from tests.scan_files import scanner_writers as own
from tests.scan_files.scan_writers import SPACING, picture

TURN = Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_matrix()
ORIGIN = np.array([5.0, -6.0, 7.0])


def codes(scan):
    return {notice.code for notice in scan.notices}


def read_as(scan):
    """Return the texts that say how a scan was read."""
    return [notice.text for notice in scan.notices if notice.code == "file_read"]


def refused(path, *arguments, **options):
    with pytest.raises(StapeskitError) as caught:
        open_scan(path, *arguments, **options).read()
    return caught.value.faults[0]


@pytest.mark.parametrize("name", ["a.nrrd", "a.nhdr", "zip.nrrd", "a.mha", "a.mhd", "a.nii", "a.nii.gz"])
def test_direction_and_origin_are_those_of_another_program(tmp_path, name):
    path = w.itk(tmp_path / name, picture("i2"), TURN, ORIGIN, packed="zip" in name)
    scan, image = open_scan(path), sitk.ReadImage(str(path))
    for index in ((0, 0, 0), (4, 5, 6), (4, 0, 3)):
        assert scan.scan_points(index) == pytest.approx(image.TransformIndexToPhysicalPoint(index), abs=1e-5)
    assert scan.direction == pytest.approx(TURN, abs=1e-5)
    assert scan.index_points(scan.scan_points([1.5, 2.0, 3.0])) == pytest.approx([1.5, 2.0, 3.0])


@pytest.mark.parametrize("flips", [flips for flips in product((1, -1), repeat=3) if np.prod(flips) < 0])
@pytest.mark.parametrize("name", ["a.nrrd", "zip.nrrd", "a.mha", "a.nii", "a.nii.gz"])
def test_a_left_handed_grid_is_turned_and_every_voxel_keeps_its_place(tmp_path, name, flips):
    """Of every voxel the place is that of SimpleITK, which reads left-handed grids as they are."""
    array = picture("i2")
    path = w.itk(tmp_path / name, array, TURN @ np.diag(flips), ORIGIN, packed="zip" in name)
    scan, image = open_scan(path), sitk.ReadImage(str(path))
    assert np.linalg.det(scan.direction) == pytest.approx(1.0)
    assert [notice.code for notice in scan.notices] == ["file_read"]
    assert f"its {'xyz'[np.argmin(np.diag(TURN @ np.diag(flips)))]} axis" in read_as(scan)[0]
    voxels = scan.read()
    for index in product(range(5), range(6), range(7)):
        place = image.TransformIndexToPhysicalPoint(index)
        x, y, z = np.rint(scan.index_points(place)).astype(int)
        assert scan.scan_points((x, y, z)) == pytest.approx(place, abs=1e-5)
        assert voxels[z, y, x] == array[index[::-1]]
    some = (slice(0, 7, 3), slice(1, 6, 2), slice(0, 4))
    assert np.array_equal(scan.read(some), voxels[some])


SPACES = {
    **{"left-posterior-superior": (1, 1, 1), "LPS": (1, 1, 1)},
    **{"right-anterior-superior": (-1, -1, 1), "RAS": (-1, -1, 1)},
    **{"left-anterior-superior": (1, -1, 1), "LAS": (1, -1, 1)},
    **{"scanner-xyz": (1, 1, 1), "3D-right-handed": (1, 1, 1)},
}


@pytest.mark.parametrize("space", SPACES)
def test_an_nrrd_space_becomes_lps(tmp_path, space):
    signs = SPACES[space]
    vectors = TURN * SPACING * [1, np.prod(signs), 1]
    stated = " ".join("(" + ",".join(f"{v:.17g}" for v in column) + ")" for column in vectors.T)
    fields = {"space": space, "space directions": stated, "space origin": "(1,2,3)"}
    path = w.nrrd(tmp_path / "a.nrrd", picture(), spacings=None, **fields)
    scan = open_scan(path)
    assert scan.origin_mm == pytest.approx(np.array([1, 2, 3]) * signs)
    assert scan.scan_from_index[:3, :3] == pytest.approx(np.diag(signs) @ vectors)
    assert scan.handedness_confirmed == (space not in ("scanner-xyz", "3D-right-handed"))


def test_what_no_turning_mends_is_refused(tmp_path):
    left = {"space": "3D-left-handed", "space directions": "(1,0,0) (0,1,0) (0,0,1)"}
    assert refused(w.nrrd(tmp_path / "a.nrrd", picture(), spacings=None, **left)).thing == "the space"
    sheared = np.eye(3, 4)
    sheared[0, 1] = 0.3
    fault = refused(w.nifti(tmp_path / "a.nii", picture(), sform=sheared))
    assert fault.expected == "orthonormal (no shear)"


def test_units_of_nrrd_and_metaimage(tmp_path):
    um = " ".join(f"{s * 1e3:g}" for s in SPACING)
    path = w.nrrd(tmp_path / "a.nrrd", picture(), spacings=um, units='"um" "um" "um"')
    assert open_scan(path).spacing_mm == pytest.approx(SPACING)
    unset = w.nrrd(tmp_path / "b.nrrd", picture(), spacings="NaN NaN NaN")
    assert refused(unset).thing == "the voxel spacing"
    path = w.meta(tmp_path / "a.mha", picture(), ElementSpacing=um, DistanceUnits="um", Offset="1000 0 0")
    scan = open_scan(path)
    assert scan.spacing_mm == pytest.approx(SPACING)
    assert scan.origin_mm == pytest.approx([1.0, 0.0, 0.0])
    assert [mm_per_unit(unit) for unit in ("µm", "Micron", "inch", "pixel", None)] == [
        1e-3,
        1e-3,
        25.4,
        None,
        None,
    ]


def test_detached_voxels_of_every_kind(tmp_path):
    array = picture()
    (tmp_path / "v.raw").write_bytes(bytes(8) + array.tobytes())
    (tmp_path / "v.raw.gz").write_bytes(gzip.compress(bytes(352) + array.tobytes()))
    (tmp_path / "w.raw.gz").write_bytes(gzip.compress(array.tobytes()))
    headers = {
        "skip": {"byte skip": 8, "data file": "v.raw"},
        "back": {"byte skip": -1, "data file": "v.raw"},
        "zip": {"encoding": "gzip", "data file": "w.raw.gz"},
        "zip_skip": {"encoding": "gzip", "byte skip": 352, "data file": "v.raw.gz"},
        "zip_back": {"encoding": "gzip", "byte skip": -1, "data file": "v.raw.gz"},
    }
    for name, fields in headers.items():
        scan = open_scan(w.nrrd(tmp_path / f"{name}.nhdr", array, **fields))
        assert np.array_equal(scan.read(), array), name
        assert len(scan.files) == 2, name
    for name, data, fields in (("head", "v.raw", {"HeaderSize": 8}), ("back", "v.raw", {"HeaderSize": -1})):
        scan = open_scan(w.meta(tmp_path / f"{name}.mhd", array, data=data, **fields))
        assert np.array_equal(scan.read(), array), name


def test_raw_voxels_alone_are_asked_about(tmp_path):
    lone = w.raw(tmp_path / "lone.raw", picture())
    assert "--shape" in refused(lone, SPACING).next_step
    assert refused(lone, raw=RawLayout((5, 6, 7), "uint16")).thing == "the voxel spacing"


def test_nifti_forms_and_scaling(tmp_path):
    matrix = np.column_stack([np.diag([-1, -1, 1]) @ TURN * SPACING, [1.0, 2.0, 3.0]])
    scan = open_scan(w.nifti(tmp_path / "a.nii", picture("i2"), sform=matrix))
    assert scan.direction == pytest.approx(TURN, abs=1e-6)
    assert scan.origin_mm == pytest.approx([-1.0, -2.0, 3.0])
    assert codes(scan) == set()
    scan = open_scan(w.nifti(tmp_path / "b.nii", picture("i2"), slope=2.0, inter=-7.0))
    assert scan.dtype == np.float32
    assert np.array_equal(scan.read(), picture() * 2.0 - 7.0)
    assert "length_unit_assumed" in codes(open_scan(w.nifti(tmp_path / "c.nii", picture(), unit=0)))
    for slope in (np.inf, np.nan, 0.0):  # an unusable slope means none (nifti1.h)
        assert np.array_equal(
            open_scan(w.nifti(tmp_path / "d.nii", picture(), slope=slope)).read(), picture()
        )


@pytest.mark.parametrize(("wrong", "noted"), [(None, False), ("shift", True), ("size", True)])
def test_two_places_in_a_nifti_header_are_named_where_they_differ(tmp_path, wrong, noted):
    sform = np.column_stack([np.diag(SPACING * [-1, -1, 1]), [1.0, 2.0, 3.0]])
    if wrong == "size":
        sform[:, :3] *= 2.0
    quaternion = (
        0.0,
        0.0,
        1.0,
        1.0 + (wrong == "shift"),
        2.0,
        3.0,
    )  # half a turn about z: x left, y posterior
    scan = open_scan(w.nifti(tmp_path / "a.nii", picture(), sform=sform, qform=quaternion))
    assert ("header_places_differ" in codes(scan)) == noted
    assert scan.origin_mm == pytest.approx([-1.0, -2.0, 3.0])


def test_the_spacing_of_the_user_wins_with_a_notice(tmp_path):
    w.imagej(tmp_path / "a.tif", picture())
    scan = open_scan(tmp_path / "a.tif", 0.05)
    assert scan.spacing_mm.tolist() == [0.05] * 3
    (text,) = read_as(scan)
    assert "0.05 mm" in text
    assert read_as(open_scan(tmp_path / "a.tif", SPACING)) == []
    assert refused(tmp_path / "a.tif", -1.0).thing == "the voxel spacing"


INCOMPLETE = {
    "resolution": (
        w.plain,
        {"resolution": (500, 400), "resolutionunit": "CENTIMETER"},
        "0.02 x 0.025 x ? mm",
    ),
    "printer": (w.plain, {"resolution": (300, 300), "resolutionunit": "INCH"}, "screen or printer"),
    "pixel": (w.imagej, {"metadata": {"unit": "pixel"}}, "unit is pixel"),
    "no z": (w.imagej, {"metadata": {"spacing": None, "finterval": 0.1}}, "0.02 x 0.025 x ? mm"),
    "z of 1": (w.imagej, {"metadata": {"spacing": 1.0}}, "exactly 1 unit"),
    "z of 1 um": (w.nrrd, {"spacings": "20 25 1", "units": '"um" "um" "um"'}, "exactly 1 unit (0.001 mm)"),
    "ome": (w.ome, {"metadata": {"PhysicalSizeZ": None}}, "0.02 x 0.025 x ? mm"),
}


@pytest.mark.parametrize("name", INCOMPLETE)
def test_an_incomplete_spacing_is_asked_for_with_what_is_known(tmp_path, name):
    write, options, known = INCOMPLETE[name]
    path = tmp_path / {w.ome: "a.ome.tif", w.nrrd: "a.nrrd"}.get(write, "a.tif")
    if name == "ome":
        sizes = {"PhysicalSizeX": 20.0, "PhysicalSizeY": 25.0, "axes": "ZYX"}
        tifffile.imwrite(path, picture(), metadata=sizes)
    else:
        write(path, picture(), **options)
    fault = refused(path)
    assert fault.thing == "the voxel spacing"
    assert known in fault.got
    assert "--spacing" in fault.next_step
    assert open_scan(path, SPACING).spacing_mm == pytest.approx(SPACING)


def test_imagej_zero_is_the_origin_and_a_negative_slice_distance_is_asked_about(tmp_path):
    stated = {"xorigin": 2.0, "zorigin": -3.0}
    scan = open_scan(w.imagej(tmp_path / "a.tif", picture(), metadata=stated))
    assert scan.origin_mm == pytest.approx([-2.0 * SPACING[0], 0.0, 3.0 * SPACING[2]])
    fault = refused(w.imagej(tmp_path / "b.tif", picture(), metadata={"spacing": -SPACING[2]}))
    assert (fault.thing, f"{-SPACING[2]:.6g} mm" in fault.got) == ("the voxel spacing", True)


@pytest.mark.parametrize(
    ("left_out", "code"), [([4], "slices_missing"), (range(0, 14, 2), "file_read"), ([], None)]
)
def test_labels_of_imagej_tell_slices_that_a_substack_lacks(tmp_path, left_out, code):
    numbers = [number for number in range(14) if number not in left_out][:7]
    labels = [f"rec{number:04d}.tif\nmore" for number in numbers]
    scan = open_scan(w.imagej(tmp_path / "a.tif", picture(), metadata={"Labels": labels}))
    assert codes(scan) - {"handedness_unconfirmed"} == ({code} if code else set())


@pytest.mark.parametrize("heights", [[40.0 * k for k in range(7)], [-20.0 * k for k in range(7)]])
def test_ome_planes_at_other_steps_than_the_stated_size_are_asked_about(tmp_path, heights):
    sizes = {"axes": "ZYX", "PhysicalSizeX": 20.0, "PhysicalSizeY": 25.0, "PhysicalSizeZ": 20.0}
    planes = {"PositionX": [0.0] * 7, "PositionY": [0.0] * 7, "PositionZ": heights}
    planes |= {f"Position{axis}Unit": ["µm"] * 7 for axis in "XYZ"}
    tifffile.imwrite(tmp_path / "a.ome.tif", picture(), metadata=sizes | {"Plane": planes})
    assert f"{1e-3 * heights[1]:g} mm apart" in refused(tmp_path / "a.ome.tif").got
    assert open_scan(tmp_path / "a.ome.tif", SPACING).spacing_mm == pytest.approx(SPACING)


def test_signed_slices_of_imagej_have_the_values_that_it_shows(tmp_path):
    signed = {"unit": "mm", "cf": 0, "c0": -32768.0, "c1": 1.0}
    for k, image in enumerate(picture()):
        stored = (image.astype(int) + 31768).astype("u2")
        tifffile.imwrite(tmp_path / f"{k}.tif", stored, imagej=True, resolution=(50, 40), metadata=signed)
    assert np.array_equal(open_scan(tmp_path, SPACING).read(), picture() - 1000.0)
    assert "0.02 x 0.025 x ? mm" in refused(tmp_path).got


def test_white_is_zero_is_inverted_for_scans_and_not_for_labels(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, picture("u1"), photometric="miniswhite")
    scan = open_scan(path, SPACING)
    (text,) = read_as(scan)
    assert "WhiteIsZero" in text
    assert np.array_equal(scan.read(), 255 - picture("u1"))
    labels, grid = open_labels(path, SPACING)
    assert np.array_equal(labels, picture("u1"))
    assert read_as(grid) == []


@pytest.mark.parametrize("packed", [False, True])
def test_every_dicom_slice_is_rescaled_by_its_own(tmp_path, packed):
    w.dicom(tmp_path / "d", picture("i2"), packed=packed, **{"0028|1052": "-1000", "0028|1053": "2"})
    scan = open_scan(tmp_path / "d")
    if not packed:
        again = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(tmp_path / "d")))
        assert np.array_equal(scan.read(), sitk.GetArrayFromImage(again))
    assert scan.spacing_mm == pytest.approx(SPACING)
    # The writer stores (value - offset) / slope, as a whole number.
    assert np.abs(scan.read() - picture("i2")).max() <= 1.0
    w.dicom(tmp_path / "d", picture("i2")[:1], packed=packed, **{"0028|1052": "-7", "0028|1053": "1"})
    assert np.array_equal(open_scan(tmp_path / "d").read()[0], picture("i2")[0])


@pytest.mark.parametrize(("aside_voxels", "good"), [(0.05, True), (2.0, False)])
def test_dicom_slices_beside_each_other_are_refused(tmp_path, aside_voxels, good):
    series = w.dicom(tmp_path / "d", picture("i2"))
    tags = {"0020|0032": f"{aside_voxels * SPACING[0]}\\0\\{-SPACING[2]}"}
    tags |= {"0008|0018": "1.2.826.0.1.3680043.2.1125.31.99", "0020|0013": "99"}
    (one_more,) = w.dicom(tmp_path / "e", picture("i2")[:1], **tags).iterdir()
    one_more.replace(series / "0_0.dcm")
    if good:
        assert open_scan(series).shape[0] == 8
    else:
        assert refused(series).thing == "the slices"


def without(folder, *keywords):
    for file in folder.iterdir():
        head = pydicom.dcmread(file)
        for keyword in keywords:
            delattr(head, keyword)
        head.save_as(file)
    return folder


def test_dicom_slices_without_positions_are_stacked_by_number_at_the_distance_given(tmp_path):
    array = picture("i2")
    series = without(w.dicom(tmp_path / "d", array), "ImagePositionPatient")
    fault = refused(series)
    assert (fault.thing, "--spacing" in fault.next_step) == ("the voxel spacing", True)
    scan = open_scan(series, SPACING)
    assert {"slices_missing", "handedness_unconfirmed"} <= {one.code for one in scan.notices}
    np.testing.assert_array_equal(scan.read(), array[::-1])  # numbered from the last one
    assert refused(without(series, "InstanceNumber")).thing == "the slices"


def test_zarr_translations_units_collections_and_missing_chunks(tmp_path):
    def shift(entry):
        moved = {"type": "translation", "translation": [3, 2, 1]}
        entry["datasets"][0]["coordinateTransformations"].append(moved)
        entry["coordinateTransformations"] = [{"type": "scale", "scale": [2.0, 2.0, 2.0]}]

    for version in ("0.4", "0.5"):
        path = w.ome_zarr(tmp_path / f"{version}.zarr", picture(), version)
        w.change_zarr(path, shift)
        scan = open_scan(path)
        assert scan.spacing_mm == pytest.approx(2 * SPACING)
        assert scan.origin_mm == pytest.approx([0.002, 0.004, 0.006])
    path = w.ome_zarr(tmp_path / "none.zarr", picture(), unit="")
    assert "without a unit of length" in refused(path).got
    outer = tmp_path / "collection.zarr"
    outer.mkdir()
    (outer / ".zgroup").write_text('{"zarr_format": 2}')
    (outer / ".zattrs").write_text('{"bioformats2raw.layout": 3}')
    path.rename(outer / "0")
    chunks = [p for p in (outer / "0" / "0").rglob("*") if p.is_file() and not p.name.startswith(".")]
    chunks[0].unlink()
    (text,) = read_as(open_scan(outer, SPACING))
    assert f"1 of {len(chunks)} " in text


@pytest.mark.parametrize("packed", [False, True])
def test_dicom_of_a_private_class_of_a_scanner(tmp_path, packed):
    import pydicom

    folder = w.dicom(tmp_path / "d", picture("i2"), packed=packed)
    for file in folder.iterdir():
        head = pydicom.dcmread(file)
        head.SOPClassUID = head.file_meta.MediaStorageSOPClassUID = "1.2.826.0.1.3680043.2.1125.99"
        head.RescaleSlope, head.RescaleIntercept = 2, -10
        head.save_as(file)
    assert np.array_equal(open_scan(folder).read(), 2.0 * picture("i2") - 10.0)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("kind", "line"), [("u1", ""), ("u2", ""), ("i2", ""), ("u2", "2\\-1000")])
def test_white_is_zero_is_inverted_once_in_dicom(tmp_path, kind, line, packed):
    """The library that reads the pixels exchanges bright and dark as well."""
    import pydicom

    array = picture(kind) + picture(kind).min()
    folder = w.dicom(tmp_path / "dicom", array, packed=packed)
    for file in folder.iterdir():
        stored = pydicom.dcmread(file)
        stored.PhotometricInterpretation = "MONOCHROME1"
        if line:
            stored.RescaleSlope, stored.RescaleIntercept = line.split("\\")
        stored.save_as(file)
    values, ranks = open_scan(folder).read(), array.astype(float)
    assert np.corrcoef(values.ravel(), ranks.ravel())[0, 1] == pytest.approx(-1.0)


def test_places_of_aim_files(tmp_path):
    for write in (own.aim, own.aim30):
        scan = open_scan(write(tmp_path / "a.aim", picture("i2"), position=(10, 20, -30)))
        assert scan.origin_mm == pytest.approx(SPACING * [10, 20, -30])


def test_ome_positions_give_the_origin_and_a_missing_slice_distance(tmp_path):
    sizes = {"axes": "ZYX", "PhysicalSizeX": 20.0, "PhysicalSizeY": 25.0}
    planes = {"PositionX": [1500.0] * 7, "PositionY": [-250.0] * 7}
    planes["PositionZ"] = [500.0 + 30.0 * k for k in range(7)]
    planes |= {f"Position{axis}Unit": ["µm"] * 7 for axis in "XYZ"}
    for k, more in enumerate(({"PhysicalSizeZ": 30.0}, {})):
        path = tmp_path / f"{k}.ome.tif"
        tifffile.imwrite(path, picture(), metadata=sizes | more | {"Plane": planes})
        scan = open_scan(path)
        assert scan.origin_mm == pytest.approx([1.5, -0.25, 0.5])
        assert scan.spacing_mm == pytest.approx(SPACING)


def test_imagej_values_are_those_that_it_shows(tmp_path):
    """Signed 16-bit pictures are stored 32768 higher, with the line back in the description."""
    line = {"cf": 0, "c0": -32768.0, "c1": 1.0}
    path = w.imagej(tmp_path / "a.tif", picture(), metadata=line)
    assert np.array_equal(open_scan(path).read(), picture().astype(float) - 32768.0)
    w.imagej(path, picture(), metadata={"cf": 3})
    (text,) = [notice.text for notice in open_scan(path).notices if notice.code == "file_read"]
    assert "by its function 3" in text

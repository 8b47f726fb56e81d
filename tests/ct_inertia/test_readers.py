"""One contract for all readers: the same voxels at the same places, and one sentence for each bad file."""

import locale
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from ct_inertia.errors import CtInertiaError
from ct_inertia.read import read_volume
from ct_inertia.readers.checks import check_size

SPACING = np.array([0.02, 0.025, 0.03])
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
# The corners of the picture carry their own names: which of low/high x, y, z they are.
CORNERS = {(i, j, k): 40 + 10 * i + 20 * j + 40 * k for i in (0, 1) for j in (0, 1) for k in (0, 1)}


def picture(dtype=np.uint16):
    array = np.random.default_rng(1).integers(0, 30, (7, 6, 5)).astype(dtype)
    for (i, j, k), value in CORNERS.items():
        array[-k, -j, -i] = value
    return array


def check_corners(volume, spacing=SPACING, origin=(0, 0, 0), mirrored=""):
    far = (np.array([5, 6, 7]) - 1) * spacing
    for corner, value in CORNERS.items():
        named = [1 - c if axis in mirrored else c for c, axis in zip(corner, "xyz", strict=True)]
        index = np.rint(volume.index_points(np.array(origin) + far * named)).astype(int)
        assert volume.array[tuple(index[::-1])] == value


def imagej(path, array, unit="mm", **options):
    scale = {"mm": 1.0, "um": 1e3, "cm": 0.1, "inch": 1 / 25.4, "\\u00B5m": 1e3}[unit]
    x, y, z = SPACING * scale
    tifffile.imwrite(
        path,
        array,
        imagej=True,
        resolution=(1 / x, 1 / y),
        metadata={"spacing": z, "unit": unit, "axes": "ZYX"},
        **options,
    )


def ome(path, array, **options):
    metadata = {"axes": "ZYX"}
    for axis, value in zip("XYZ", SPACING, strict=True):
        metadata |= {f"PhysicalSize{axis}": value * 1e3, f"PhysicalSize{axis}Unit": "µm"}
    tifffile.imwrite(path, array, metadata=metadata, **options)


def itk(path, array, **options):
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(SPACING.tolist())
    sitk.WriteImage(image, str(path), **options)


def slices(path, array):
    path.mkdir()
    for k, image in enumerate(array):
        tifffile.imwrite(path / f"rec_{k + 8}.tif", image)
    (path / "rec.log").write_text("not an image")


def dicom(path, array):
    before = locale.setlocale(locale.LC_ALL)  # the DICOM writer sets it to "C"
    path.mkdir()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k, image in enumerate(array):
        slice_ = sitk.GetImageFromArray(image.astype(np.int16)[None])
        slice_.SetSpacing(SPACING.tolist())
        slice_.SetOrigin([0, 0, k * SPACING[2]])
        for tag, value in {
            "0008|0060": "CT",
            "0020|000e": "1.2.826.0.1.3680043.2.1125.1",
            "0020|000d": "1.2.826.0.1.3680043.2.1125.2",
            "0008|0018": f"1.2.826.0.1.3680043.2.1125.3.{k}",
            "0020|0032": f"0\\0\\{k * SPACING[2]}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0020|0013": str(len(array) - k),
        }.items():
            slice_.SetMetaData(tag, value)
        writer.SetFileName(str(path / f"{9 - k}.dcm"))
        writer.Execute(slice_)
    locale.setlocale(locale.LC_ALL, before)


def skyscan(path, array):
    slices(path, array)
    size = SPACING[0] * 1e3
    (path / "rec_.log").write_text(
        f"[Acquisition]\nImage Pixel Size (um)=9.9\n[Reconstruction]\nPixel Size (um)={size}\n"
    )


def isq(path, array):
    head = bytearray(1024)
    head[:16] = b"CTDATA-HEADER_V1"
    head[44:68] = np.array([5, 6, 7, 100, 150, 210], "<i4").tobytes()
    head[508:512] = np.array([1], "<i4").tobytes()
    path.write_bytes(bytes(head) + array.astype("<i2").tobytes())


def aim(path, array):
    """Version 020: voxel size as VAX F floats, a log between header and data."""
    log = b"! Processing Log\n"
    image = np.zeros(35, "<i4")
    image[[0, 5]] = 16, 0x20002
    image[9:12] = 5, 6, 7
    halves = (SPACING * 4).astype("<f4").view("<u2").reshape(3, 2)[:, ::-1]
    image[27:30] = np.ascontiguousarray(halves).view("<i4").ravel()
    head = np.array([20, 140, len(log), array.size * 2, 0], "<i4").tobytes()
    path.write_bytes(head + image.tobytes() + log + array.astype("<i2").tobytes())


FORMATS = {
    "imagej.tif": (imagej, {}, False, False),
    "imagej_um.tif": (imagej, {"unit": "um"}, False, False),
    "imagej_mu.tif": (imagej, {"unit": "\\u00B5m"}, False, False),
    "imagej_cm.tif": (imagej, {"unit": "cm"}, False, False),
    "imagej_inch.tif": (imagej, {"unit": "inch"}, False, False),
    "imagej_zip.tif": (imagej, {"compression": "zlib"}, False, False),
    "ome.ome.tif": (ome, {}, False, False),
    "ome_big.ome.tif": (ome, {"bigtiff": True, "byteorder": ">"}, False, False),
    "ome_tiled.ome.tif": (ome, {"tile": (16, 16), "compression": "zlib"}, False, False),
    "plain.tif": (tifffile.imwrite, {}, True, False),
    "plain_big_endian.tif": (tifffile.imwrite, {"byteorder": ">"}, True, False),
    "plain_rows.tif": (tifffile.imwrite, {"rowsperstrip": 2, "metadata": None}, True, False),
    "a.nrrd": (itk, {}, False, True),
    "a_zip.nrrd": (itk, {"useCompression": True}, False, True),
    "a.mha": (itk, {}, False, True),
    "a.mhd": (itk, {}, False, True),
    "a.nii": (itk, {}, False, True),
    "a.nii.gz": (itk, {}, False, True),
    "folder": (slices, {}, True, False),
    "a.isq": (isq, {}, False, False),
    "a.AIM": (aim, {}, False, False),
    "dicom": (dicom, {}, False, True),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_tells_the_same_volume(tmp_path, name):
    write, options, asks, confirmed = FORMATS[name]
    write(tmp_path / name, picture(), **options)
    volume = read_volume(tmp_path / name, SPACING if asks else None)
    assert volume.array.shape == (7, 6, 5)
    assert volume.spacing_mm == pytest.approx(SPACING, rel=1e-6)
    assert np.array_equal(volume.array, picture())
    check_corners(volume)
    assert volume.handedness_confirmed == confirmed
    assert ("handedness_unconfirmed" in [n.code for n in volume.notices]) != confirmed
    if asks:
        with pytest.raises(CtInertiaError, match=r"the voxel spacing must be in the file.*--spacing"):
            read_volume(tmp_path / name)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
@pytest.mark.parametrize("name", ["a.tif", "a.nrrd", "a.mha", "a.nii"])
def test_grey_values_keep_their_type(tmp_path, dtype, name):
    write = tifffile.imwrite if name.endswith(".tif") else itk
    write(tmp_path / name, picture(dtype))
    volume = read_volume(tmp_path / name, SPACING)
    assert volume.array.dtype == dtype
    assert np.array_equal(volume.array, picture(dtype))


def test_an_uncompressed_stack_is_memory_mapped(tmp_path):
    imagej(tmp_path / "a.tif", picture())
    assert isinstance(read_volume(tmp_path / "a.tif").array, np.memmap)


@pytest.mark.parametrize("axis", "xyz")
def test_mirror_undoes_a_reversed_stack(tmp_path, axis):
    imagej(tmp_path / "a.tif", picture())
    volume = read_volume(tmp_path / "a.tif", mirror=axis)
    check_corners(volume, mirrored=axis)
    with pytest.raises(CtInertiaError, match="--mirror must be x, y or z"):
        read_volume(tmp_path / "a.tif", mirror="u")


def test_direction_and_origin_are_honoured(tmp_path):
    image = sitk.GetImageFromArray(picture())
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin([5.0, -6.0, 7.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    image.SetDirection(turn.ravel().tolist())
    for name in ("a.nrrd", "a.mha", "a.nii"):
        sitk.WriteImage(image, str(tmp_path / name))
        volume = read_volume(tmp_path / name)
        expected = image.TransformIndexToPhysicalPoint((4, 5, 6))
        assert volume.scan_points([4, 5, 6]) == pytest.approx(expected, abs=1e-5)
        assert volume.direction == pytest.approx(turn, abs=1e-6)


def test_a_left_handed_direction_is_refused_and_mirror_undoes_it(tmp_path):
    image = sitk.GetImageFromArray(picture())
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin([1.0, 2.0, 3.0])
    image.SetDirection([1.0, 0, 0, 0, 1, 0, 0, 0, -1])
    sitk.WriteImage(image, str(tmp_path / "a.nrrd"))
    with pytest.raises(
        CtInertiaError, match=r"right-handed \(determinant \+1\); got the left-handed.*--mirror"
    ):
        read_volume(tmp_path / "a.nrrd")
    volume = read_volume(tmp_path / "a.nrrd", mirror="z")
    assert volume.direction == pytest.approx(np.eye(3))
    # The box stays where it was: it reached from z = 3 down; its lowest slice is now the first.
    assert volume.scan_points([0, 0, 0]) == pytest.approx([1.0, 2.0, 3.0 - 6 * SPACING[2]])
    check_corners(volume, origin=volume.origin_mm)
    other = read_volume(tmp_path / "a.nrrd", mirror="x")
    assert np.linalg.det(other.direction) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", "xyz")
def test_mirror_works_alike_in_every_format(tmp_path, axis):
    itk(tmp_path / "a.mha", picture())
    check_corners(read_volume(tmp_path / "a.mha", mirror=axis), mirrored=axis)


def test_a_given_spacing_overrides_with_a_notice(tmp_path):
    imagej(tmp_path / "a.tif", picture())
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


def test_slices_go_by_number_and_gaps_are_told(tmp_path):
    slices(tmp_path / "f", picture())
    (tmp_path / "f" / "rec_11.tif").unlink()
    tifffile.imwrite(tmp_path / "f" / "preview_001.tif", np.zeros((3, 3), np.uint8))
    volume = read_volume(tmp_path / "f", SPACING)
    assert np.array_equal(volume.array, np.delete(picture(), 3, axis=0))
    notices = {n.code: n.text for n in volume.notices}
    assert "number 11" in notices["slices_missing"]
    assert "files_ignored" in notices


def test_bad_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(CtInertiaError, match="a series of numbered slices"):
        read_volume(tmp_path / "empty", 0.02)
    slices(tmp_path / "f", picture())
    tifffile.imwrite(tmp_path / "f" / "rec_9.tif", np.zeros((4, 4), np.uint16))
    with pytest.raises(CtInertiaError, match=r"slice rec_9.tif must be 5 x 6 uint16 like rec_8.tif"):
        read_volume(tmp_path / "f", 0.02)
    (tmp_path / "f" / "rec_9.tif").write_bytes(b"nothing")
    with pytest.raises(CtInertiaError, match="readable slice image"):
        read_volume(tmp_path / "f", 0.02)
    tifffile.imwrite(tmp_path / "f" / "rec_09.tif", picture()[0])
    with pytest.raises(CtInertiaError, match="slice numbers must be unique; got number 9 twice"):
        read_volume(tmp_path / "f", 0.02)


def test_dicom_with_a_missing_slice_is_refused(tmp_path):
    dicom(tmp_path / "d", picture())
    (tmp_path / "d" / "5.dcm").unlink()
    with pytest.raises(CtInertiaError, match="distance of DICOM slices must be even"):
        read_volume(tmp_path / "d")


def test_a_skyscan_log_tells_the_pixel_size(tmp_path):
    skyscan(tmp_path / "f", picture())
    assert read_volume(tmp_path / "f").spacing_mm == pytest.approx([SPACING[0]] * 3)


def test_bad_scanco_files(tmp_path):
    isq(tmp_path / "a.isq", picture())
    data = (tmp_path / "a.isq").read_bytes()
    (tmp_path / "short.isq").write_bytes(data[:-10])
    with pytest.raises(CtInertiaError, match="as large as its header says"):
        read_volume(tmp_path / "short.isq")
    (tmp_path / "head.isq").write_bytes(data[:100])
    with pytest.raises(CtInertiaError, match="at least 512 bytes"):
        read_volume(tmp_path / "head.isq")
    (tmp_path / "zero.isq").write_bytes(data[:44] + bytes(12) + data[56:])
    with pytest.raises(CtInertiaError, match="size in the header must be positive"):
        read_volume(tmp_path / "zero.isq")
    (tmp_path / "other.isq").write_bytes(b"something else")
    with pytest.raises(CtInertiaError, match="a Scanco ISQ or AIM file"):
        read_volume(tmp_path / "other.isq")
    (tmp_path / "new.aim").write_bytes(b"AIMDATA_V030   " + bytes(300))
    with pytest.raises(CtInertiaError, match="of version 020; got version 030"):
        read_volume(tmp_path / "new.aim")
    aim(tmp_path / "a.aim", picture())
    packed = bytearray((tmp_path / "a.aim").read_bytes())
    packed[40:44] = np.array([0x00080002], "<i4").tobytes()
    (tmp_path / "packed.aim").write_bytes(bytes(packed))
    with pytest.raises(CtInertiaError, match="not packed; got type 0x80002"):
        read_volume(tmp_path / "packed.aim")


BAD_TIFF = {
    "flat.tif": (picture()[0], {}, "three-dimensional; got an image of shape 5 x 6"),
    "rgb.tif": (np.zeros((4, 6, 5, 3), np.uint8), {"photometric": "rgb"}, "colour"),
    "complex.tif": (picture().astype(np.complex64), {}, "complex"),
    "constant.tif": (np.full((5, 6, 7), 7, np.uint8), {"photometric": "minisblack"}, "got 7 in every voxel"),
    "channels.tif": (
        np.zeros((3, 2, 6, 5), np.uint8),
        {"imagej": True, "metadata": {"axes": "ZCYX"}},
        "one stack",
    ),
}


@pytest.mark.parametrize("name", BAD_TIFF)
def test_bad_tiff_content(tmp_path, name):
    array, options, message = BAD_TIFF[name]
    tifffile.imwrite(tmp_path / name, array, **options)
    with pytest.raises(CtInertiaError, match=message):
        read_volume(tmp_path / name, 0.02)


@pytest.mark.parametrize("options", [{}, {"compression": "zlib", "metadata": None}, {"imagej": True}])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_truncated_tiff(tmp_path, options, share):
    noise = np.random.default_rng(0).integers(0, 60000, (20, 40, 40)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", noise, **options)
    data = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "b.tif").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(CtInertiaError, match=r"must be .*b\.tif\)\. .*[Cc]opy or export it again\.$") as told:
        read_volume(tmp_path / "b.tif", 0.02)
    assert not any(word in str(told.value) for word in ("Error", "tifffile", "corrupt", "series", "TiffTag"))


@pytest.mark.parametrize("name", ["a.nrrd", "a.mha", "a.nii", "a_zip.nrrd", "a.nii.gz"])
def test_truncated_headers_and_data(tmp_path, name):
    noise = np.random.default_rng(0).integers(0, 60000, (20, 40, 40)).astype(np.uint16)
    itk(tmp_path / name, noise, useCompression="zip" in name)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(len(data) * 0.6)])
    with pytest.raises(CtInertiaError, match="must be"):
        read_volume(tmp_path / name)


def test_a_lying_header_is_refused_before_allocation(tmp_path):
    itk(tmp_path / "a.mha", picture())
    data = (tmp_path / "a.mha").read_bytes().replace(b"DimSize = 5 6 7", b"DimSize = 50000 60000 70000")
    (tmp_path / "b.mha").write_bytes(data)
    with pytest.raises(
        CtInertiaError, match=r"as large as its header says .50000 x 60000 x 70000 voxels, 420 TB"
    ):
        read_volume(tmp_path / "b.mha")
    with pytest.raises(CtInertiaError, match="small enough to unpack"):
        check_size((10**4, 10**4, 10**5), np.dtype("u2"), 10**12, True, "x.tif")


def test_header_without_spacing_or_data(tmp_path):
    itk(tmp_path / "a.mhd", picture())
    text = (tmp_path / "a.mhd").read_text(encoding="utf-8")
    (tmp_path / "b.mhd").write_text("\n".join(x for x in text.splitlines() if "Spacing" not in x))
    with pytest.raises(CtInertiaError, match="--spacing"):
        read_volume(tmp_path / "b.mhd")
    (tmp_path / "a.raw").unlink()
    with pytest.raises(CtInertiaError, match=r"beside its data file; got no a\.raw"):
        read_volume(tmp_path / "a.mhd")


def test_colour_vector_and_flat_images_in_open_formats(tmp_path):
    sitk.WriteImage(sitk.GetImageFromArray(picture()[0]), str(tmp_path / "flat.nrrd"))
    with pytest.raises(CtInertiaError, match="three-dimensional"):
        read_volume(tmp_path / "flat.nrrd", 0.02)
    vector = sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), np.uint8), isVector=True)
    sitk.WriteImage(vector, str(tmp_path / "v.nrrd"))
    with pytest.raises(CtInertiaError, match="one grey value per voxel; got 3"):
        read_volume(tmp_path / "v.nrrd", 0.02)


def test_not_finite_voxels(tmp_path):
    array = picture(np.float32)
    array[3, 3, 3] = np.nan
    array[3, 3, 4] = np.inf
    tifffile.imwrite(tmp_path / "a.tif", array)
    with pytest.raises(CtInertiaError, match=r"finite; got 2 voxels .*--nan-as-air"):
        read_volume(tmp_path / "a.tif", 0.02)
    assert read_volume(tmp_path / "a.tif", 0.02, nan_as_air=True).nan_as_air


def test_files_that_are_no_scans(tmp_path):
    with pytest.raises(CtInertiaError, match="an existing file or folder"):
        read_volume(tmp_path / "none.tif")
    (tmp_path / "empty.tif").write_bytes(b"")
    with pytest.raises(CtInertiaError, match="an empty file"):
        read_volume(tmp_path / "empty.tif")
    (tmp_path / "junk.tif").write_bytes(b"hello world")
    with pytest.raises(CtInertiaError, match="readable TIFF"):
        read_volume(tmp_path / "junk.tif")
    (tmp_path / "a.doc").write_bytes(b"hello world")
    with pytest.raises(CtInertiaError, match="a TIFF, NRRD, MHA, MHD, NIfTI, ISQ or AIM"):
        read_volume(tmp_path / "a.doc")
    (tmp_path / "junk.nrrd").write_bytes(b"NRRD0004\nhello world")
    with pytest.raises(CtInertiaError, match="readable volume"):
        read_volume(tmp_path / "junk.nrrd")


@pytest.mark.shared
def test_real_files_of_one_scan_agree():
    arrays = [read_volume(SHARED / "scanco" / f"test_{n}.{n}") for n in ("mha", "nrrd")]
    arrays.append(read_volume(SHARED / "scanco" / "test_nii.nii"))
    arrays.append(read_volume(SHARED / "scanco" / "test_aim.AIM"))
    arrays.append(read_volume(SHARED / "scanco" / "test_isq.ISQ"))
    for volume in arrays:
        # An ISQ rounds the extent of its 25 voxels to whole micrometres.
        assert volume.spacing_mm == pytest.approx([0.0607] * 3, abs=0.5e-3 / 25)
        assert np.array_equal(np.asarray(volume.array, float), np.asarray(arrays[0].array, float))


@pytest.mark.shared
def test_real_folder_of_slices():
    with pytest.raises(CtInertiaError, match="--spacing"):
        read_volume(SHARED / "lhdl_bone")
    volume = read_volume(SHARED / "lhdl_bone", 0.0195)
    assert volume.array.shape == (200, 200, 200)
    assert np.mean(volume.array > 63) == pytest.approx(0.228, abs=0.001)

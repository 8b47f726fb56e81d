"""Files that are unusual and right: made after the descriptions of their formats, read as they are meant."""

import bz2
import gzip
import os
import struct
import zlib

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import zarr
from PIL import Image

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_labels, read_volume
from legacy.stapeskit.provenance import content_hash
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.writers import SPACING, check_corners, picture


def read_back(path, array, **options):
    volume = read_volume(path, SPACING, **options)
    assert np.array_equal(np.asarray(volume.array), array)
    return volume


def test_a_thumbnail_before_the_stack_is_passed_over(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(np.zeros((3, 3), np.uint8), subfiletype=1, metadata=None)
        for image in picture():
            writer.write(image, metadata=None, contiguous=False)
    volume = read_back(tmp_path / "a.tif", picture())
    assert "first_series_read" in {notice.code for notice in volume.notices}


def lookup_table(brightness):
    return np.tile(np.asarray(brightness, np.uint16), (3, 1))


@pytest.mark.parametrize("folder", [True, False])
def test_numbers_of_a_lookup_table_are_grey_values_where_larger_is_brighter(tmp_path, folder):
    def write(name, table):
        (tmp_path / name).mkdir()
        options = {"photometric": "palette", "colormap": table}
        if folder:
            for k, image in enumerate(picture("u1")):
                tifffile.imwrite(tmp_path / name / f"{k}.tif", image, **options)
            return tmp_path / name
        tifffile.imwrite(tmp_path / name / "a.tif", picture("u1"), **options)
        return tmp_path / name / "a.tif"

    read_back(write("grey", lookup_table(np.arange(256) * 257)), picture("u1"))
    mixed = np.random.default_rng(1).permutation(256) * 257
    with pytest.raises(CtInertiaError, match="numbers of colours"):
        read_volume(write("mixed", lookup_table(mixed)), SPACING)


def test_pictures_with_opacity_or_three_equal_values(tmp_path):
    (tmp_path / "opacity").mkdir()
    (tmp_path / "three").mkdir()
    for k, image in enumerate(picture("u1")):
        bands = [Image.fromarray(image), Image.new("L", image.shape[::-1], 255)]
        Image.merge("LA", bands).save(tmp_path / "opacity" / f"{k}.png")
    for k, image in enumerate(picture("u2")):
        tifffile.imwrite(
            tmp_path / "three" / f"{k}.tif", np.repeat(image[..., None], 3, 2), photometric="rgb"
        )
    read_back(tmp_path / "opacity", picture("u1"))
    read_back(tmp_path / "three", picture("u2"))


@pytest.mark.parametrize("pattern", ["ear_{:03d}_8bit", "ear_z{}_c001", "2024-03-01 ear 2 {}", "{:02d}"])
def test_the_number_that_differs_counts_the_slices(tmp_path, pattern):
    for k, image in enumerate(picture()):
        tifffile.imwrite(tmp_path / f"{pattern.format(k + 7)}.tif", image)
    read_back(tmp_path, picture())


def test_two_series_are_refused_whichever_number_counts_slices(tmp_path):
    for k, image in enumerate(picture()):
        for channel in (1, 2):
            tifffile.imwrite(tmp_path / f"ear_c{channel}_{k}_8bit.tif", image)
    with pytest.raises(CtInertiaError, match=r"one series of numbered slices; got ear_c1_#_8bit\.tif"):
        read_volume(tmp_path, SPACING)


@pytest.mark.parametrize("packed", [False, True])
def test_nifti_voxels_at_byte_0_follow_the_header(tmp_path, packed):
    content = bytearray(f.nifti(tmp_path / "a.nii", picture()).read_bytes())
    for offset, fine in ((0.0, True), (100.0, False)):
        struct.pack_into("<f", content, 108, offset)
        path = tmp_path / ("a.nii.gz" if packed else "a.nii")
        path.write_bytes(gzip.compress(bytes(content)) if packed else bytes(content))
        if fine:
            read_back(path, picture())
            continue
        with pytest.raises(CtInertiaError, match="voxels at byte 100, within its header"):
            read_volume(path)


def test_packed_slabs_of_a_detached_header(tmp_path):
    for k, image in enumerate(picture()):
        (tmp_path / f"s{k}.gz").write_bytes(gzip.compress(image.tobytes()))
    fields = {"encoding": "gzip", "data file": "s%d.gz 0 6 1"}
    volume = read_volume(f.nrrd(tmp_path / "a.nhdr", picture(), **fields))
    assert np.array_equal(np.asarray(volume.array), picture())
    check_corners(volume)
    (tmp_path / "s3.gz").write_bytes(gzip.compress(picture()[3].tobytes()[:-2]))
    with pytest.raises(CtInertiaError, match="packed volume must be complete"):
        np.asarray(read_volume(tmp_path / "a.nhdr").array)


def test_numbers_in_words_that_the_voxels_cannot_hold(tmp_path):
    path = f.nrrd(tmp_path / "a.nrrd", picture(), encoding="txt")
    content = path.read_bytes()
    for word in (b"70000", b"-1", b"2.5", b"x", b"nan"):
        path.write_bytes(content.replace(b"\n\n", b"\n\n" + word + b" ", 1))
        with pytest.raises(CtInertiaError, match="a readable text file"):
            read_volume(path)


def test_materials_name_the_labels_of_amira(tmp_path):
    path = scanners.amira(
        tmp_path / "a.am", picture("u1"), form="HxByteRLE", materials=("Exterior", "Plate", '"left Stapes"')
    )
    labels = read_labels(path)
    assert np.array_equal(labels.array, picture("u1"))
    assert labels.segment_names == {0: "Exterior", 1: "Plate", 2: "left Stapes"}


def test_amira_runs_of_every_length(tmp_path):
    array = np.zeros((20, 20, 20), np.uint8)
    array[5:9] = np.random.default_rng(1).integers(0, 3, (4, 20, 20))
    array[12, 3:, 4:] = np.arange(17 * 16, dtype=np.uint16).reshape(17, 16) % 251
    read_back(scanners.amira(tmp_path / "a.am", array, form="HxByteRLE"), array)


def element(group, number, kind, value):
    value = value.encode() if isinstance(value, str) else value
    value += b"\0" * (len(value) % 2)
    long = kind in ("OW", "SQ")
    length = struct.pack("<HI", 0, len(value)) if long else struct.pack("<H", len(value))
    return struct.pack("<HH", group, number) + kind.encode() + length + value


def item(*elements):
    content = b"".join(elements)
    return struct.pack("<HHI", 0xFFFE, 0xE000, len(content)) + content


def enhanced(array, heights):
    """An Enhanced CT image whose frames lie at these heights (DICOM PS3.3, A.38 and C.7.6.16)."""
    kind = "1.2.840.10008.5.1.4.1.1.2.1"
    numbers = {0x10: array.shape[1], 0x11: array.shape[2], 0x100: 16, 0x101: 16, 0x102: 15, 0x103: 0}
    shared = item(
        element(0x28, 0x9110, "SQ", item(element(0x28, 0x30, "DS", f"{SPACING[1]}\\{SPACING[0]}"))),
        element(0x20, 0x9116, "SQ", item(element(0x20, 0x37, "DS", "1\\0\\0\\0\\1\\0"))),
    )
    frames = [
        item(element(0x20, 0x9113, "SQ", item(element(0x20, 0x32, "DS", f"1\\2\\{z:g}")))) for z in heights
    ]
    meta = (
        element(2, 2, "UI", kind) + element(2, 3, "UI", "1.2.3") + element(2, 16, "UI", "1.2.840.10008.1.2.1")
    )
    return b"".join(
        [
            bytes(128) + b"DICM" + element(2, 0, "UL", struct.pack("<I", len(meta))) + meta,
            element(8, 0x16, "UI", kind) + element(8, 0x18, "UI", "1.2.3") + element(8, 0x60, "CS", "CT"),
            element(0x28, 0x02, "US", struct.pack("<H", 1)) + element(0x28, 0x04, "CS", "MONOCHROME2 "),
            element(0x28, 0x08, "IS", str(len(array))),
            *(element(0x28, n, "US", struct.pack("<H", v)) for n, v in numbers.items()),
            element(0x5200, 0x9229, "SQ", shared),
            element(0x5200, 0x9230, "SQ", b"".join(frames)),
            element(0x7FE0, 0x10, "OW", array.astype("<u2").tobytes()),
        ]
    )


def test_frames_from_the_far_end_to_the_near_one_stay_where_they_are(tmp_path):
    heights = 3.0 + SPACING[2] * np.arange(7)
    (tmp_path / "up.dcm").write_bytes(enhanced(picture(), heights))
    (tmp_path / "down.dcm").write_bytes(enhanced(picture()[::-1], heights[::-1]))
    for name in ("up.dcm", "down.dcm"):
        volume = read_volume(tmp_path / name)
        assert np.array_equal(np.asarray(volume.array), picture())
        assert volume.origin_mm == pytest.approx([1.0, 2.0, 3.0])
        assert volume.direction == pytest.approx(np.eye(3))
        assert volume.spacing_mm == pytest.approx(SPACING)


@pytest.mark.parametrize(("aside_voxels", "good"), [(0.05, True), (2.0, False)])
def test_dicom_slices_beside_each_other_are_refused(tmp_path, aside_voxels, good):
    series = f.dicom(tmp_path / "d", picture(np.int16))
    place = f"{aside_voxels * SPACING[0]}\\0\\{-SPACING[2]}"
    tags = {"0020|0032": place, "0008|0018": "1.2.826.0.1.3680043.2.1125.31.99", "0020|0013": "99"}
    (one_more,) = f.dicom(tmp_path / "e", picture(np.int16)[:1], **tags).iterdir()
    one_more.replace(series / "0_0.dcm")
    if good:
        assert read_volume(series).array.shape[0] == 1 + len(picture(np.int16))
        return
    with pytest.raises(CtInertiaError) as caught:
        read_volume(series)
    assert [fault.thing for fault in caught.value.faults] == ["the slices of the series"]


def test_the_first_versions_of_ome_zarr_have_no_axes(tmp_path):
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    array = group.create_array("0", shape=(1, 1, 7, 6, 5), dtype="u2", chunks=(1, 1, 4, 4, 4))
    array[...] = picture()[None, None]
    group.attrs["multiscales"] = [{"version": "0.1", "datasets": [{"path": "0"}]}]
    read_back(tmp_path / "a.zarr", picture())


def test_a_stream_that_becomes_longer_than_its_volume_fills_the_volume_only(tmp_path):
    path = f.nrrd(tmp_path / "a.nrrd", picture(), encoding="gzip")
    head = path.read_bytes().split(b"\n\n")[0] + b"\n\n"
    path.write_bytes(head + gzip.compress(picture().tobytes() + bytes(1 << 20)))
    read_back(path, picture())
    path = scanners.amira(tmp_path / "a.am", picture(), form="HxZip")
    path.write_bytes(path.read_bytes().rpartition(b"@1\n")[0] + b"@1\n" + zlib.compress(bytes(1 << 20)))
    with pytest.raises(CtInertiaError, match="differing grey values"):
        read_volume(path)


def test_a_folder_may_hold_names_that_are_no_utf_8(tmp_path):
    f.slices(tmp_path / "scan", picture())
    before = content_hash(tmp_path / "scan")
    (tmp_path / "scan" / os.fsdecode(b"Pr\xe4parat.txt")).write_text("a note in Latin-1")
    assert content_hash(tmp_path / "scan") != before
    read_back(tmp_path / "scan", picture())


def nifti_2(array, spacing, order="<"):
    """A header of NIfTI-2 (nifti2.h) with a quaternion, and its voxels."""
    head = bytearray(544)
    struct.pack_into(order + "i", head, 0, 540)
    head[4:12] = b"n+2\0\r\n\x1a\n"
    struct.pack_into(order + "2h", head, 12, 512, 16)
    struct.pack_into(order + "8q", head, 16, 3, *array.shape[::-1], 1, 1, 1, 1)
    struct.pack_into(order + "8d", head, 104, 1.0, *spacing, 0, 0, 0, 0)
    struct.pack_into(order + "q", head, 168, 544)
    struct.pack_into(order + "2i", head, 344, 1, 0)
    struct.pack_into(order + "6d", head, 352, *QUATERNION, 1.0, 2.0, 3.0)
    struct.pack_into(order + "i", head, 500, 2)
    return bytes(head) + array.astype(array.dtype.newbyteorder(order)).tobytes()


QUATERNION = (0.0, 0.0, np.sin(np.radians(15.0)))
# A turn of 30 degrees about z in RAS, seen in LPS: nifti1.h, method 2.
TURN = np.array([[-np.cos(np.pi / 6), 0.5, 0.0], [-0.5, -np.cos(np.pi / 6), 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("order", ["<", ">"])
def test_nifti_2_placed_by_a_quaternion(tmp_path, order):
    (tmp_path / "a.nii").write_bytes(nifti_2(picture(), SPACING, order))
    volume = read_volume(tmp_path / "a.nii")
    assert np.array_equal(np.asarray(volume.array), picture())
    assert volume.spacing_mm == pytest.approx(SPACING)
    assert volume.origin_mm == pytest.approx([-1.0, -2.0, 3.0])
    assert volume.direction == pytest.approx(TURN)
    assert volume.handedness_confirmed


def test_nifti_1_placed_by_a_quaternion_as_other_programs_place_it(tmp_path):
    content = bytearray(f.nifti(tmp_path / "a.nii", picture()).read_bytes())
    struct.pack_into("<2h", content, 252, 1, 0)
    struct.pack_into("<6f", content, 256, *QUATERNION, 1.0, 2.0, 3.0)
    for name, sides in (("a.nii", 1.0), ("b.nii", -1.0)):
        struct.pack_into("<f", content, 76, sides)
        (tmp_path / name).write_bytes(content)
    volume, image = read_volume(tmp_path / "a.nii"), sitk.ReadImage(str(tmp_path / "a.nii"))
    assert volume.direction == pytest.approx(TURN)
    assert volume.direction.ravel() == pytest.approx(image.GetDirection(), abs=1e-6)
    assert volume.origin_mm == pytest.approx(image.GetOrigin())
    with pytest.raises(CtInertiaError, match="right-handed"):
        read_volume(tmp_path / "b.nii")


def test_zarr_chunks_with_exchanged_axes(tmp_path):
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=3)
    turned = zarr.codecs.TransposeCodec(order=(2, 0, 1))
    array = group.create_array("0", shape=(7, 6, 5), dtype="u2", chunks=(4, 3, 2), filters=[turned])
    array[...] = picture()
    axes = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "zyx"]
    scale = [{"type": "scale", "scale": SPACING[::-1].tolist()}]
    datasets = [{"path": "0", "coordinateTransformations": scale}]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": datasets}]}
    assert read_back(tmp_path / "a.zarr", picture()).spacing_mm == pytest.approx(SPACING)


def test_bzip2(tmp_path):
    path = f.nrrd(tmp_path / "a.nrrd", picture(), encoding="bzip2")
    head = path.read_bytes().split(b"\n\n")[0] + b"\n\n"
    path.write_bytes(head + bz2.compress(picture().tobytes()))
    read_back(path, picture())


@pytest.mark.parametrize("packing", ["jpegxl", "lerc", "png", "lzma", "ccitt", "jpegxr"])
def test_tiff_in_other_packings(tmp_path, packing):
    if packing == "ccitt":
        bright = picture("u1") > 4
        first, *rest = map(Image.fromarray, bright)
        first.save(tmp_path / "a.tif", save_all=True, append_images=rest, compression="group4")
        read_back(tmp_path / "a.tif", bright.astype(np.uint8))
        return
    tifffile.imwrite(tmp_path / "a.tif", picture(), compression=packing, photometric="minisblack")
    if packing != "jpegxr":
        read_back(tmp_path / "a.tif", picture())
        return
    with pytest.raises(CtInertiaError, match=r"packed by one of NONE, .*; got JPEGXR"):
        read_volume(tmp_path / "a.tif", SPACING)


def test_a_rescaling_that_the_library_refuses_is_no_damage(tmp_path):
    folder = f.dicom(tmp_path / "d", picture(np.int16), **{"0028|1052": "0", "0028|1053": "1"})
    for path in folder.iterdir():
        content = path.read_bytes()
        place = content.index(bytes.fromhex("28005210"))
        length = int.from_bytes(content[place + 4 : place + 8], "little")
        path.write_bytes(content[: place + 4] + b"\x06\0\0\x0032768 " + content[place + 8 + length :])
    with pytest.raises(CtInertiaError) as refused:
        read_volume(folder)
    assert refused.value.faults[0].thing == "the rescaled grey values"

"""Files that claim, hold or point at other things than a scan: one fault each, with place and next step."""

import gzip
import json
import os
import struct

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
from PIL import Image

from ct_inertia.scan.open_scan import open_labels, open_scan
from ct_inertia.scan.raw import RawLayout
from stapeskit.faults import StapeskitError
from tests.scan_files import scan_writers as w
from tests.scan_files import scanner_writers as own
from tests.scan_files.scan_writers import SPACING, picture

HUGE = "50000 60000 70000"


def refused(path, spacing=0.02, **options):
    with pytest.raises(StapeskitError) as caught:
        open_scan(path, spacing, **options).read()
    fault = caught.value.faults[0]
    assert fault.where or path.name in fault.got or fault.thing.startswith(("slice ", "--"))
    return fault


def changed(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    return path


CLAIMS = {
    "a.mha": lambda path: w.meta(path, picture("i2"), DimSize=HUGE),
    "a.nrrd": lambda path: w.nrrd(path, picture("i2"), sizes=HUGE),
    "zip.nrrd": lambda path: changed(
        w.itk(path, picture("i2"), packed=True), b"sizes: 5 6 7", f"sizes: {HUGE}".encode()
    ),
    "a.am": lambda path: changed(
        own.amira(path, picture("i2")), b"Lattice 5 6 7", b"Lattice 50000 60000 70000"
    ),
    "a.vgi": lambda path: changed(own.vgi(path, picture("i2")), b"5 6 7", HUGE.encode()),
    "a.nii": lambda path: changed(w.nifti(path, picture("i2")), struct.pack("<3h", 5, 6, 7), b"\xff\x7f" * 3),
    "a.isq": lambda path: changed(
        own.isq(path, picture("i2")), struct.pack("<3i", 5, 6, 7), b"\xff\xff\0\0" * 3
    ),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_claims_of_terabytes_are_refused_before_anything_is_allocated(tmp_path, name):
    fault = refused(CLAIMS[name](tmp_path / name))
    assert fault.thing in ("the scan", f"the {'NRRD'} scan")
    assert "bytes" in fault.got or "memory" in fault.got or "MB" in fault.got
    if name == "a.nii":
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress((tmp_path / name).read_bytes()))
        assert "420 bytes" in refused(tmp_path / "a.nii.gz").got


@pytest.mark.parametrize("odd", [np.zeros((5, 5), "u1"), np.zeros((6, 5), "u2"), np.zeros((8, 7), "u1")])
def test_a_page_of_another_size_or_type_between_the_others_is_neither_left_out_nor_misread(tmp_path, odd):
    array = picture("u1", (20, 6, 5))
    for place, held in ((11, None), (0, array[1:])):  # what lies before the stack is a preview
        path = w.pages(tmp_path / f"{place}.tif", [*array[:place], odd, *array[place + 1 :]])
        if held is None:
            assert refused(path).thing == "the pages of the TIFF"
        else:
            assert np.array_equal(open_scan(path, SPACING).read(), held)


def test_zarr_metadata_that_are_none(tmp_path):
    folder = w.ome_zarr(tmp_path / "a", picture())
    meta = json.loads((folder / "0" / ".zarray").read_text())
    for key in ("shape", "chunks", "dtype"):
        (folder / "0" / ".zarray").write_text(json.dumps({k: v for k, v in meta.items() if k != key}))
        refused(folder)
    (folder / "0" / ".zarray").write_text(json.dumps(meta | {"chunks": [1 << 12] * 3}))
    assert "chunks of" in refused(folder).got
    (folder / "0" / ".zarray").write_text(json.dumps(meta))
    chunk = next(p for p in (folder / "0").rglob("*") if p.is_file() and not p.name.startswith("."))
    chunk.write_bytes(b"damaged")
    refused(folder)
    for content in ("{", "{}", '{"multiscales": [{}]}', '{"a":' * 100_000):
        (folder / ".zattrs").write_text(content)
        refused(folder)
    two = w.ome_zarr(tmp_path / "two", picture(), leading=("c",))
    meta = json.loads((two / "0" / ".zarray").read_text())
    (two / "0" / ".zarray").write_text(json.dumps(meta | {"shape": [2, *meta["shape"][1:]]}))
    assert refused(two).expected == "a stack of one grey value per voxel"


HEADERS = [
    (w.nrrd, {"data_file": "s%03d.raw 0 6 1"}),
    (w.nrrd, {"line_skip": 1}),
    (w.nrrd, {"data_file": "LIST"}),
    (w.nrrd, {"data_file": "none.raw"}),
    (w.nrrd, {"data_file": "../a.raw"}),
    (w.nrrd, {"data_file": "/etc/hostname"}),
    (w.nrrd, {"data_file": "b" * 300}),
    (w.nrrd, {"byte_skip": "some"}),
    (w.nrrd, {"spacings": "1 2"}),
    (w.nrrd, {"encoding": "ascii"}),
    (w.nrrd, {"type": "block"}),
    (w.nrrd, {"sizes": "5 6 x"}),
    (w.meta, {"data": "s%03d.raw 0"}),
    (w.meta, {"data": "x/../../a.raw"}),
    (w.meta, {"ElementType": "MET_OTHER"}),
    (w.meta, {"DimSize": None}),
    (w.meta, {"BinaryData": "False"}),
]


@pytest.mark.parametrize(("write", "fields"), HEADERS)
def test_headers_that_make_no_sense(tmp_path, write, fields):
    (tmp_path / "a.raw").write_bytes(picture().tobytes())
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / ("a.nhdr" if write is w.nrrd else "a.mhd")
    assert refused(write(path, picture(), **fields)).where == path.name


def test_a_data_file_with_a_header_of_its_own_is_not_read_from_its_start(tmp_path):
    """A NIfTI file as the voxels of another header: its first 352 bytes are none."""
    (tmp_path / "a.nii").write_bytes(bytes(352) + picture().tobytes())
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(bytes(352) + picture().tobytes()))
    for name, fields in (("a.nii", {}), ("a.nii.gz", {"encoding": "gzip"})):
        path = w.nrrd(tmp_path / "a.nhdr", picture(), **{"data file": name}, **fields)
        fault = refused(path)
        assert str(picture().nbytes) in fault.expected
        assert str(picture().nbytes + 352) in fault.got
        assert "-1" in fault.next_step
    path = own.vgi(tmp_path / "a.vgi", picture(), skip=352)
    path.write_text(path.read_text().replace("SkipHeader = 352\n", ""))
    assert str(picture().nbytes + 352) in refused(path).got


def test_a_name_that_does_not_fit_the_content(tmp_path):
    w.itk(tmp_path / "a.nii", picture("i2"))
    (tmp_path / "b.nii").write_bytes(gzip.compress((tmp_path / "a.nii").read_bytes()))
    (tmp_path / "c.nii.gz").write_bytes(w.nrrd(tmp_path / "a.nrrd", picture()).read_bytes())
    assert "x1f" in refused(tmp_path / "b.nii").got
    assert "NRRD" in refused(tmp_path / "c.nii.gz").got


def test_a_path_of_another_machine_counts_as_its_last_part(tmp_path):
    (tmp_path / "a.raw").write_bytes(picture().tobytes())
    for name in ("C:\\scans\\a.raw", "/mnt/disk/a.raw", "../old/a.raw"):
        assert np.array_equal(open_scan(w.meta(tmp_path / "a.mhd", picture(), data=name)).read(), picture())
    assert refused(w.meta(tmp_path / "a.mhd", picture(), data="../old/b.raw")).thing == "the data file"


LOGS = {
    "width": ({"width": 50}, "5 columns"),
    "count": ({"count": 70}, "7 slices"),
    "height": ({"height": 60, "width": 50}, "6 rows, 5 columns"),
}


@pytest.mark.parametrize("name", LOGS)
def test_a_reconstruction_log_of_other_slices_is_refused_with_both_numbers(tmp_path, name):
    other, held = LOGS[name]
    folder = w.slices(tmp_path / "rec", picture("u1"), ending="bmp")
    (folder / "rec.log").write_text(w.skyscan_log(picture("u1"), **other))
    fault = refused(folder, None)
    assert fault.thing == "the voxel spacing"
    assert all(word in fault.got for word in held.split(", "))
    assert all(str(value) in fault.got for value in other.values())
    assert open_scan(folder, SPACING).spacing_mm == pytest.approx(SPACING)


def test_only_a_reconstruction_log_gives_the_voxel_size(tmp_path):
    folder = w.slices(tmp_path / "rec", picture("u1"), ending="bmp")
    right = w.skyscan_log(picture("u1"))
    acquired = right.partition("[Reconstruction]")[0]
    (folder / "a.log").write_text(acquired)
    (folder / "rec_spr.bmp").write_bytes(b"a preview")
    assert "9.9 um" in refused(folder, None).got
    (folder / "rec.LOG").write_text(right, newline="\r\n")
    assert open_scan(folder).spacing_mm == pytest.approx([0.02] * 3)
    (folder / "rec.LOG").rename(folder / "rec.log")
    scan = open_scan(folder)
    assert {notice.code for notice in scan.notices} == {"handedness_unconfirmed"}
    (folder / "rec.log").write_text(right.replace("Step=1", "Step=2"))
    assert open_scan(folder).spacing_mm == pytest.approx([0.02, 0.02, 0.04])
    (folder / "rec2.log").write_text(w.skyscan_log(picture("u1"), size=44.0))
    got = refused(folder, None).got
    assert all(word in got for word in ("rec.log", "rec2.log", "20 um", "44 um"))
    (folder / "rec2.log").write_text(w.skyscan_log(picture("u1"), size=44.0, width=99))
    assert open_scan(folder).spacing_mm[0] == pytest.approx(0.02)


def test_the_log_of_another_scanner_does_not_hide_what_the_slices_say(tmp_path):
    folder = w.slices(tmp_path / "rec", picture(), resolution=(500, 400), resolutionunit="CENTIMETER")
    (folder / "scan.log").write_text("Pixel Size (um)=20\n")
    assert "0.02 x 0.025 x ? mm" in refused(folder, None).got


def test_folders_of_slices(tmp_path):
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty")
    folder = w.slices(tmp_path / "f", picture())
    for wrong, got in ((np.zeros((4, 4), "u2"), "4 x 4 uint16"), (picture("u1")[0], "5 x 6 uint8")):
        tifffile.imwrite(folder / "rec_9.tif", wrong, photometric="minisblack")
        fault = refused(folder)
        assert (fault.thing, fault.got) == ("slice rec_9.tif", got)
    (folder / "rec_9.tif").write_bytes(b"nothing")
    assert refused(folder).where == "rec_9.tif"
    tifffile.imwrite(folder / "rec_09.tif", picture()[0], photometric="minisblack")
    assert refused(folder).thing == "the slice numbers"
    (folder / "rec_09.tif").unlink()
    (folder / "rec_9.tif").unlink()
    scan = open_scan(folder, SPACING)
    assert np.array_equal(scan.read(), np.delete(picture(), 1, axis=0))
    assert "slices_missing" in {notice.code for notice in scan.notices}
    for number in (11, 13):
        (folder / f"rec_{number}.tif").unlink()
    tifffile.imwrite(folder / "preview_001.tif", np.zeros((3, 3), np.uint8))
    texts = [n.text for n in open_scan(folder, SPACING).notices if n.code == "file_read"]
    assert len(texts) == 2
    assert any(text.startswith("1 other") for text in texts)
    assert any("steps of 2" in text for text in texts)
    for k, image in enumerate(picture()):
        tifffile.imwrite(folder / f"other_{k}.tif", image)
        for channel in (1, 2):
            tifffile.imwrite(tmp_path / f"ear_c{channel}_{k}_8bit.tif", image)
    assert "other_#.tif (7 slices)" in refused(folder).got
    assert "ear_c1_#_8bit.tif" in refused(tmp_path).got


def test_numbers_of_colours_are_labels_and_no_grey_values(tmp_path):
    table = np.tile(np.random.default_rng(1).permutation(256).astype("u2") * 257, (3, 1))
    tifffile.imwrite(tmp_path / "p.tif", picture("u1"), photometric="palette", colormap=table)
    assert refused(tmp_path / "p.tif").expected == "grey values"
    assert np.array_equal(open_labels(tmp_path / "p.tif", SPACING)[0], picture("u1"))


def test_channels_of_imagej_are_no_scan(tmp_path):
    """Flat, coloured, complex and constant pictures: tests/refusals."""
    channels = {"imagej": True, "metadata": {"axes": "ZCYX"}}
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 2, 6, 5), "u1"), **channels)
    assert refused(tmp_path / "a.tif").expected == "a stack of one grey value per voxel"


@pytest.mark.parametrize("ending", ["nrrd", "mha", "nii"])
def test_flat_vector_and_complex_images_of_open_formats(tmp_path, ending):
    images = {
        "flat": sitk.GetImageFromArray(picture("i2")[0]),
        "vector": sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), "u1"), isVector=True),
        "complex": sitk.GetImageFromArray(np.ones((4, 5, 6), "c8")),
    }
    for name, image in images.items():
        if (name, ending) != ("complex", "mha"):
            sitk.WriteImage(image, str(tmp_path / f"{name}.{ending}"))
            assert refused(tmp_path / f"{name}.{ending}").thing in ("the volume", "the grey values")


def test_dicom_folders(tmp_path):
    folder = w.dicom(tmp_path / "d", picture("i2"))
    (folder / "1_995.dcm").unlink()
    assert refused(folder).thing == "the distance of DICOM slices"
    two = w.dicom(w.dicom(tmp_path / "two", picture("i2")), picture("i2"), series="2")
    assert "ear 1 (7 files), ear 2 (7 files)" in refused(two).got
    assert refused(two / "1_999.dcm").got == "a single slice"
    frames = w.itk(tmp_path / "frames.dcm", picture("u2"))
    assert refused(frames).got == "7 frames in one file"
    beside = w.dicom(tmp_path / "beside", picture("i2")[:1], series="9")
    w.itk(beside / "frames.dcm", picture("u2"))
    assert refused(beside).got == "7 frames in one file"
    scout = w.dicom(w.dicom(tmp_path / "scout", picture("i2")), picture("i2")[:1], series="9")
    scan = open_scan(scout)
    assert np.array_equal(scan.read(), picture("i2"))
    (notice,) = scan.notices
    assert notice.code == "file_read"
    assert notice.text.startswith("1 single")
    (two / "1_999.dcm").write_bytes((two / "1_999.dcm").read_bytes()[:-40])
    for file in two.glob("2_*"):
        file.unlink()
    refused(two)


def test_files_that_are_no_scans(tmp_path):
    assert refused(tmp_path / "none.tif").expected == "an existing file or folder"
    (tmp_path / "empty.tif").write_bytes(b"")
    assert refused(tmp_path / "empty.tif").got == "an empty file"
    os.mkfifo(tmp_path / "pipe.tif")
    assert refused(tmp_path / "pipe.tif").got == "a pipe or a device"
    (tmp_path / "a.docx").write_bytes(b"no scan at all")
    assert "OME-Zarr" in refused(tmp_path / "a.docx").expected
    for ending in ("tif", "nrrd", "nhdr", "mha", "nii", "nii.gz", "hdr", "isq", "aim", "vgi", "am", "dcm"):
        (tmp_path / f"junk.{ending}").write_bytes(b"NRRD0004\nhello world\n" * 20)
        refused(tmp_path / f"junk.{ending}")


def test_raw_layouts(tmp_path):
    path = w.raw(tmp_path / "a.raw", picture(), header=12)
    assert "--header-bytes 12" in refused(path, raw=RawLayout((5, 6, 7), "uint16")).next_step
    assert refused(path, raw=RawLayout((50000, 60000, 70000), "uint16")).thing == "the raw file"
    (tmp_path / "a.raw.gz").write_bytes(gzip.compress(picture().tobytes()))
    assert "gzip" in refused(tmp_path / "a.raw.gz", raw=RawLayout((5, 6, 7), "uint16")).next_step


@pytest.mark.parametrize("write", [w.plain, w.nrrd, w.ome_zarr, w.slices])
def test_voxels_that_are_not_finite(tmp_path, write):
    array = picture("f4")
    array[5, 3, 3], array[5, 3, 4] = np.nan, np.inf
    path = write(tmp_path / {w.plain: "a.tif", w.nrrd: "a.nrrd"}.get(write, "a"), array)
    scan = open_scan(path, 0.02)  # opening does not read all of it
    assert np.array_equal(scan.read((slice(0, 3), slice(None), slice(None))), array[:3])
    assert refused(path).got.startswith("2 voxels")
    air = open_scan(path, 0.02, nan_as_air=True).read()
    assert np.array_equal(air[np.isfinite(array)], array[np.isfinite(array)])
    assert set(air[~np.isfinite(array)]) == {np.median(array[np.isfinite(array)])}


def test_a_volume_shown_mirrored_in_its_viewer_is_read_as_stored_and_that_is_said(tmp_path):
    path = changed(own.vgi(tmp_path / "a.vgi", picture()), b"mirror = 0 0 0 0", b"mirror = 1 0 0 0")
    scan = open_scan(path)
    assert np.array_equal(scan.read(), picture())
    texts = [notice.text for notice in scan.notices if notice.code == "handedness_unconfirmed"]
    assert any("mirror = 1 0 0 0" in text for text in texts)


@pytest.mark.parametrize("pattern", ["ear_{:03d}_8bit", "ear_z{}_c001", "2024-03-01 ear 2 {}", "{:02d}"])
def test_the_number_that_differs_counts_the_slices(tmp_path, pattern):
    for k, image in enumerate(picture()):
        tifffile.imwrite(tmp_path / f"{pattern.format(k + 7)}.tif", image)
    assert np.array_equal(open_scan(tmp_path, SPACING).read(), picture())


def test_a_packed_nifti_is_read_to_its_check_sum(tmp_path):
    path = w.itk(tmp_path / "a.nii.gz", picture(shape=(50, 50, 50)))
    content = bytearray(path.read_bytes())
    content[-6] ^= 1  # of the check sum
    path.write_bytes(content)
    with pytest.raises(StapeskitError) as caught:
        open_scan(path).read()
    assert "a damaged or truncated one" in caught.value.faults[0].got


def test_an_imagej_description_that_counts_other_slices(tmp_path):
    text = "ImageJ=1.54f\nimages=9\nslices=9\nunit=mm\nspacing=0.03\n"
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for k, plane in enumerate(picture()):
            writer.write(plane, metadata=None, contiguous=False, description=text if k == 0 else None)
    fault = refused(tmp_path / "a.tif")
    assert "(9)" in fault.expected
    assert fault.got == "7 slices"


@pytest.mark.parametrize("equal", [True, False])
def test_slices_in_colours_are_read_where_the_colours_are_equal(tmp_path, equal):
    for k, image in enumerate(picture("u1")):
        colours = [Image.fromarray(image if equal else np.roll(image, band)) for band in range(3)]
        Image.merge("RGB", colours).save(tmp_path / f"{k}.png")
    if equal:
        assert np.array_equal(open_scan(tmp_path, SPACING).read(), picture("u1"))
    else:
        assert refused(tmp_path).expected == "grey values"

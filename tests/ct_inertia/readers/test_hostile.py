"""Files that claim, unpack to or point at more than they may."""

import gzip
import json
import os
import resource
import struct
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_labels, read_volume
from legacy.ct_inertia.readers import checks
from legacy.ct_inertia.readers.decompression import CODECS, unpack
from legacy.ct_inertia.readers.dicom_lengths import dicom_size
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as w
from tests.ct_inertia.readers.writers import picture

RAW = np.random.default_rng(2).integers(0, 5, 4000).astype("u1").tobytes()


def refused(path, spacing=0.02, **options):
    with pytest.raises(CtInertiaError) as fault:
        np.asarray(read_volume(path, spacing, **options).array)
    return fault.value.faults[0]


def packed(codec, data):
    if codec == "crc32c":
        return data + b"abcd"
    return bytes(
        getattr(imagecodecs, f"{codec}_encode")(data, **({"header": True} if codec == "lz4" else {}))
    )


@pytest.mark.parametrize("codec", CODECS)
def test_chunks_unpack_to_no_more_than_they_may(codec):
    assert bytes(unpack(codec, packed(codec, RAW), len(RAW))) == RAW
    try:
        more = unpack(codec, packed(codec, bytes(1 << 20)), 100)
    except Exception:
        return
    assert len(more) == 101  # enough to see that it is too long


@pytest.mark.parametrize(
    ("place", "value"),
    [(4, 1 << 31), (4, 0), (8, 0), (8, 1 << 31), (12, 17), (12, 1 << 31), (16, 1 << 31), (16, 0)],
)
def test_a_blosc_header_that_lies_is_refused(place, value):
    chunk = bytearray(imagecodecs.blosc_encode(RAW, compressor="lz4"))
    struct.pack_into("<I", chunk, place, value)
    with pytest.raises(Exception):  # noqa: B017 - of several kinds; what counts is that the process goes on
        assert len(unpack("blosc", bytes(chunk), len(RAW))) == len(RAW)


def test_a_chunk_of_a_hundred_bytes_with_a_lying_header(tmp_path):
    import numcodecs

    folder = w.ome_zarr(tmp_path / "a", picture(), compressors=numcodecs.Blosc())
    for chunk in (folder / "0").glob("[0-9]*"):
        files = [chunk] if chunk.is_file() else [file for file in chunk.rglob("*") if file.is_file()]
        for file in files:
            file.write_bytes(bytes([2, 1, 0x21, 2]) + struct.pack("<3I", 1 << 30, 1 << 20, 100) + bytes(84))
    assert refused(folder).expected == "a readable Zarr chunk"


@pytest.mark.parametrize("name", ["../a.raw", "/etc/passwd", "x/../../a.raw"])
def test_headers_do_not_lead_out_of_their_folder(tmp_path, name):
    (tmp_path / "in").mkdir()
    voxels = picture().tobytes()
    (tmp_path / "a.raw").write_bytes(voxels)
    meta = w.meta(tmp_path / "in" / "a.mhd", picture(), data=name)
    nrrd = w.nrrd(tmp_path / "in" / "a.nhdr", picture(), **{"data file": name})
    for header in (meta, nrrd):
        fault = refused(header)
        assert fault.expected == "in the folder of its header"
        assert "{follow}" in fault.next_step
    if name == "../a.raw":
        for header in (meta, nrrd):
            header.write_bytes(header.read_bytes().split(b"\n\n")[0] + b"\n")
            assert np.array_equal(read_volume(header, 0.02, follow=True).array, picture())


def test_levels_of_a_zarr_image_lie_within_it(tmp_path):
    folder = w.ome_zarr(tmp_path / "a", picture())
    w.zarr_attributes(folder, lambda entry: entry["datasets"][0].update(path="../a/0"))
    assert refused(folder).expected == "in the folder of its header"
    assert read_volume(folder, follow=True).array.shape == picture().shape


def test_parts_of_an_ome_tiff_lie_beside_it(tmp_path):
    path = w.ome(tmp_path / "a.ome.tif", picture())
    with tifffile.TiffFile(path) as tif:
        text = tif.ome_metadata
    changed = text.replace(
        "<TiffData ", '<TiffData FirstZ="0"><UUID FileName="../b.tif">x</UUID></TiffData><TiffData '
    )
    tifffile.tiffcomment(path, changed.encode())
    assert refused(path).expected == "in the folder of its header"


def test_ten_million_slices_are_not_looked_for(tmp_path):
    pattern = "s%07d.raw 0 9999999 1"
    for header in (
        w.meta(tmp_path / "a.mhd", picture(), data=pattern),
        w.nrrd(tmp_path / "a.nhdr", picture(), **{"data file": pattern}),
    ):
        assert refused(header).got.startswith("10000000 data files for")


@pytest.mark.parametrize("name", ["b" * 256, "b\0c"])
def test_names_that_no_file_can_have(tmp_path, name):
    fault = refused(w.meta(tmp_path / "a.mhd", picture(), data=name))
    assert fault.where == "a.mhd"


def test_a_directory_that_leads_back_to_itself(tmp_path):
    for path in (
        w.plain(tmp_path / "a.tif", picture()),
        w.plain(tmp_path / "b.tif", picture(), bigtiff=True),
    ):
        data = bytearray(path.read_bytes())
        big = data[2] == 43
        form, entry, count = ("<Q", 20, "<Q") if big else ("<I", 12, "<H")
        first = struct.unpack_from(form, data, 8 if big else 4)[0]
        number = struct.unpack_from(count, data, first)[0]
        struct.pack_into(form, data, first + struct.calcsize(count) + number * entry, first)
        path.write_bytes(bytes(data))
        assert "leads back to itself" in refused(path).got


def test_a_slice_that_claims_more_than_its_file_holds(tmp_path):
    """Each claim alone would ask for the memory before the file ends."""
    for name in ("c_1.png", "c_2.png"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    data = bytearray((tmp_path / "c_2.png").read_bytes())
    struct.pack_into(">II", data, 16, 9_000, 9_000)
    struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    (tmp_path / "c_2.png").write_bytes(bytes(data))
    assert refused(tmp_path).thing == "the volume"
    for name in ("c_1.png", "c_2.png"):
        (tmp_path / name).unlink()
    for number in (1, 2):
        path = w.plain(tmp_path / f"s_{number}.tif", picture()[:1], compression="zlib")
    with tifffile.TiffFile(path) as tif:
        entry = tif.pages[0].tags["StripByteCounts"].offset
    data = bytearray(path.read_bytes())
    struct.pack_into("<HII", data, entry + 2, 4, 1, 1_345_388_594)  # one number of 32 bits
    path.write_bytes(bytes(data))
    assert refused(tmp_path).expected.startswith("as long as its pages say")


def test_a_pipe_is_no_scan(tmp_path):
    os.mkfifo(tmp_path / "a.tif")
    assert refused(tmp_path / "a.tif").got == "a pipe or a device"


def test_voxels_at_no_number_and_infinite_scales(tmp_path):
    path = w.nifti(tmp_path / "a.nii", picture())
    whole = path.read_bytes()
    for value in (np.nan, np.inf, -np.inf, 1e30):
        head = bytearray(whole)
        struct.pack_into("<f", head, 108, value)
        path.write_bytes(bytes(head))
        assert refused(path).thing == "the volume"
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress(bytes(head)))
        assert refused(tmp_path / "a.nii.gz").thing == "the scan"
    for slope in (np.inf, np.nan):
        path.write_bytes(w.nifti(path, picture(), slope=slope).read_bytes())
        assert np.array_equal(read_volume(path).array, picture())  # as nifti1.h asks for an unusable slope


@pytest.mark.parametrize(
    "shape", [[0, 6, 5], [-7, 6, 5], [1 << 40, 6, 5], [7.5, 6, 5], [7, 6], "abc", None, [[7], 6, 5]]
)
def test_zarr_shapes(tmp_path, shape):
    folder = w.ome_zarr(tmp_path / "a", picture())
    meta = json.loads((folder / "0" / ".zarray").read_text())
    meta["shape"] = shape
    (folder / "0" / ".zarray").write_text(json.dumps(meta))
    assert refused(folder).thing in ("the scan", "the volume")


@pytest.mark.parametrize(
    "key", ["shape", "chunks", "dtype", "compressor", "fill_value", "order", "zarr_format"]
)
def test_zarr_metadata_without_a_key(tmp_path, key):
    folder = w.ome_zarr(tmp_path / "a", picture())
    meta = json.loads((folder / "0" / ".zarray").read_text())
    del meta[key]
    (folder / "0" / ".zarray").write_text(json.dumps(meta))
    if key in ("order", "fill_value", "zarr_format"):
        assert read_volume(folder).array.shape == picture().shape
    else:
        assert refused(folder).where


def test_metadata_that_are_nested_too_deeply(tmp_path):
    folder = w.ome_zarr(tmp_path / "a", picture())
    (folder / ".zattrs").write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    assert refused(folder).got == "a damaged .zattrs"
    (folder / ".zattrs").write_text('{"a":' + "9" * 5000 + "}")
    assert refused(folder).got == "a damaged .zattrs"


def test_a_lattice_of_many_digits(tmp_path):
    path = scanners.amira(tmp_path / "a.am", picture())
    text = path.read_bytes().replace(b"define Lattice 5 6 7", b"define Lattice " + b"9" * 5000 + b" 6 7")
    path.write_bytes(text)
    assert "not a uniform one" in refused(path).got


def test_a_dicom_element_longer_than_the_file(tmp_path):
    path = w.frames(tmp_path / "a.dcm", picture())
    size = dicom_size(path)
    assert (size.numbers["rows"], size.numbers["columns"], size.numbers["frames"]) == (6, 5, 7)
    assert size.native
    assert size.claimed_bytes == picture().nbytes
    data = bytearray(path.read_bytes())
    place = data.rindex(b"\xe0\x7f\x10\x00")
    struct.pack_into("<I", data, place + 4, 0xFFFFFF00)
    path.write_bytes(bytes(data))
    assert "bytes at byte" in refused(path).got
    folder = w.dicom(tmp_path / "series", picture())
    (folder / "1_9.dcm").write_bytes(bytes(data))
    assert "bytes at byte" in refused(folder).got


def test_a_dicom_file_with_fewer_pixels_than_rows_and_columns(tmp_path):
    path = w.frames(tmp_path / "a.dcm", picture())
    rows = b"\x28\x00\x10\x00\x02\x00\x00\x00"
    assert path.read_bytes().count(rows + b"\x06\x00") == 1
    path.write_bytes(path.read_bytes().replace(rows + b"\x06\x00", rows + b"\xff\xff"))
    assert refused(path).got == f"{picture().nbytes} bytes of pixels for {65535 * 5 * 7 * 2}"


def test_a_stack_of_zeros_packs_far_more_than_zlib(tmp_path):
    mask = np.zeros((40, 512, 512), dtype=np.uint8)
    mask[20, 200:300, 200:300] = 1
    path = w.plain(tmp_path / "a.tif", mask, compression="zstd", rowsperstrip=512)
    assert mask.nbytes > 1100 * path.stat().st_size
    assert np.array_equal(read_volume(path, 0.02).array, mask)


def test_what_does_not_fit_into_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "available_memory", lambda: 200)
    for name in ("a.nii.gz", "a.nrrd", "a.mha"):
        fault = refused(w.itk(tmp_path / name, picture(), packed=True), None)
        assert fault.got == f"{picture().nbytes} bytes"


def test_the_limit_on_memory_is_seen(monkeypatch):
    from legacy.stapeskit.memory import available_memory

    whole = available_memory()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1 << 62, 1 << 62))
    assert available_memory() <= whole * 1.5
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1000, 1000))
    assert available_memory() == 0


def test_labels_that_unpack_to_more_than_their_header_says(tmp_path):
    path = w.itk(tmp_path / "a.nrrd", picture(np.uint8), packed=True)
    head = path.read_bytes().split(b"\n\n")[0]
    path.write_bytes(head + b"\n\n" + gzip.compress(bytes(32 << 20)))
    assert refused(path, None).thing == "the volume"  # all zero: no more than the voxels were unpacked
    other = w.itk(tmp_path / "b.nrrd", picture(np.uint8), packed=True)
    assert read_labels(other).array.shape == picture().shape


def test_unreadable_files(tmp_path, monkeypatch):
    path = w.nrrd(tmp_path / "a.nrrd", picture())

    def denied(self, *_args, **_kw):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    fault = refused(path)
    assert (fault.expected, fault.got) == ("a file that can be read", "Permission denied")


def test_names_that_are_no_utf8_are_written(tmp_path, monkeypatch):
    from legacy.ct_inertia.cli import work
    from legacy.ct_inertia.surface.surface import write_surface
    from tests.ct_inertia.shapes import stapes

    write_surface(tmp_path / "a.ply", stapes(0.15))
    name = os.fsdecode(b"b\xff\n*STEP.ply")
    os.replace(tmp_path / "a.ply", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    words = ["--density", "1900", "--export", "abaqus,mjcf,mat", "--out", "out", "--no-report"]
    files = work([name, *words])[1].files
    assert {path.name for path in files} >= {"mass.json", "stapes.inp", "stapes.xml", "mass.mat"}
    deck = (tmp_path / "out" / "stapes.inp").read_text(encoding="utf-8")
    assert deck.splitlines()[0].endswith("b??*STEP.ply")
    assert json.loads((tmp_path / "out" / "mass.json").read_text())["provenance"]["inputs"]["scan"]

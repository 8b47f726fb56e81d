"""The contract of every format: written is read, cut is refused, damaged is values or one error."""

import time
from contextlib import suppress

import numpy as np
import pytest

from ct_inertia.scan.formats import FORMATS
from ct_inertia.scan.open_scan import open_scan
from ct_inertia.scan.raw import RawLayout
from stapeskit.faults import StapeskitError
from tests.scan_files.scan_cases import CASES
from tests.scan_files.scan_writers import SPACING, check_corners, picture

SEEDS = 6  # damages of each format; benchmarks/damaged_files.py tries as many as one asks for


def written(folder, name, kind=None, shape=(7, 6, 5)):
    """Write a case and return its path, its voxels and how it is opened."""
    case = CASES[name]
    array = picture(kind or case.types[0], shape)
    path = case.write(folder / name, array, **case.options)
    layout = None
    if case.raw is not None:
        layout = RawLayout(array.shape[::-1], array.dtype.newbyteorder("=").name, **case.raw)
    return path, array, {"spacing_mm": SPACING if case.asks else None, "raw": layout}


@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, case in CASES.items() for kind in case.types]
)
def test_what_is_written_is_read(tmp_path, name, kind):
    path, array, options = written(tmp_path, name, kind)
    scan = open_scan(path, **options)
    voxels = scan.read()
    assert voxels.dtype == scan.dtype == array.dtype.newbyteorder("=")
    assert np.array_equal(voxels, array)
    some = (slice(1, 7, 2), slice(1, 5, 3), slice(2, 5))
    assert np.array_equal(scan.read(some), array[some])
    assert np.array_equal(np.concatenate([slab for _, slab in scan.slabs(2)]), array)
    assert scan.spacing_mm == pytest.approx(SPACING, rel=1e-5)
    assert scan.direction == pytest.approx(np.eye(3), abs=1e-9)
    check_corners(scan)
    assert scan.handedness_confirmed == CASES[name].anatomical
    codes = {notice.code for notice in scan.notices}
    assert codes - {"length_unit_assumed"} == (
        set() if CASES[name].anatomical else {"handedness_unconfirmed"}
    )
    assert all(file.exists() for file in scan.files)


def test_every_format_of_the_table_has_a_case():
    assert {case.entry for case in CASES.values()} == {entry.title for entry in FORMATS}


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize(
    "name", ["imagej.tif", "imagej_lzw.tif", "a.nrrd", "a.nii.gz", "folder", "dicom", "v04.zarr"]
)
def test_mirror_reverses_the_voxels_and_keeps_the_place(tmp_path, name, axis):
    path, array, options = written(tmp_path, name)
    plain, scan = open_scan(path, **options), open_scan(path, **options, mirror=axis)
    assert np.array_equal(scan.scan_from_index, plain.scan_from_index)
    assert np.array_equal(scan.read(), np.flip(array, 2 - "xyz".index(axis)))
    assert np.array_equal(scan.read((slice(1, 6, 2),) * 3), scan.read()[1:6:2, 1:6:2, 1:6:2])
    assert "handedness_unconfirmed" not in {notice.code for notice in scan.notices}


SINGLE = [name for name, case in CASES.items() if case.entry not in ("a folder of slices", "OME-Zarr")]
SINGLE = [name for name in SINGLE if not name.startswith(("dicom", "folder"))]


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_cut_file_is_refused(tmp_path, name, share):
    path, _, options = written(tmp_path, name, shape=(20, 12, 10))
    files = [file for file in tmp_path.iterdir() if file.is_file()]
    longest = max(files, key=lambda file: file.stat().st_size)
    content = longest.read_bytes()
    longest.write_bytes(content[: int(share * len(content))])
    with pytest.raises(StapeskitError) as caught:
        open_scan(path, **options).read()
    fault = caught.value.faults[0]
    assert fault.where or fault.got
    for word in ("Error", "itk::", "Traceback", "tifffile"):
        assert word not in str(fault)


DAMAGED = (
    *("imagej.tif", "imagej_lzw.tif", "zip.nrrd", "zip.mha", "a.nii.gz", "a.isq", "a30.aim", "a.vgi"),
    *("a.am", "dicom_jpeg", "v05.zarr", "folder_png"),
)


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_give_values_or_one_error(tmp_path, name):
    """Flipped bytes, zeros and gaps at random places: no traceback, no hang, no crash."""
    path, array, options = written(tmp_path, name)
    files = sorted(file for file in tmp_path.rglob("*") if file.is_file() and file.stat().st_size)
    whole = {file: file.read_bytes() for file in files}
    begin = time.process_time()
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, len(name)])
        file = files[rng.integers(len(files))]
        content = bytearray(whole[file])
        for _ in range(rng.integers(1, 6)):
            # Headers are where damage is worst, and short: half of the places lie in the first bytes.
            place = int(rng.integers(min(len(content), 400 if rng.random() < 0.5 else len(content))))
            length = int(rng.integers(1, 9))
            content[place : place + length] = {
                0: rng.integers(0, 256, length).astype("u1").tobytes(),
                1: bytes(length),
                2: b"",
            }[int(rng.integers(3))]
        file.write_bytes(content)
        with suppress(StapeskitError):  # of any other kind the test fails
            open_scan(path, **options).read()
        file.write_bytes(whole[file])
    assert time.process_time() - begin < 10.0
    assert np.array_equal(open_scan(path, **options).read(), array)

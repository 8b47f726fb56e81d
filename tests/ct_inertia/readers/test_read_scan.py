"""One contract for all readers: the same voxels, at the same places, without copying the file."""

import sys
from pathlib import Path

import numpy as np
import pytest

from legacy.ct_inertia.read_scan import read_labels, read_volume
from legacy.ct_inertia.readers.raw_layout import RawLayout
from legacy.ct_inertia.volume.lazy_arrays import BlockArray, sampled
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.contract import CASES
from tests.ct_inertia.readers.writers import SPACING, check_corners, picture

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


def how_held(array):
    if isinstance(array, BlockArray):
        return "blocks"
    # what another process unpacked lies in an array of bytes
    return "whole" if array.flags.owndata or isinstance(array.base, np.ndarray) else "map"


@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, case in CASES.items() for kind in case.types]
)
def test_every_format_tells_the_same_volume(tmp_path, name, kind):
    case, array = CASES[name], picture(kind)
    path = case.write(tmp_path / name, array, **case.options)
    names = {"u1": "uint8", "i1": "int8", "u2": "uint16", "i2": "int16", "u4": "uint32", "i4": "int32"}
    layout = None
    if case.raw is not None:
        layout = RawLayout(
            (5, 6, 7), names.get(kind, {"f4": "float32", "f8": "float64"}.get(kind)), **case.raw
        )
    volume = read_volume(path, SPACING if case.asks else None, raw=layout)
    assert volume.array.dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
    assert np.array_equal(np.asarray(volume.array), array)
    assert np.array_equal(volume.array[1:5, ::2, -1], array[1:5, ::2, -1])
    check_corners(volume)
    assert volume.spacing_mm == pytest.approx(SPACING, rel=1e-6)
    assert volume.origin_mm == pytest.approx(np.zeros(3), abs=1e-9)
    assert volume.handedness_confirmed is case.anatomical
    codes = {notice.code for notice in volume.notices}
    assert ("handedness_unconfirmed" in codes) is not case.anatomical
    assert how_held(volume.array) == case.held


@pytest.mark.parametrize("name", ["imagej.tif", "pages_lzw.tif", "a_big.nrrd", "v05_shards.zarr", "folder"])
@pytest.mark.parametrize("axis", "xyz")
def test_mirror_works_alike_in_every_format(tmp_path, name, axis):
    case = CASES[name]
    path = case.write(tmp_path / name, picture(), **case.options)
    volume = read_volume(path, SPACING, mirror=axis)
    check_corners(volume, mirrored=axis)
    box = volume.cropped([0.0, 0.0, 0.0, *(0.5 * (volume.size - 1) * SPACING)])
    inside = np.asarray(volume.array)[: box.size[2], : box.size[1], : box.size[0]]
    assert np.array_equal(np.asarray(box.array), inside)


LARGE = """
import sys, tracemalloc, numpy as np, imagecodecs
from legacy.ct_inertia.read_scan import read_volume
tracemalloc.start()
volume = read_volume(sys.argv[1], 0.02)
part = volume.array[::50, ::10, ::10]
print(tracemalloc.get_traced_memory()[1] / 2**20, int(np.asarray(part, dtype=np.int64).sum()))
"""


@pytest.mark.parametrize(
    ("name", "write", "options"),
    [
        ("a.tif", f.plain, {}),
        ("big.tif", f.plain, {"byteorder": ">"}),
        ("pages.tif", f.pages, {}),
        ("packed.tif", f.pages, {"compression": "packbits"}),
        ("a.nrrd", f.nrrd, {"big": True}),
        ("a.mha", f.meta, {}),
        ("a.nii", f.nifti, {}),
        ("a.vgi", scanners.vgi, {"parts": 2}),
        ("folder", f.slices, {}),
        ("a.zarr", f.ome_zarr, {"compressors": None}),
    ],
)
def test_a_large_volume_is_looked_at_without_holding_it(tmp_path, name, write, options):
    import subprocess

    array = np.zeros((50, 1000, 1000), np.uint16)
    array[::50] = np.arange(1000)
    if name == "a.zarr":
        path = f.zarr_single(tmp_path / name, array, (10, 250, 250))
    else:
        path = write(tmp_path / name, array, **options)
    done = subprocess.run(
        [sys.executable, "-c", LARGE, str(path)], capture_output=True, text=True, check=True
    )
    peak, total = done.stdout.split()
    assert int(total) == int(array[::50, ::10, ::10].astype(np.int64).sum())
    # MiB, of which the format's library and two layers of chunks take a part; the voxels are 95 MiB.
    assert float(peak) < 55.0


def test_segmentations_are_held_in_memory(tmp_path):
    path = f.ome_zarr(tmp_path / "a.zarr", picture(np.uint8))
    labels = read_labels(path)
    assert type(labels.array) is np.ndarray
    assert np.array_equal(labels.array, picture(np.uint8))


def test_a_block_array_is_indexed_like_an_array():
    array = np.arange(7 * 6 * 5).reshape(7, 6, 5)

    def read(z, y, x):
        return array[3 * z : 3 * z + 3, 4 * y : 4 * y + 4, 2 * x : 2 * x + 2]

    blocks = BlockArray(array.shape, array.dtype, (3, 4, 2), read)
    for key in (
        np.s_[:],
        np.s_[2],
        np.s_[-1, ..., 1],
        np.s_[..., 1:4],
        np.s_[1::3, 5:0:-2, ::-1],
        np.s_[6, 5, 4],
        np.s_[3:3],
        np.s_[:, [0, 2]],
        array > 50,
    ):
        assert np.array_equal(blocks[key], array[key])
    assert np.array_equal(np.stack(list(blocks)), array)
    turned = blocks.view(np.s_[::-1, 1:, ::2])
    assert np.array_equal(turned, array[::-1, 1:, ::2])
    assert np.array_equal(turned.view(np.s_[::-2, :, 1:]), array[::-1, 1:, ::2][::-2, :, 1:])
    assert (len(blocks), blocks.size, blocks.nbytes) == (7, 210, 210 * 8)
    with pytest.raises(IndexError):
        blocks[9]


@pytest.mark.shared
def test_real_files_of_one_scan_agree():
    folder = SHARED / "scanco"
    arrays = [read_volume(folder / f"test_{n}.{n}") for n in ("mha", "nrrd", "nii")]
    arrays += [read_volume(folder / "test_aim.AIM"), read_volume(folder / "test_isq.ISQ")]
    for volume in arrays:
        # An ISQ rounds the extent of its 25 voxels to whole micrometres.
        assert volume.spacing_mm == pytest.approx([0.0607] * 3, abs=0.5e-3 / 25)
        assert np.array_equal(np.asarray(volume.array, float), np.asarray(arrays[0].array, float))
        assert np.allclose(volume.direction, np.eye(3))


@pytest.mark.shared
def test_real_folder_of_slices():
    from legacy.ct_inertia.errors import CtInertiaError

    with pytest.raises(CtInertiaError, match="--spacing"):
        read_volume(SHARED / "lhdl_bone")
    volume = read_volume(SHARED / "lhdl_bone", 0.0195)
    assert volume.array.shape == (200, 200, 200)
    assert np.mean(np.asarray(volume.array) > 63) == pytest.approx(0.228, abs=0.001)


def test_a_coarse_look_takes_the_level_that_fits(tmp_path):
    array = np.arange(24**3, dtype=np.uint16).reshape(24, 24, 24)
    path = f.ome_zarr(tmp_path / "a.zarr", array)
    voxels = read_volume(path).array
    for steps, averaged in (((3, 2, 5), True), ((1, 4, 4), False), ((4, 4, 4), True)):
        part, coarser = sampled(voxels, steps)
        fine = array[tuple(slice(s // 2, None, s) for s in steps)]
        assert coarser is averaged
        assert part.shape == fine.shape
        # The level holds every second voxel: the one asked for or its neighbour before it.
        away = fine.astype(int) - part
        assert np.all(np.isin(away, [a * 576 + b * 24 + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]))
        assert averaged or np.all(away == 0)


def test_thin_slabs_unpack_a_block_once():
    reads = []

    def read(z, y, x):
        reads.append((z, y, x))
        return np.zeros((8, 4, 4), np.uint8)

    blocks = BlockArray((16, 4, 8), np.dtype("u1"), (8, 4, 4), read)
    for z in range(16):
        assert blocks[z : z + 1].shape == (1, 4, 8)
    assert sorted(reads) == [(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1)]


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "lzw", "rowsperstrip": 7},
        {"compression": "zlib", "rowsperstrip": 100, "predictor": True},
        {"compression": "packbits", "rowsperstrip": 300},
        {"tile": (32, 48)},
        {"tile": (96, 16), "compression": "lzw", "byteorder": ">"},
        {"tile": (4, 32, 32), "compression": "zlib", "volumetric": True},
    ],
)
def test_a_part_of_a_packed_plane_is_that_part(tmp_path, options):
    array = np.random.default_rng(3).integers(0, 60000, (8, 150, 200)).astype(np.uint16)
    if "volumetric" in options:
        f.plain(tmp_path / "a.tif", array, metadata=None, **options)
    else:
        f.pages(tmp_path / "a.tif", array, **options)
    voxels = read_volume(tmp_path / "a.tif", 0.02).array
    assert np.array_equal(np.asarray(voxels), array)
    for key in (np.s_[1:3, 60:70, 5:9], np.s_[-1, ::-1, ::3], np.s_[:, 149, :], np.s_[2:5, 63:129:5, 199]):
        assert np.array_equal(voxels[key], array[key])

"""Zarr arrays of which few chunks are stored, or far fewer than they claim."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume

LIMIT_S = 10.0  # of processor time, as in tests/fuzz
KINDS = [(2, "."), (2, "/"), (3, "."), (3, "/")]


def described(folder: Path, version: int, separator: str, shape, chunks, fill=7, shard=None) -> Path:
    """Write the metadata of an array of bytes that are not packed."""
    folder.mkdir()
    if version == 2:
        meta = {"shape": shape, "chunks": chunks, "dtype": "|u1", "compressor": None, "fill_value": fill}
        meta |= {"zarr_format": 2, "order": "C", "filters": None, "dimension_separator": separator}
        (folder / ".zarray").write_text(json.dumps(meta))
        return folder
    codecs = [{"name": "bytes"}]
    if shard is not None:
        inner = {"chunk_shape": chunks, "codecs": codecs, "index_codecs": codecs, "index_location": "end"}
        codecs = [{"name": "sharding_indexed", "configuration": inner}]
    meta = {"zarr_format": 3, "node_type": "array", "shape": shape, "data_type": "uint8", "fill_value": fill}
    meta["chunk_grid"] = {"name": "regular", "configuration": {"chunk_shape": shard or chunks}}
    meta["chunk_key_encoding"] = {"name": "default", "configuration": {"separator": separator}}
    (folder / "zarr.json").write_text(json.dumps(meta | {"codecs": codecs}))
    return folder


def place(folder: Path, version: int, separator: str, at) -> Path:
    path = folder / separator.join([*(["c"] if version == 3 else []), *map(str, at)])
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def read(folder: Path) -> tuple[np.ndarray, float]:
    """Return the voxels and the processor time that they took."""
    began = time.process_time()
    array = np.asarray(read_volume(folder, 0.02).array)
    return array, time.process_time() - began


@pytest.mark.parametrize(("version", "separator"), KINDS)
def test_chunks_that_are_not_stored_take_no_time(version, separator, tmp_path):
    shape, rng = [128, 64, 64], np.random.default_rng(1)
    folder = described(tmp_path / "a", version, separator, shape, [2, 2, 2])
    expected = np.full(shape, 7, np.uint8)
    for z, y, x in ((0, 0, 0), (3, 31, 5), (63, 31, 31)):
        block = rng.integers(0, 255, (2, 2, 2), np.uint8)
        expected[2 * z : 2 * z + 2, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2] = block
        place(folder, version, separator, (z, y, x)).write_bytes(block.tobytes())
    array, took_s = read(folder)
    np.testing.assert_array_equal(array, expected)
    assert took_s < LIMIT_S / 5  # 65 536 chunks; looking for each took 20 s
    volume = read_volume(folder, 0.02)
    assert "65533 of 65536 chunks" in volume.notices[0].text
    np.testing.assert_array_equal(volume.array[7:2:-2, 60:, ::3], expected[7:2:-2, 60:, ::3])


@pytest.mark.parametrize(("version", "separator"), KINDS)
def test_other_files_are_no_chunks(version, separator, tmp_path):
    folder = described(tmp_path / "a", version, separator, [4, 4, 4], [2, 2, 2])
    place(folder, version, separator, (0, 0, 1)).write_bytes(bytes(range(8)))
    for at in (("00", 0, 0), (0, 0, "+1"), (0, 0), (9, 0, 0), (0, 0, "²"), ("x", 0, 0), (-1, 0, 0)):
        path = place(folder, version, separator, at)
        if not path.exists():
            path.write_bytes(b"no chunk")
    place(folder, version, separator, (1, 1, 1)).mkdir()
    array, _ = read(folder)
    assert array[0, 0].tolist() == [7, 7, 0, 1]
    assert np.count_nonzero(array != 7) == 7


@pytest.mark.parametrize(("version", "separator"), KINDS)
@pytest.mark.parametrize("chunks", [1, 3, 13])  # 10^8, 3.9 million and 48 000 of them
def test_an_array_of_which_nothing_is_stored_is_refused_at_once(version, separator, chunks, tmp_path):
    folder = described(tmp_path / "a", version, separator, [470, 470, 470], [chunks] * 3)
    began = time.process_time()
    with pytest.raises(CtInertiaError):
        read_volume(folder, 0.02)
    assert time.process_time() - began < LIMIT_S / 5


@pytest.mark.parametrize("shape", [(470, 470, 470), (300_000, 2, 6), (2, 300_000, 6), (2, 3, 300_000)])
def test_one_chunk_of_very_many_is_read(shape, tmp_path):
    folder = described(tmp_path / "a", 2, "/", shape, [3, 3, 3])
    place(folder, 2, "/", (0, 0, 0)).write_bytes(bytes(range(27)))
    began = time.process_time()
    volume = read_volume(folder, 0.02)
    assert time.process_time() - began < LIMIT_S
    if np.prod(shape) < 1e8:
        expected = np.full(shape, 7, np.uint8)
        expected[:3, :3, :3] = np.arange(27).reshape(3, 3, 3)[: shape[0], : shape[1]]
        np.testing.assert_array_equal(np.asarray(volume.array), expected)


@pytest.mark.parametrize("separator", ["/../", "", "..", "/x/../../", 3, None, ["."]])
@pytest.mark.parametrize("version", [2, 3])
def test_names_do_not_lead_out_of_the_folder(version, separator, tmp_path):
    folder = described(tmp_path / "a", version, separator, [4, 4, 4], [2, 2, 2])
    with pytest.raises(CtInertiaError) as refused:
        read_volume(folder, 0.02)
    assert "separator" in refused.value.faults[0].got


def test_the_index_of_a_shard_is_read_once(tmp_path):
    folder = described(tmp_path / "a", 3, "/", [160, 64, 64], [2, 2, 2], shard=[128, 64, 64])
    index = np.full((64 * 32 * 32, 2), 2**64 - 1, "<u8")
    index[5] = (0, 8)
    place(folder, 3, "/", (0, 0, 0)).write_bytes(bytes(range(8)) + index.tobytes())
    array, took_s = read(folder)
    assert array[:2, :2, 10:12].ravel().tolist() == list(range(8))
    assert np.count_nonzero(array != 7) == 7
    assert took_s < LIMIT_S / 5  # a megabyte of index for each of 65 536 chunks took minutes


def test_a_shard_is_not_asked_for_more_chunks_than_an_array_has(tmp_path):
    folder = described(tmp_path / "a", 3, "/", [1000, 1000, 1000], [1, 1, 1], shard=[1000, 1000, 1000])
    place(folder, 3, "/", (0, 0, 0)).write_bytes(bytes(100))
    with pytest.raises(CtInertiaError, match="chunks"):
        read_volume(folder, 0.02)


def test_a_fill_value_in_words_is_told(tmp_path):
    folder = described(tmp_path / "a", 2, ".", [4, 4, 4], [2, 2, 2], fill="NaN")
    meta = json.loads((folder / ".zarray").read_text())
    (folder / ".zarray").write_text(json.dumps(meta | {"dtype": "<f4"}))
    place(folder, 2, ".", (0, 0, 0)).write_bytes(np.arange(8, dtype="<f4").tobytes())
    with pytest.raises(CtInertiaError) as refused:
        read_volume(folder, 0.02)
    assert "56 voxels of NaN" in refused.value.faults[0].got
    volume = read_volume(folder, 0.02, nan_as_air=True)
    assert "count as nan" in volume.notices[0].text

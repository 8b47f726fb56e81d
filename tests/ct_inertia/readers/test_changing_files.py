"""Scans that shrink, are rewritten or fail while they are read."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.ct_inertia.ct2mass import _check_inputs
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.native import compiled
from legacy.ct_inertia.readers import memory_mapping
from legacy.ct_inertia.readers.memory_mapping import lost_pages, mapped
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.input_changes import InputStates

SHAPE = (64, 128, 128)


@pytest.fixture
def scan(tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(np.arange(np.prod(SHAPE), dtype="<u2").tobytes())
    return path


def test_a_map_that_loses_its_file_reads_zeros_and_counts_them(scan):
    array = mapped(scan, np.dtype("<u2"), 0, SHAPE, scan.name)
    assert isinstance(array, np.ndarray) == (compiled() is not None)
    if compiled() is None:  # pieces are read, see the next test
        return
    before, whole = lost_pages(), int(array.sum(dtype=np.int64))
    os.truncate(scan, 1 << 16)
    assert int(array[-1].sum()) == 0
    assert lost_pages() > before
    assert int(array.sum(dtype=np.int64)) < whole


def test_pieces_of_a_file_that_became_shorter_are_refused(scan, monkeypatch):
    monkeypatch.setattr(memory_mapping, "compiled", lambda: None)
    array = mapped(scan, np.dtype("<u2"), 0, SHAPE, scan.name)
    assert np.array_equal(array[3:9:2, 5, ::-7], np.fromfile(scan, "<u2").reshape(SHAPE)[3:9:2, 5, ::-7])
    os.truncate(scan, 1 << 16)
    with pytest.raises(CtInertiaError) as refused:
        array[-1]
    assert refused.value.faults[0].got == "a file that ends too early"


def test_maps_and_pieces_agree_with_planes_apart(tmp_path, monkeypatch):
    planes = np.random.default_rng(0).integers(0, 9, (20, 100, 200), dtype=np.uint8).astype(">u2")
    path = tmp_path / "a.bin"
    path.write_bytes(b"ab" + b"".join(plane.tobytes() + bytes(8) for plane in planes))
    step = planes[0].nbytes + 8
    for kernels in (compiled, lambda: None):
        monkeypatch.setattr(memory_mapping, "compiled", kernels)
        assert np.array_equal(mapped(path, planes.dtype, 2, planes.shape, "a", step), planes)


@pytest.mark.parametrize("change", ["written", "cut", "replaced", "removed"])
def test_inputs_that_change_are_refused(tmp_path, change):
    file, other = tmp_path / "a.csv", tmp_path / "b"
    file.write_bytes(b"1234")
    other.write_bytes(b"1234")
    os.utime(other, ns=(1, 1))
    states = InputStates.of([file, None, tmp_path / "not there"])
    states.check()
    if change == "written":
        file.write_bytes(b"1235")
        os.utime(file, ns=(5, 5))
    elif change == "cut":
        os.truncate(file, 2)
    elif change == "replaced":
        os.replace(other, file)
    else:
        file.unlink()
    with pytest.raises(StapeskitError) as refused:
        states.check()
    assert [fault.where for fault in refused.value.faults] == ["a.csv"]


def test_files_within_folders_are_looked_at(tmp_path):
    inside = tmp_path / "slices" / "1.tif"
    inside.parent.mkdir()
    inside.write_bytes(b"1")
    states = InputStates.of([inside.parent])
    (inside.parent / "new").write_bytes(b"")  # what is not read may come
    states.check()
    inside.write_bytes(b"12")
    with pytest.raises(StapeskitError):
        states.check()


def test_a_disk_that_fails_is_refused(tmp_path, monkeypatch):
    states = InputStates.of([tmp_path])
    _check_inputs(states, lost_pages())
    with pytest.raises(CtInertiaError):
        _check_inputs(states, lost_pages() - 1)


def test_a_scan_that_is_rewritten_while_it_is_measured_is_refused(tmp_path, monkeypatch):
    from legacy import ct_inertia
    from legacy.ct_inertia.ct2mass import ct2mass
    from legacy.ct_inertia.options import MassOptions
    from tests.ct_inertia.readers import writers as w

    path = w.nrrd(tmp_path / "a.nrrd", w.picture())
    whole = ct_inertia.read_scan.read_volume

    def read_and_rewrite(scan, *given, **more):
        volume = whole(scan, *given, **more)
        Path(scan).write_bytes(Path(scan).read_bytes() + b"0")
        return replace(volume)

    monkeypatch.setattr(ct_inertia.read_scan, "read_volume", read_and_rewrite)
    with pytest.raises(CtInertiaError) as refused:
        ct2mass(MassOptions(scan=path, density=(1900.0, None)))
    assert refused.value.faults[0].got == "a file that changed"

"""A damaged HDF5 file neither holds up nor ends the command."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from kinematics.readers.containers import guard as hdf5_probe
from kinematics.readers.hdf5 import read
from stapeskit.faults import StapeskitError


def file(folder: Path) -> Path:
    """Write a small file."""
    path = folder / "scan.h5"
    with h5py.File(path, "w") as made:
        made["a"] = np.arange(5.0)
        made["g/b"] = np.arange(3)
        made["g"].attrs["unit"] = "m/s"
    return path


def test_a_sound_file_is_probed_in_no_time(tmp_path: Path) -> None:
    path = file(tmp_path)
    start = time.perf_counter()
    hdf5_probe.probe(path, "an HDF5 file")
    assert time.perf_counter() - start < 2.0
    hdf5_probe._walk(path)


def test_a_file_that_holds_up_the_library_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(hdf5_probe, "_walk", lambda _path: time.sleep(60.0))
    with pytest.raises(StapeskitError, match=r"must be readable; got one on which .* is stuck after 0.1 s"):
        hdf5_probe.probe(file(tmp_path), "an HDF5 file", 0.1)


def test_a_file_that_crashes_the_library_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(hdf5_probe, "_walk", lambda _path: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(StapeskitError, match=r"an HDF5 file must be readable; .* crashes \(scan.h5\)"):
        read(file(tmp_path))


def test_what_the_library_says_in_words_is_left_to_the_reader(tmp_path: Path) -> None:
    path = file(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    hdf5_probe.probe(path, "an HDF5 file")
    with pytest.raises(StapeskitError, match="an HDF5 file must be readable"):
        read(path)

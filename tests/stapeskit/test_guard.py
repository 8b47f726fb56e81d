"""A damaged HDF5 file neither holds up nor ends the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.hdf5 import read
from legacy.stapeskit import guard
from legacy.stapeskit.faults import Fault, StapeskitError
from legacy.stapeskit.guard import read_apart
from legacy.stapeskit.records.motion_files import read_motion, write_motion
from tests.fitting.cases import paper_motion


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "scan.h5"
    with h5py.File(found, "w") as made:
        made["a"] = np.arange(5.0)
        made["g"] = np.arange(6).reshape(2, 3).T
    return found


def test_arrays_come_back_as_they_were_and_can_be_written(path: Path) -> None:
    def content():
        with h5py.File(path) as file:
            return {name: file[name][()] for name in file} | {"mask": np.array([True]), "text": "a"}

    direct, apart = content(), read_apart(content, path, "a file")
    assert list(apart) == list(direct)
    for name in ("a", "g", "mask"):
        assert np.array_equal(apart[name], direct[name])
        assert (apart[name].dtype, apart[name].strides) == (direct[name].dtype, direct[name].strides)
        assert apart[name].flags.writeable
    assert apart["text"] == "a"


def test_a_sound_file_costs_little(path: Path) -> None:
    """Less than half of what a new interpreter with the libraries of a reader does, on the same machine."""

    def cost(work: Callable[[], object]) -> float:
        took = []
        for _ in range(5):
            start = sum(os.times()[:4])
            work()
            took.append(sum(os.times()[:4]) - start)
        return min(took)

    apart = cost(lambda: read_apart(lambda: None, path, "a file"))
    anew = cost(lambda: subprocess.run([sys.executable, "-c", "import numpy, h5py"], check=True))
    assert apart < 0.5 * anew


def spin() -> None:
    while True:
        pass


@pytest.mark.parametrize(
    "hold_up", [spin, lambda: time.sleep(60.0), lambda: os.kill(os.getpid(), signal.SIGSEGV), os.abort]
)
def test_what_holds_up_or_crashes_the_library_is_refused(hold_up, path: Path, monkeypatch) -> None:
    monkeypatch.setattr(guard, "_CLOCK", 2.0)
    with pytest.raises(KinematicsError) as found:
        read_apart(hold_up, path, "an HDF5 file", KinematicsError, processor_s=0.1)
    (fault,) = found.value.faults
    assert (fault.thing, fault.expected, fault.where) == ("an HDF5 file", "readable", "scan.h5")
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


def test_too_much_memory_is_an_error_and_stays_in_the_child(path: Path) -> None:
    with pytest.raises(MemoryError):
        read_apart(lambda: np.zeros(1 << 30, dtype=np.uint8) + 1, path, "a file")


def test_errors_pass_as_they_are(path: Path) -> None:
    def refuse():
        raise KinematicsError(Fault("a", "b", "c"), Fault("d"))

    with pytest.raises(KinematicsError) as refused:
        read_apart(refuse, path, "a file")
    assert refused.value.faults == (Fault("a", "b", "c"), Fault("d"))
    with pytest.raises(ZeroDivisionError) as bug:
        read_apart(lambda: 1 / 0, path, "a file")
    assert "test_guard.py" in bug.value.__notes__[0]


def test_errors_of_the_library_become_a_refusal(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(StapeskitError) as found:
        read(path)
    assert found.value.faults[0].thing == "an HDF5 file"


@pytest.mark.parametrize("name", ["dof.h5", "dof.csv"])
def test_motion_files_are_read_apart(name: str, tmp_path: Path, monkeypatch) -> None:
    motion = paper_motion(0.05, 0, lines=3)
    write_motion(tmp_path, "dof", replace(motion, n_dof=np.full(motion.chi2.shape, 6)))
    monkeypatch.setattr(guard, "_PROCESSOR_S", 0.1)
    monkeypatch.setattr(guard, "_CLOCK", 1.0)
    monkeypatch.setattr(h5py.File, "__init__", lambda *_: time.sleep(60.0))
    with pytest.raises(StapeskitError) as found:
        read_motion(tmp_path / name)
    assert found.value.faults[0].where == "dof.h5"

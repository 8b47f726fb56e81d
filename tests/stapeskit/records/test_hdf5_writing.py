"""HDF5 files written by way of memory."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from legacy.stapeskit.records.hdf5_writing import write_h5


@pytest.mark.parametrize("kind", [OSError, RuntimeError, ValueError])
def test_too_little_memory_is_no_other_error(kind, tmp_path):
    with pytest.raises(MemoryError), write_h5(tmp_path / "a.h5"):
        raise kind("Can't synchronously write data (memory allocation failed for chunk)")
    assert list(tmp_path.iterdir()) == []


def test_other_errors_stay_as_they_are(tmp_path):
    with pytest.raises(ZeroDivisionError), write_h5(tmp_path / "a.h5"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_the_file_holds_what_was_put_in(tmp_path):
    with write_h5(tmp_path / "a.h5") as file:
        file["a"] = np.arange(3)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["a"][()].tolist() == [0, 1, 2]

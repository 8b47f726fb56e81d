"""MATLAB files with several faults: all are told, by variable and element."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from scipy.io import savemat

from legacy.kinematics.readers.containers.matlab_file import read_mat
from legacy.kinematics.readers.matlab.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.test_matlab import FREQ, LINES, POINTS, VALUE, XYZ, file, usd

__all__ = ["file"]


def test_all_faults_of_the_variables_are_told_together(file):
    path = file(
        f=FREQ[:, ::-1], v=VALUE, xyz=XYZ[:4], usd=usd("dB"), coh=np.ones((2, LINES)), names=["a"] * POINTS
    )
    mapping = path.with_name("scan.mat.toml")
    mapping.write_text(
        'frequency = "f"\nposition = "xyz"\npoints = "names"\n[[signal]]\nvalue = "v"\nusd = "usd"\n'
        'coherence = "coh"\nsd = "nothing"\nn_avg = 0\ndirection = [0, 1]\n'
    )
    with pytest.raises(StapeskitError) as caught:
        read(path)
    told = str(caught.value).splitlines()
    assert len(told) == 3
    assert "got 3800 at place 2 and 38 more (scan.mat)" in told[0]
    path = file(f=FREQ, v=VALUE, xyz=XYZ[:4], usd=usd("dB"), coh=np.ones((2, LINES)), names=["a"] * POINTS)
    with pytest.raises(StapeskitError) as caught:
        read(path)
    told = str(caught.value).splitlines()
    expected = [
        'the unit of v must be m, mm, um, nm; m/s, mm/s, um/s; m/s2, mm/s2, g; got "dB"',
        "n_avg must be a number from 1 on; got 0",
        "names must be 7 different names, one a row",
        "xyz must be points x 3, here 7 x 3; got 4 x 3",
        "coh must be 7 x 40; got 2 rows",
        "the variable nothing must be in the file",
        "direction must be x, -x, ..., or three numbers; got [0, 1]",
    ]
    assert len(told) == len(expected)
    assert all(line.startswith(words) for line, words in zip(told, expected, strict=True))


def test_every_element_at_fault_is_told(file):
    good = {"f": FREQ, "v": VALUE[:1], "usd": usd()}
    elements = [{**good, "usd": usd("V")}, good, {**good, "usd": usd(PowerSignal=1.0)}]
    with pytest.raises(StapeskitError) as caught:
        read(file(point=elements))
    told = str(caught.value).splitlines()
    assert [line.split("(scan.mat, ")[1][:9] for line in told] == ["point(1))", "point(3))"]


def test_every_damaged_variable_is_told(tmp_path):
    savemat(tmp_path / "a.mat", {"first": np.eye(3), "second": np.eye(4), "third": np.eye(5)})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    for name in (b"first", b"third"):
        # The dimensions stand before the name: type, length, rows, columns.
        place = content.index(name) - 16
        content[place : place + 4] = struct.pack("<i", -7)
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(StapeskitError) as caught:
        read_mat(tmp_path / "a.mat")
    told = str(caught.value).splitlines()
    assert [line.split(" in ")[1][:10] for line in told] == ["variable 1", "variable 3"]

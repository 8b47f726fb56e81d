"""Faults of a fiducials file name the fiducial."""

from __future__ import annotations

import pytest

from kinematics.registration.fiducials import read_fiducials
from stapeskit.faults import StapeskitError


def test_a_fault_says_which_fiducial_it_is(tmp_path):
    path = tmp_path / "f.csv"
    path.write_text(
        "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm\npin,1,2,abc,0,0,0\npost,1,2,,0,0,0\npost,1,2,3,0,0,0\n",
        encoding="utf-8",
    )
    with pytest.raises(StapeskitError) as caught:
        read_fiducials(path)
    assert {fault.where.detail for fault in caught.value.faults} == {"fiducial pin", "fiducial post"}

"""Faults of a fiducials file: they name the fiducial, and another unit."""

from __future__ import annotations

import pytest

from legacy.kinematics.registration.fiducials import read_fiducials
from legacy.stapeskit.faults import StapeskitError


def test_a_fault_says_which_fiducial_it_is(tmp_path):
    path = tmp_path / "f.csv"
    path.write_text(
        "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm\npin,1,2,abc,0,0,0\npost,1,2,,0,0,0\npost,1,2,3,0,0,0\n",
        encoding="utf-8",
    )
    with pytest.raises(StapeskitError) as caught:
        read_fiducials(path)
    assert {fault.where.detail for fault in caught.value.faults} == {"fiducial pin", "fiducial post"}


@pytest.mark.parametrize(("scale", "refused"), [(1.0, False), (1e-3, True)])
def test_fiducials_in_metres_are_refused(tmp_path, scale, refused):
    path = tmp_path / "f.csv"
    places = ((0, 0, 0), (3, 0, 0), (0, 4, 0), (0, 0, 2))
    rows = [f"p{k},{','.join(str(scale * v) for v in (*place, *place))}" for k, place in enumerate(places)]
    path.write_text("name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm\n" + "\n".join(rows) + "\n")
    if not refused:
        assert len(read_fiducials(path).names) == 4
        return
    with pytest.raises(StapeskitError) as caught:
        read_fiducials(path)
    assert caught.value.faults[0].next_step == "Multiply coordinates in metres by 1000"

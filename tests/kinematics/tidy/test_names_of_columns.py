"""Column names that people write: what is meant is said, and wide tables are recognised."""

from __future__ import annotations

import pytest

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.registration.fiducials import read_fiducials
from legacy.kinematics.tidy.ldv_columns import columns_of
from legacy.kinematics.tidy.points_csv import read_points


@pytest.mark.parametrize(
    ("header", "meant"),
    [
        ("body,point,direction,freq_hz,re_m_s,im_m_s", "dir for direction"),
        ("body,point,dir,frequency,re_m_s,im_m_s", "freq_hz for frequency"),
        ("bodies,point,dir,freq_hz,re_m_s,im_m_s", "body for bodies"),
        ("body,node,dir,freq_hz,re_m_s,im_m_s", "point for node"),
    ],
)
def test_a_column_of_another_name_is_recognised(header, meant):
    with pytest.raises(KinematicsError) as caught:
        columns_of(header.split(","), "ldv.csv", True)
    assert any(meant in fault.next_step for fault in caught.value.faults)


def test_hertz_under_another_name_are_no_unknown_unit():
    with pytest.raises(KinematicsError) as caught:
        columns_of(["body", "point", "dir", "frequency_hz", "re_m_s", "im_m_s"], "ldv.csv", True)
    assert [fault.thing for fault in caught.value.faults] == ["the table"]


def test_a_table_with_a_column_per_channel_is_recognised():
    header = ["frequency [hz]", "vx mag [m/s]", "vx phase [deg]"]
    with pytest.raises(KinematicsError) as caught:
        columns_of(header, "wide.csv", True)
    assert any("one row per point" in fault.next_step for fault in caught.value.faults)


READINGS = "body,point,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s\nstapes,1,0,1,0,400,1e-5,0\n"
POINTS = "body,point,x_mm,y_mm,z_mm\nstapes,1,0,0,0\n"
FIDUCIALS = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm\na,0,0,0,1,1,1\n"


@pytest.mark.parametrize(
    ("read", "text", "step"),
    [
        (read_points, READINGS, "It looks like a table of vibrometer readings: give it first"),
        (read_points, FIDUCIALS, "It looks like a table of fiducials: give it with --fiducials"),
        (read_fiducials, POINTS, "It looks like a table of points: give it with --points"),
        (read_fiducials, READINGS, "It looks like a table of vibrometer readings"),
        (read_points, "body,point,x_mm,y_mm\ns,1,0,0\n", "Add the column"),
        (read_points, "body,point,x_m,y_m,z_m\ns,1,0,0,0\n", "Convert x_m, y_m, z_m to mm"),
    ],
)
def test_files_that_were_exchanged_are_recognised(tmp_path, read, text, step):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(KinematicsError) as caught:
        read(tmp_path / "table.csv")
    (fault,) = caught.value.faults
    assert fault.next_step.startswith(step)


@pytest.mark.parametrize("text", [POINTS, FIDUCIALS])
def test_another_table_instead_of_readings_is_recognised_in_one_sentence(text):
    with pytest.raises(KinematicsError) as caught:
        columns_of(text.splitlines()[0].split(","), "points.csv", False)
    (fault,) = caught.value.faults
    assert fault.next_step.startswith("It looks like a table of")

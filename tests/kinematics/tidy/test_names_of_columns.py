"""Column names that people write: what is meant is said, and wide tables are recognised."""

from __future__ import annotations

import pytest

from kinematics.errors import KinematicsError
from kinematics.tidy.ldv_columns import columns_of


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


def test_a_table_with_a_column_per_channel_is_recognised():
    header = ["frequency [hz]", "vx mag [m/s]", "vx phase [deg]"]
    with pytest.raises(KinematicsError) as caught:
        columns_of(header, "wide.csv", True)
    assert any("one row per point" in fault.next_step for fault in caught.value.faults)

"""Units by suffix of a column."""

import pytest

from legacy.stapeskit.units import unit_of


@pytest.mark.parametrize(
    ("column", "quantity", "scale"),
    [
        ("re_m_s", "velocity", 1.0),
        ("im_um_s", "velocity", 1e-6),
        ("amp_rms_nm", "displacement", 1e-9 * 2.0**0.5),
        ("sd_mm_s2", "acceleration", 1e-3),
        ("re_rms_m_s2", "acceleration", 2.0**0.5),
    ],
)
def test_suffixes(column, quantity, scale):
    unit = unit_of(column)
    assert (unit.part, unit.quantity) == (column.split("_")[0], quantity)
    assert unit.scale == pytest.approx(scale)
    assert unit.rms == ("_rms_" in column)


@pytest.mark.parametrize("column", ["re", "re_km", "phase_deg", "re_m_s3", "m_s", "re_m_s_rms"])
def test_other_columns_have_no_unit(column):
    assert unit_of(column) is None

"""A voxel size in metres or micrometres is recognised before the scan is read."""

from __future__ import annotations

import pytest

from legacy.ct_inertia.cli import parser
from legacy.stapeskit.faults import StapeskitError


@pytest.mark.parametrize("size", ["2.5e-5", "25", "0.025,0.025,25"])
def test_a_size_in_another_unit_is_refused(size, tmp_path):
    scan = tmp_path / "scan.tif"
    scan.touch()
    with pytest.raises(StapeskitError) as caught:
        parser().parse([str(scan), "--density", "1900", "--spacing", size])
    assert [fault.thing for fault in caught.value.faults] == ["--spacing"]


def test_sizes_in_mm_are_taken(tmp_path):
    scan = tmp_path / "scan.tif"
    scan.touch()
    for size in ("0.0005", "0.025", "0.5"):
        assert parser().parse([str(scan), "--density", "1900", "--spacing", size]).spacing_mm == (
            float(size),
        )

"""The slices of a report lie where there is most to see."""

import numpy as np

from legacy.ct_inertia.report.slices_figure import _largest_sections


def test_slices_go_through_the_largest_area_and_not_through_the_foramen():
    """An arch on a plate: the middle across x meets the hole between the legs."""
    mask = np.zeros((12, 30, 40), dtype=bool)
    mask[:, 2:6, :] = True
    mask[3:9, 6:28, 5:12] = True
    mask[4:8, 6:28, 30:34] = True
    mask[4:8, 24:28, 12:30] = True
    x, y, z = _largest_sections(mask)
    assert 5 <= x < 12
    assert 2 <= y < 6
    assert 4 <= z < 8

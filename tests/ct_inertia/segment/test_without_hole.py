"""A stapes with one crus has no hole: it is found in its window by its size, and a warning says so."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from tests.ct_inertia.ears import scan_of, window
from tests.ct_inertia.solids import implicit_surface, moved, random_rotation

LOW, HIGH = (-1.7, -0.4, -0.9), (1.7, 3.4, 0.9)


def one_crus(points):
    """Signed field of a footplate with one crus and a head, mm."""
    x, y, z = np.moveaxis(points, -1, 0)
    plate = np.maximum(np.sqrt((x / 1.4) ** 2 + (z / 0.65) ** 2) * 0.65 - 0.65, np.abs(y) - 0.13)
    crus = np.maximum(np.hypot(x - 0.1, z) - 0.24, np.abs(y - 1.4) - 1.4)
    head = (np.sqrt((x / 0.62) ** 2 + ((y - 2.7) / 0.55) ** 2 + (z / 0.42) ** 2) - 1.0) * 0.42
    return np.minimum.reduce([plate, crus, head])


@pytest.fixture(scope="module")
def scan():
    """A scan of 36 um voxels of that stapes, 45 um from the bone of its window; the stapes; a point in it."""
    h, rotation = 0.036, random_rotation(3)
    stapes = moved(implicit_surface(one_crus, LOW, HIGH, 0.05), rotation)
    solids = [(stapes, 1.0), (window(0.045, rotation), 1.0)]
    volume, _ = scan_of(solids, np.full(3, h), 1.1 * h, np.random.default_rng(3), rays=4, margin=0.4)
    return volume, stapes, np.array([0.1, 1.2, 0.0]) @ rotation.T


@pytest.mark.parametrize("seeded", [False, True])
def test_it_is_found_between_other_bone_with_or_without_a_seed(scan, seeded):
    volume, stapes, inside = scan
    bodies = find_bodies(volume, SearchOptions(seed_mm=inside if seeded else None))
    stated = np.sqrt(sum(part[0, 0] for part in bodies.moments.contributions.values()))
    assert abs(bodies.moments.volume_mm3 - stapes.moments().volume_mm3) < 3.0 * stated
    assert stated < 5e-3 * bodies.moments.volume_mm3
    assert bodies.evidence["stapes"]["holes"] == 0
    codes = {notice.code for notice in bodies.notices}
    assert {"stapes_uncertain", "cut_through_bone"} <= codes

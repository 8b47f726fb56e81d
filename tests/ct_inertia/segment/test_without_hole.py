"""A stapes with one crus, or a broken one, has no hole: it is found in its window by its size, and told."""

from __future__ import annotations

import numpy as np
import pytest

from ct_inertia.labelling.from_scan import find_bodies
from ct_inertia.segment.sight import SearchOptions
from tests.ct_inertia.ears import AIR, BONE, window_field
from tests.ct_inertia.solids import filled, grey_volume, imaged, implicit_surface, moved, random_rotation

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
    h, rotation, rng = 0.036, random_rotation(3), np.random.default_rng(3)
    stapes = moved(implicit_surface(one_crus, LOW, HIGH, 0.05), rotation)
    bone = moved(
        implicit_surface(lambda p: window_field(p, 0.045), (-2.4, -0.5, -1.7), (2.4, 0.5, 1.7), 0.06),
        rotation,
    )
    both = np.concatenate([stapes.vertices_mm, bone.vertices_mm])
    low = both.min(axis=0) - 0.4
    count = np.ceil((both.max(axis=0) + 0.4 - low) / h).astype(int)
    share = sum(filled(s, count, np.full(3, h), low, 4) for s in (stapes, bone))
    sharp = imaged(share, np.full(3, 1.1))
    grey = AIR + (BONE - AIR) * (sharp + 0.04 * rng.standard_normal(sharp.shape, dtype=np.float32))
    return grey_volume(grey, np.full(3, h), low), stapes, np.array([0.1, 1.2, 0.0]) @ rotation.T


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

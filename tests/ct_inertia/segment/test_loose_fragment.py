"""A loose fragment between the crura lies within the hull of the stapes, and is no wall of it."""

from __future__ import annotations

import numpy as np

from ct_inertia.labelling.from_scan import find_bodies
from tests.ct_inertia.ears import AIR, BONE, window_field
from tests.ct_inertia.solids import (
    filled,
    grey_volume,
    imaged,
    implicit_surface,
    moved,
    random_rotation,
    stapes_surface,
)


def test_a_fragment_36_um_from_a_crus_is_not_counted_with_the_stapes():
    h, rotation, rng = 0.036, random_rotation(3), np.random.default_rng(3)
    stapes = moved(stapes_surface(0.05), rotation)
    bone = implicit_surface(lambda p: window_field(p, 0.045), (-2.4, -0.5, -1.7), (2.4, 0.5, 1.7), 0.06)
    ball = implicit_surface(
        lambda p: np.linalg.norm(p - [-0.22, 1.1, 0.025], axis=-1) - 0.215,
        (-0.5, 0.8, -0.3),
        (0.1, 1.4, 0.4),
        0.03,
    )
    solids = [stapes, moved(bone, rotation), moved(ball, rotation)]
    low = np.min([s.vertices_mm.min(axis=0) for s in solids], axis=0) - 0.4
    high = np.max([s.vertices_mm.max(axis=0) for s in solids], axis=0) + 0.4
    count = np.ceil((high - low) / h).astype(int)
    sharp = imaged(sum(filled(s, count, np.full(3, h), low, 4) for s in solids), np.full(3, 1.1))
    grey = AIR + (BONE - AIR) * (sharp + 0.04 * rng.standard_normal(sharp.shape, dtype=np.float32))
    moments = find_bodies(grey_volume(grey, np.full(3, h), low)).moments
    stated = np.sqrt(sum(part[0, 0] for part in moments.contributions.values()))
    assert abs(moments.volume_mm3 - stapes.moments().volume_mm3) < 3.0 * stated
    assert stated < 5e-3 * moments.volume_mm3

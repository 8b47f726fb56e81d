"""A loose fragment between the crura lies within the hull of the stapes, and is no wall of it."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.labelling.from_scan import find_bodies
from tests.ct_inertia.ears import scan_of, window
from tests.ct_inertia.solids import implicit_surface, moved, random_rotation, stapes_surface


def test_a_fragment_36_um_from_a_crus_is_not_counted_with_the_stapes():
    h, rotation = 0.036, random_rotation(3)
    stapes = moved(stapes_surface(0.05), rotation)
    ball = implicit_surface(
        lambda p: np.linalg.norm(p - [-0.22, 1.1, 0.025], axis=-1) - 0.215,
        (-0.5, 0.8, -0.3),
        (0.1, 1.4, 0.4),
        0.03,
    )
    solids = [(stapes, 1.0), (window(0.045, rotation), 1.0), (moved(ball, rotation), 1.0)]
    volume, _ = scan_of(solids, np.full(3, h), 1.1 * h, np.random.default_rng(3), rays=4, margin=0.4)
    moments = find_bodies(volume).moments
    stated = np.sqrt(sum(part[0, 0] for part in moments.contributions.values()))
    assert abs(moments.volume_mm3 - stapes.moments().volume_mm3) < 3.0 * stated
    assert stated < 5e-3 * moments.volume_mm3

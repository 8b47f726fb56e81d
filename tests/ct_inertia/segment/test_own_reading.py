"""A later reading of the grey levels replaces a body only where it shows another one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from legacy.ct_inertia.segment.candidates import labelled_pieces
from legacy.ct_inertia.segment.find_stapes import _shows_more_bone

SPACING = np.full(3, 0.05)


def seen(body):
    """The first reading's view of one body with a hole."""
    pieces, found = labelled_pieces(body, SPACING)
    return SimpleNamespace(
        pieces=pieces, stapes=replace(found[0], holes=1), scan=SimpleNamespace(spacing_mm=SPACING)
    )


def ring(half_width):
    """A ring of 3.3 by 2.8 mm, its walls twice ``half_width`` voxels wide."""
    z, y, x = np.indices((40, 80, 80)) - np.array([20, 40, 40])[:, None, None, None]
    return np.maximum(np.abs(np.hypot(x / 30.0, y / 25.0) - 1.0) * 27.0, np.abs(z) - 6.0) < half_width


def test_a_body_larger_than_usual_is_not_replaced_by_itself_without_its_rim():
    large, core = seen(ring(4.0)), seen(ring(3.0))
    assert 0.05 < large.stapes.oddness < 0.3
    assert not _shows_more_bone(core, (large, large))


def test_a_body_that_holds_a_slab_of_something_else_is_replaced_by_itself_without_it():
    alone = ring(3.0)
    slab = np.zeros_like(alone)
    slab[11:30, 65:75, 20:60] = True
    both = seen(alone | slab)
    assert _shows_more_bone(seen(alone), (both, both))

"""A hole through the footplate is no second hole between crura, and what bridges a gap makes none."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.segment.candidates import labelled_pieces, with_holes_of, within_hull

STEP = 0.05


@pytest.fixture
def arch():
    """A footplate of 2.8 x 1.4 x 0.25 mm with two crura and a head, [z, y, x], y from footplate to head."""
    z, y, x = (n * STEP for n in np.indices((36, 80, 72)))
    plate = (np.abs(x - 1.8) < 1.4) & (np.abs(z - 0.9) < 0.7) & (y > 0.5) & (y < 0.75)
    crura = (np.abs(np.abs(x - 1.8) - 0.9) < 0.2) & (np.abs(z - 0.9) < 0.2) & (y > 0.5) & (y < 3.0)
    head = (np.abs(x - 1.8) < 1.1) & (np.abs(z - 0.9) < 0.3) & (y >= 3.0) & (y < 3.6)
    return plate | crura | head, (z, y, x)


def counted(solid):
    labels, (piece, *_) = labelled_pieces(solid, np.full(3, STEP))
    return with_holes_of(piece, labels == piece.label, np.full(3, STEP))


def test_a_stapes_has_one_hole(arch):
    piece = counted(arch[0])
    assert (piece.holes, piece.perforated, piece.arched) == (1, False, True)


@pytest.mark.parametrize("radius_mm", [0.12, 0.16, 0.2])
def test_a_perforated_footplate_leaves_it_a_stapes_that_is_told(arch, radius_mm):
    solid, (z, y, x) = arch
    piece = counted(solid & ((np.hypot(x - 1.9, z - 0.9) > radius_mm) | (y > 1.0)))
    assert (piece.holes, piece.perforated, piece.arched) == (2, True, True)
    assert piece.score == pytest.approx(counted(solid).score, abs=0.1)


def test_bone_that_bridges_a_narrow_gap_makes_no_perforation(arch):
    solid, (z, y, x) = arch
    wall = (z < 0.13) & (np.abs(x - 1.8) < 1.4) & (y > 0.5) & (y < 0.75)
    bridges = (z < 0.3) & (np.abs(np.abs(x - 1.8) - 1.0) < 0.1) & (y > 0.5) & (y < 0.75)
    piece = counted(solid | wall | bridges)
    assert (piece.holes, piece.perforated, piece.arched) == (2, False, False)


def test_a_body_with_two_wide_holes_is_no_stapes(arch):
    solid, (z, y, x) = arch
    across = (np.abs(x - 1.8) < 1.0) & (np.abs(z - 0.9) < 0.2) & (np.abs(y - 1.8) < 0.15)
    piece = counted(solid | across)
    assert (piece.holes, piece.perforated, piece.arched) == (2, False, False)


def test_a_wall_between_the_crura_lies_within_the_hull_of_the_rest_and_a_bone_beside_does_not(arch):
    solid, (z, y, x) = arch
    wall = (np.abs(np.abs(x - 2.4) - 0.1) < 0.06) & (np.abs(z - 0.9) < 0.2) & (y > 1.0) & (y < 2.5)
    beside = (x > 3.3) & (np.abs(z - 0.9) < 0.2) & (y > 1.0) & (y < 2.5)
    labels, pieces = labelled_pieces(solid | wall | beside, np.full(3, STEP))
    inside = {round(float(p.centre[0] * STEP), 1): within_hull(labels, pieces[0], p) for p in pieces[1:]}
    assert min(share for place, share in inside.items() if place < 3.0) > 0.9
    assert max(share for place, share in inside.items() if place > 3.0) < 0.1

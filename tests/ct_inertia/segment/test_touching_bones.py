"""Bone that touches: gaps between parts, bridges across them, and floods that share voxels between parts."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.segment.touching_bones import flood_from_markers, narrow_gaps, relabel, separate_bones
from tests.ct_inertia.balls import places, plate

SPACING, SIGMA = 0.03, 0.036
SPACINGS = np.full(3, SPACING)


def blocks(gap_mm, bridge_mm=0.0):
    """Two blocks of 0.9 mm at x = 0 with a gap, and a bridge of a round section across it."""
    x, y, z = places((80, 46, 46), SPACING)
    shift = 0.5 * (gap_mm + 0.9)
    share = plate(x + shift, 0.9, SIGMA) + plate(x - shift, 0.9, SIGMA)
    share *= plate(y, 0.9, SIGMA) * plate(z, 0.9, SIGMA)
    return x, np.where(np.hypot(y, z) < 0.5 * bridge_mm, np.where(np.abs(x) < 0.9, 1.0, share), share)


def parts(share):
    return list(separate_bones([share.astype(np.float32)], share > 0.5, SPACINGS))


def test_the_gap_of_two_blocks_is_what_lies_between_them():
    x, share = blocks(0.15)
    gaps = narrow_gaps(share.astype(np.float32), share > 0.5, SPACINGS)
    middle = np.abs(x) < 0.5 * SPACING
    inner = (slice(14, -14), slice(14, -14))
    assert np.all(gaps[inner][middle[inner]])
    assert not np.any(gaps & (np.abs(x) > 0.15))


@pytest.mark.parametrize("bridge_mm", [0.1, 0.2])
def test_blocks_are_parted_in_the_gap_that_a_bridge_crosses(bridge_mm):
    x, share = blocks(0.12, bridge_mm)
    way = parts(share)[0]
    left, right = (way.labels[(share > 0.5) & side] for side in (x < -SPACING, x > SPACING))
    assert len(way.pieces) == 2
    assert len(np.unique(left)) == len(np.unique(right)) == 1
    assert left[0] != right[0]
    assert way.pieces[0].volume_mm3 == pytest.approx(0.9**3, rel=0.05)


def test_one_block_is_not_parted():
    x, y, z = places((46, 46, 46), SPACING)
    share = plate(x, 0.9, SIGMA) * plate(y, 0.9, SIGMA) * plate(z, 0.9, SIGMA)
    assert parts(share) == []


def test_floods_meet_on_the_darkest_line():
    x, share = blocks(0.12)
    markers = np.where(x < -0.4, 1, np.where(x > 0.4, 2, 0)).astype(np.int32) * (share > 0.9)
    mask = share > 0.02
    flood = flood_from_markers(share.astype(np.float32), markers.astype(np.int32), mask)
    inner = mask & (share > 0.05)
    assert np.all(flood[inner & (x < -SPACING)] == 1)
    assert np.all(flood[inner & (x > SPACING)] == 2)
    assert not np.any(flood[~mask])


def test_labels_are_renamed_by_a_table():
    labels = np.array([[[0, 1], [2, 2]]], dtype=np.int32)
    assert relabel(labels, np.array([0, 7, 3])).tolist() == [[[0, 7], [3, 3]]]

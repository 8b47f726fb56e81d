"""Parts of one piece of the coarse view, on the finer grid and back on the coarse one."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.segment.candidates import labelled_pieces
from legacy.ct_inertia.segment.split_pieces import CoarseGrid, neck_separations, split_piece
from tests.ct_inertia.balls import AIR, BONE, places, volume_of
from tests.ct_inertia.segment.test_touching_bones import blocks

SPACING = 0.03
STEP = np.full(3, 2, dtype=np.int64)


@pytest.fixture(scope="module")
def two_blocks():
    x, share = blocks(0.12, 0.12)
    volume = volume_of(share, SPACING, noise=100.0)
    coarse = volume.array[1::2, 1::2, 1::2] > 0.5 * (AIR + BONE)
    labels, pieces = labelled_pieces(coarse, 2.0 * volume.spacing_mm)
    grid = CoarseGrid(labels, STEP, AIR, BONE, 0.5 * (AIR + BONE), 100.0)
    return x, share, next(split_piece(volume, grid, max(pieces, key=lambda piece: piece.volume_mm3)))


def test_two_parts_take_the_place_of_the_whole(two_blocks):
    x, share, parting = two_blocks
    near = x[1::2, 1::2, 1::2]
    inside = share[1::2, 1::2, 1::2] > 0.8
    left, right = (np.unique(parting.pieces[inside & side]) for side in (near < -0.06, near > 0.06))
    assert len(parting.parts) == 2
    assert len(left) == len(right) == 1
    assert {int(left[0]), int(right[0])} == {part.label for part in parting.parts}


def test_parts_are_measured_on_the_finer_grid(two_blocks):
    *_, parting = two_blocks
    for part in parting.parts:
        assert part.volume_mm3 == pytest.approx(0.9**3, rel=0.05)


def test_markers_leave_the_gap_to_the_grey_values(two_blocks):
    x, _, parting = two_blocks
    markers = parting.markers
    index = np.argwhere(markers.labels > 0)[:, ::-1] * markers.step + markers.first
    place = (index - 0.5 * (np.array(x.shape[::-1]) - 1)) * SPACING
    along = place[np.hypot(place[:, 1], place[:, 2]) > 0.1, 0]
    assert np.min(np.abs(along)) > 0.06
    assert {1, -1} == set(np.sign(along).astype(int).tolist())


def test_a_ball_has_no_neck_to_be_cut_at():
    x, y, z = places((40, 40, 40), SPACING)
    assert list(neck_separations(x * x + y * y + z * z < 0.25, np.full(3, SPACING))) == []

"""Strokes on labels: what changes, what comes back, and that the file keeps its axes."""

from __future__ import annotations

import numpy as np
import pytest

from app.drawing import Drawing, shown_part
from ct_inertia.scan.open_scan import open_labels
from stapeskit.frames import rotation_from_vector

SHAPE = (40, 44, 52)  # z, y, x
SPACING = np.array([0.02, 0.025, 0.03])
IDENTITY = np.eye(3)


def labels() -> np.ndarray:
    """A ball of stapes in a corner of a volume that no symmetry maps on itself, with other bone and plate."""
    z, y, x = np.indices(SHAPE)
    made = np.zeros(SHAPE, dtype=np.uint8)
    made[(x - 20) ** 2 + (y - 17) ** 2 + (z - 12) ** 2 < 81] = 1
    made[z > 33] = 2
    made[(x > 40) & (z < 30)] = 3
    return made


def drawing_of(made, affine) -> Drawing:
    return Drawing(made, affine, made.copy())


def grid(turn=IDENTITY) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = turn * SPACING
    affine[:3, 3] = [3.0, -4.0, 5.0]
    return affine


TURNS = {
    "as scanned": np.eye(3),
    "x and z exchanged": np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]),
    "cyclic": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "upside down": np.diag([1.0, -1.0, -1.0]),
    "half a turn": np.diag([-1.0, -1.0, 1.0]),
    "oblique": rotation_from_vector([0.2, -0.3, 0.25]) @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_untouched_labels_and_places_are_exact_in_every_orientation(turn, tmp_path):
    drawing = drawing_of(labels(), grid(turn))
    path = tmp_path / "hand_labels.seg.nrrd"
    drawing.write(path)
    again, scan = open_labels(path)
    assert np.array_equal(again, labels())
    assert np.allclose(scan.scan_from_index, grid(turn), atol=1e-12)
    # every voxel of the picture lies where the labels say: compare the places of one label in scan mm
    s, a, r = np.nonzero(drawing.shown == 1)
    shown = np.stack([r, a, s, np.ones_like(s)]).T @ drawing.affine.T
    z, y, x = np.nonzero(labels() == 1)
    known = np.stack([x, y, z, np.ones_like(x)]).T @ grid(turn).T * [-1.0, -1.0, 1.0, 1.0]
    assert np.allclose(*(part[np.lexsort(np.round(part, 6).T)] for part in (shown, known)), atol=1e-9)
    # right, anterior and superior ascend with the index of the picture
    assert np.all(np.diag(drawing.affine)[:3] > 0.0)


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_a_dab_changes_the_voxels_around_its_place(turn):
    drawing = drawing_of(labels(), grid(turn))
    place = grid(turn) @ [20, 17, 12, 1]
    voxel = np.linalg.inv(drawing.affine) @ (place * [-1.0, -1.0, 1.0, 1.0])
    drawing.paint(voxel[:3], 0, 3)
    z, y, x = np.nonzero(drawing.labels != labels())
    assert np.allclose(np.mean([x, y, z], axis=1), [20, 17, 12])
    assert len(x) == np.count_nonzero(
        np.indices((7, 7, 7)).T.reshape(-1, 3).__sub__(3).__pow__(2).sum(1) <= 9
    )


def test_undo_restores_every_voxel_after_any_number_of_strokes():
    drawing, rng, states = drawing_of(labels(), grid()), np.random.default_rng(1), []
    size = np.array(drawing.shown.shape[::-1])
    for _ in range(12):
        states.append(drawing.labels.copy())
        for _ in range(4):
            drawing.paint(rng.uniform(0.0, size), int(rng.integers(0, 4)), int(rng.integers(1, 5)))
        assert drawing.end_stroke()
    for state in reversed(states):
        drawing.undo()
        assert np.array_equal(drawing.labels, state)
    assert drawing.as_found
    assert drawing.undo() is None


def test_the_way_back_to_the_cut_as_found_can_be_undone():
    made = labels()
    made[0, 0, 0] = 3  # outside the picture: of an earlier session
    drawing = Drawing(made, grid(), labels())
    drawing.paint(np.array(drawing.shown.shape[::-1]) // 2, 0, 4)
    drawn = drawing.labels.copy()
    there, change = drawing.shown.ravel(), drawing.reset()
    there[change.index] = change.values
    assert drawing.as_found
    assert np.array_equal(there, drawing.shown.ravel())
    drawing.undo()
    assert np.array_equal(drawing.labels, drawn)


def test_changes_sent_to_the_browser_give_the_picture_that_python_holds():
    drawing, rng = drawing_of(labels(), grid(TURNS["cyclic"])), np.random.default_rng(2)
    there = drawing.shown.ravel().copy()
    size = np.array(drawing.shown.shape[::-1])
    for k in range(20):
        change = drawing.undo() if k % 5 == 4 else drawing.paint(rng.uniform(0.0, size), k % 4, 3)
        if change is not None:
            there[change.index] = change.values
        if k % 2:
            drawing.end_stroke()
    assert np.array_equal(there, drawing.shown.ravel())


def test_a_fast_stroke_leaves_no_gap():
    drawing = drawing_of(np.ones(SHAPE, dtype=np.uint8), grid())
    drawing.paint((2, 5, 5), 3, 2)
    drawing.paint((45, 20, 30), 3, 2)
    along = np.rint(np.linspace((2, 5, 5), (45, 20, 30), 200)).astype(int)
    assert np.all(drawing.shown[along[:, 2], along[:, 1], along[:, 0]] == 3)


def test_a_stapes_too_large_for_a_browser_is_shown_and_painted_in_blocks(monkeypatch):
    import app.drawing

    monkeypatch.setattr(app.drawing, "MOST_VOXELS", 3000)
    drawing = drawing_of(labels(), grid(TURNS["x and z exchanged"]))
    assert drawing.step > 1
    assert drawing.shown.size <= 3000
    voxel = np.array(drawing.shown.shape[::-1]) // 2
    drawing.paint(voxel, 2, 0)
    assert np.count_nonzero(drawing.labels != labels()) == drawing.step**3
    drawing.end_stroke()
    drawing.undo()
    assert np.array_equal(drawing.labels, labels())


def test_the_part_shown_holds_the_stapes_with_room_to_draw():
    made = np.zeros((300, 300, 300), dtype=np.uint8)
    made[100:140, 120:150, 10:40] = 1
    box, step = shown_part(made, np.full(3, 0.02))
    assert step == 1
    assert [(part.start, part.stop) for part in box] == [(46, 194), (66, 204), (0, 94)]

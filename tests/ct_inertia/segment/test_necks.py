"""Necks near the end of a body, and what a body surrounds."""

import numpy as np
import pytest

from legacy.ct_inertia.segment.candidates import labelled_pieces, surrounded
from legacy.ct_inertia.segment.necks import necks


def test_the_neck_between_two_balls_is_the_plane_where_they_meet():
    spacing = np.full(3, 0.02)
    index = np.indices((60, 60, 200))[::-1] * 0.02
    across = (index[1] - 0.6) ** 2 + (index[2] - 0.6) ** 2
    body = (across < 0.25) & (index[0] > 0.1) & (index[0] < 2.5)
    ball = across + (index[0] - 2.8) ** 2 < 0.16
    points = np.argwhere(body | ball)[:, ::-1] * 0.02
    # The ball meets the cylinder's end where its section has a radius of sqrt(0.4^2 - 0.3^2).
    best = necks(points, spacing)[0]
    assert best.normal == pytest.approx([1.0, 0.0, 0.0], abs=0.15)
    assert best.height_mm - best.normal[1:] @ [0.6, 0.6] == pytest.approx(2.5, abs=0.05)
    assert best.area_mm2 == pytest.approx(np.pi * 0.07, rel=0.2)


@pytest.mark.parametrize("spacing", [(0.02, 0.02, 0.02), (0.02, 0.02, 0.05), (0.036, 0.024, 0.024)])
def test_sections_do_not_depend_on_the_shape_of_voxels(spacing):
    """Layers of voxels beat with bins of another width: shares were a fifth too small."""
    spacing = np.array(spacing)
    x, y, z = np.meshgrid(*(np.arange(0.0, end, h) for end, h in zip((1.4, 1.4, 3.6), spacing, strict=True)))
    radius = np.where(np.abs(z - 2.6) < 0.12, 0.42, 0.6)
    inside = ((x - 0.7) ** 2 + (y - 0.7) ** 2 < radius**2) & (np.abs(z - 1.8) < 1.5)
    best = necks(np.stack([x, y, z], axis=-1)[inside], spacing)[0]
    assert best.share == pytest.approx(0.49, abs=0.04)
    assert best.beyond_mm == pytest.approx(0.7, abs=0.12)


def test_a_rod_without_a_neck_has_none():
    index = np.indices((40, 40, 160))
    inside = (index[0] - 20) ** 2 + (index[1] - 20) ** 2 < 200
    assert necks(np.argwhere(inside)[:, ::-1] * 0.02, np.full(3, 0.02)) == []


def test_a_ring_surrounds_the_block_in_its_hole_and_the_block_nothing():
    solid = np.zeros((20, 60, 60), dtype=bool)
    solid[5:15, 5:55, 5:55] = True
    solid[:, 15:45, 15:45] = False
    solid[5:15, 20:40, 20:40] = True
    labels, (ring, block) = labelled_pieces(solid, np.full(3, 0.05))
    # 400 against 50^2 - 30^2 voxels of a layer.
    assert surrounded(labels, ring) == pytest.approx(400 / 1600, rel=0.1)
    assert surrounded(labels, block) == 0.0

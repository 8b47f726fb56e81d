"""Beams of one head converge to it."""

from __future__ import annotations

import numpy as np

from kinematics.faults.parallel_beams import group_parallel_beams


def towards(heads_mm, points_mm):
    beams = heads_mm[None] - points_mm[:, None]
    return (beams / np.linalg.norm(beams, axis=2, keepdims=True)).reshape(-1, 3)


def test_channels_are_grouped_by_the_heads_that_they_point_to():
    heads = np.array([[60.0, 200.0, 0.0], [-40.0, 200.0, 50.0], [0.0, 180.0, -70.0]])
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (6, 3))
    groups = group_parallel_beams(towards(heads, points), range(18))
    assert groups == [list(range(head, 18, 3)) for head in range(3)]
    assert group_parallel_beams(towards(heads, points), [1, 4, 6]) == [[1, 4], [6]]


def test_opposite_beams_are_two_lasers():
    beam = np.array([0.0, 0.6, 0.8])
    assert group_parallel_beams(np.stack([beam, -beam, beam]), range(3)) == [[0, 2], [1]]

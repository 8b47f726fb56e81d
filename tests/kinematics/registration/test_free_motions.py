"""Motions that points on a surface leave open: closed forms of plane and sphere."""

import numpy as np
import pytest

from legacy.kinematics.registration.free_motions import open_motions, undetermined

PLACES = np.random.default_rng(0).normal(size=(60, 3))


def rows_of(points, normals):
    return np.hstack([normals, np.cross(points, normals)])


@pytest.mark.parametrize(("shape", "open_ones"), [("plane", 3), ("sphere", 3), ("blob", 0)])
def test_the_open_motions_of_a_shape(shape, open_ones):
    points = PLACES.copy()
    if shape == "plane":
        points[:, 2] = 0.0
        points -= points.mean(axis=0)
        normals = np.tile([0.0, 0.0, 1.0], (60, 1))
    else:
        points = np.concatenate([points, -points])
        normals = points / np.linalg.norm(points, axis=1)[:, None]
        if shape == "sphere":
            points = normals
        else:
            normals = normals * [1.0, 2.0, 3.0]
            normals /= np.linalg.norm(normals, axis=1)[:, None]
    lever = float(np.sqrt(np.mean(np.sum(points**2, axis=1))))
    rows = rows_of(points, normals)
    values, motions = open_motions(rows, lever)
    assert np.sum(values < 1e-12) == open_ones
    scaled = rows / np.array([1.0] * 3 + [lever] * 3)
    assert np.allclose(scaled @ motions[:, values < 1e-12], 0.0, atol=1e-6)
    assert len(undetermined(rows, points, np.eye(3), np.zeros(3), None)) == open_ones

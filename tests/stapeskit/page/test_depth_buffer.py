"""The depth buffer against closed forms: areas, planes, spheres."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.stapeskit.page.depth_buffer import fragments, nearest, vertex_normals

SHAPE = (40, 60)


def quad(low: float, high: float, height: float) -> np.ndarray:
    """Two triangles that cover columns and rows from ``low`` to ``high`` at one height."""
    a, b, c, d = (low, low, height), (high, low, height), (high, high, height), (low, high, height)
    return np.array([[a, b, c], [a, c, d]], dtype=float)


def test_a_square_covers_its_pixels_and_no_other():
    place, *_ = fragments(quad(4.5, 14.5, 1.0), SHAPE)
    rows, columns = np.divmod(np.unique(place), SHAPE[1])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (5, 14, 5, 14)
    assert len(np.unique(place)) == 100


def test_what_lies_beyond_the_picture_is_left_out():
    place, *_ = fragments(quad(-20.0, 500.0, 1.0), SHAPE)
    assert np.array_equal(np.unique(place), np.arange(SHAPE[0] * SHAPE[1]))
    assert len(fragments(quad(-20.0, -5.0, 1.0), SHAPE)[0]) == 0


def test_height_is_that_of_the_plane_and_shares_give_back_the_pixel():
    rng = np.random.default_rng(1)
    corners = rng.uniform(2.0, 38.0, (30, 3, 3))
    corners[:, :, 2] = 0.3 * corners[:, :, 0] - 0.7 * corners[:, :, 1] + 2.0
    place, height, face, shares = fragments(corners, SHAPE)
    rows, columns = np.divmod(place, SHAPE[1])
    assert height == pytest.approx(0.3 * columns - 0.7 * rows + 2.0, abs=1e-9)
    assert shares.sum(axis=1) == pytest.approx(np.ones(len(place)), abs=1e-12)
    assert np.einsum("nk,nki->ni", shares, corners[face])[:, 0] == pytest.approx(columns, abs=1e-9)


def test_the_area_of_many_triangles_is_their_number_of_pixels():
    """Pixels sample the plane: the number over the area tends to one with the size, as length over area."""
    corners = np.array([[[0.2, 0.3, 0.0], [55.7, 3.1, 0.0], [20.4, 38.6, 0.0]]])
    exact = 0.5 * abs(np.linalg.det(corners[0, 1:, :2] - corners[0, 0, :2]))
    length = np.linalg.norm(np.roll(corners[0], 1, axis=0) - corners[0], axis=1).sum()
    assert abs(len(fragments(corners, SHAPE)[0]) - exact) < 0.2 * length


def test_the_eye_sees_what_is_nearest():
    place, height, face, _ = fragments(np.concatenate([quad(0.0, 30.0, 1.0), quad(10.0, 20.0, 2.0)]), SHAPE)
    seen = nearest(place, height, SHAPE[0] * SHAPE[1])
    near = np.isin(face[seen], (2, 3))
    assert len(seen) == 31 * 31
    assert near.sum() == 11 * 11
    assert height[seen][near] == pytest.approx(np.full(121, 2.0), abs=1e-12)


def test_normals_of_a_sphere_point_outward_and_converge():
    import trimesh

    errors = []  # five faces meet at twelve corners of an icosphere: first order there
    for level in (2, 3):
        ball = trimesh.creation.icosphere(subdivisions=level)
        normals = vertex_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        errors.append(np.sqrt(np.mean(np.sum((normals - ball.vertices) ** 2, axis=1))))
    assert errors[0] < 0.02
    assert errors[0] / errors[1] > 2.0

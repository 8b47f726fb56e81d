"""Rigid transforms: group axioms, exactness near the identity and near a half turn, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import (
    RigidTransform,
    axes_matrix,
    axis_vector,
    cross_matrix,
    rotation_from_vector,
    vector_from_rotation,
)

unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
angles = st.one_of(
    st.floats(0.0, np.pi), st.floats(1e-14, 1e-6), st.floats(0.0, 1e-7).map(lambda e: np.pi - e)
)


def turned(axis, angle):
    length = np.linalg.norm(axis)
    return np.array([0.0, 0.0, angle]) if length < 1e-3 else axis / length * angle


def pose(axis, angle, shift, to="b", source="a"):
    return RigidTransform.from_parts(rotation_from_vector(turned(axis, angle)), 50.0 * shift, to, source)


@given(vectors, angles)
def test_rotation_vector_is_read_back(axis, angle):
    rotation = rotation_from_vector(turned(axis, angle))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)
    again = rotation_from_vector(vector_from_rotation(rotation))
    assert np.allclose(again, rotation, atol=1e-13)


@given(vectors, st.floats(1e-15, 1e-7))
def test_small_rotation_keeps_its_relative_accuracy(axis, angle):
    vector = turned(axis, angle)
    assert np.allclose(vector_from_rotation(rotation_from_vector(vector)), vector, rtol=1e-12, atol=1e-24)


def test_half_turns_are_read_back():
    for axis in (*np.eye(3), np.array([1.0, -2.0, 0.5]), np.array([0.0, 1.0, -1.0])):
        vector = axis / np.linalg.norm(axis) * np.pi
        found = vector_from_rotation(rotation_from_vector(vector))
        assert min(np.linalg.norm(found - vector), np.linalg.norm(found + vector)) < 1e-9


def test_rotation_turns_right_handed():
    quarter = rotation_from_vector([0.0, 0.0, np.pi / 2])
    assert np.allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


@given(vectors, angles, vectors, vectors, angles, vectors, vectors, angles, vectors)
@settings(max_examples=60)
def test_group_axioms(a1, t1, s1, a2, t2, s2, a3, t3, s3):
    d_from_c, c_from_b, b_from_a = pose(a1, t1, s1, "d", "c"), pose(a2, t2, s2, "c", "b"), pose(a3, t3, s3)
    left = (d_from_c @ c_from_b) @ b_from_a
    right = d_from_c @ (c_from_b @ b_from_a)
    assert np.allclose(left.matrix, right.matrix, atol=1e-10)
    assert (left.to, left.source) == ("d", "a")
    around = b_from_a.inverse() @ b_from_a
    assert np.allclose(around.matrix, np.eye(4), atol=1e-11)
    assert (around.to, around.source) == ("a", "a")
    point = np.array([[3.0, -2.0, 7.0]])
    assert np.allclose(
        (c_from_b @ b_from_a).points(point), c_from_b.points(b_from_a.points(point)), atol=1e-10
    )


def test_vectors_are_not_shifted():
    moved = RigidTransform.from_parts(np.eye(3), [1.0, 2.0, 3.0], "b", "a")
    assert np.array_equal(moved.vectors([[1.0, 0.0, 0.0]]), [[1.0, 0.0, 0.0]])
    assert np.array_equal(moved.points([[1.0, 0.0, 0.0]]), [[2.0, 2.0, 3.0]])


def test_perturbed_displaces_the_source_frame_in_its_own_axes():
    base = RigidTransform.from_parts(rotation_from_vector([0.0, 0.0, np.pi / 2]), [10.0, 0.0, 0.0], "b", "a")
    moved = base.perturbed([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert np.allclose(moved.translation_mm, [10.0, 2.0, 0.0])
    spun = base.perturbed([0.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    assert np.allclose(spun.translation_mm, base.translation_mm)
    assert np.allclose(spun.rotation, base.rotation @ rotation_from_vector([0.0, 0.0, 0.1]))


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (np.eye(3), "finite 4x4"),
        (np.full((4, 4), np.nan), "finite 4x4"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "orthonormal"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "--mirror"),
        (np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1.0]]), "last row"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(matrix, match):
    with pytest.raises(StapeskitError, match=match):
        RigidTransform(matrix, "b", "a")


def test_frames_that_do_not_meet_are_refused():
    with pytest.raises(StapeskitError, match="do not meet"):
        RigidTransform.identity("c", "b") @ RigidTransform.identity("x", "a")


def test_a_transform_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        RigidTransform.identity("b", "a").matrix[0, 3] = 1.0


def test_axes_matrix_keeps_y_and_squares_x():
    axes = axes_matrix([1.0, 1.0, 0.0], [0.0, 3.0, 0.0])
    assert np.allclose(axes, np.eye(3))
    with pytest.raises(StapeskitError, match="not parallel to y"):
        axes_matrix([0.0, 2.0, 0.0], [0.0, 1.0, 0.0])
    with pytest.raises(StapeskitError, match="non-zero vector"):
        axes_matrix([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])


@given(vectors, vectors)
def test_cross_matrix(a, b):
    assert np.allclose(cross_matrix(a) @ b, np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize(("name", "vector"), [("x", (1, 0, 0)), ("+Y", (0, 1, 0)), ("-z", (0, 0, -1))])
def test_axes_are_read_by_their_letters(name, vector):
    assert np.array_equal(axis_vector(name), vector)


@pytest.mark.parametrize("name", ["", "-", "xy", "--x", "w", "1"])
def test_what_is_no_axis_has_no_vector(name):
    assert axis_vector(name) is None

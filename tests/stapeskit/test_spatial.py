"""Twists and spatial inertia: power and energy do not depend on the frame; parallel axes; refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.spatial import (
    DOF_NAMES,
    central_tensor,
    check_inertia,
    cross,
    inertia_faults,
    matrix_from_parameters,
    parameter_basis,
    parameters_from_matrix,
    point_rows,
    shifted_point_rows,
    twist_transfer,
)

numbers = st.floats(-1.0, 1.0)
triples = st.tuples(numbers, numbers, numbers).map(np.array)


def cloud(seed, count=12):
    """Point masses: total kinetic energy is the oracle for the 6x6 matrix."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1.0, count), rng.normal(size=(count, 3))


def parameters_of(masses, places):
    tensor = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True))
    first = masses @ places
    return np.array(
        [
            masses.sum(),
            *first,
            tensor[0, 0],
            tensor[1, 1],
            tensor[2, 2],
            tensor[0, 1],
            tensor[1, 2],
            tensor[0, 2],
        ]
    )


@given(st.integers(0, 50), triples, triples)
def test_kinetic_energy_is_that_of_the_points(seed, velocity, omega):
    masses, places = cloud(seed)
    matrix = matrix_from_parameters(parameters_of(masses, places))
    q = np.concatenate([velocity, omega])
    each = velocity + np.cross(omega, places)
    assert q @ matrix @ q == pytest.approx(np.sum(masses * np.sum(each**2, axis=1)), abs=1e-12)


@given(triples, triples, triples, triples, triples)
def test_power_does_not_depend_on_the_frame(spin, shift, velocity, omega, force):
    rotation = rotation_from_vector(3.0 * spin)
    moment = np.cross([0.3, -0.2, 0.5], force)
    transfer = twist_transfer(rotation, shift)
    q, wrench = np.concatenate([velocity, omega]), np.concatenate([force, moment])
    wrench_new = np.concatenate([rotation @ force, rotation @ (moment - np.cross(shift, force))])
    assert wrench_new @ transfer @ q == pytest.approx(wrench @ q, abs=1e-12)


@given(st.integers(0, 50), triples, triples)
def test_mass_matrix_transforms_with_the_twist(seed, spin, shift):
    masses, places = cloud(seed)
    rotation = rotation_from_vector(3.0 * spin)
    transfer = twist_transfer(rotation, shift)
    here = matrix_from_parameters(parameters_of(masses, places))
    there = matrix_from_parameters(parameters_of(masses, (places - shift) @ rotation.T))
    inverse = np.linalg.inv(transfer)
    assert np.allclose(inverse.T @ here @ inverse, there, atol=1e-11)


def test_parallel_axis():
    masses, places = cloud(3)
    mass, about_com = central_tensor(parameters_of(masses, places))
    centre = masses @ places / mass
    assert np.allclose(about_com, central_tensor(parameters_of(masses, places - centre))[1], atol=1e-12)
    assert mass == pytest.approx(masses.sum())
    assert central_tensor(np.zeros(10))[0] == 0.0


def test_signs_of_the_paper():
    matrix = matrix_from_parameters([2.0, 0.2, 0.4, 0.6, 1, 1, 1, 0, 0, 0])
    y, alpha, gamma = (DOF_NAMES.index(name) for name in ("y", "alpha", "gamma"))
    assert matrix[y, alpha] == pytest.approx(-0.6)
    assert matrix[y, gamma] == pytest.approx(0.2)


def test_parameters_are_read_back():
    values = np.arange(1.0, 11.0)
    assert np.allclose(parameters_from_matrix(matrix_from_parameters(values)), values)
    assert np.allclose(np.tensordot(values, parameter_basis(), 1), matrix_from_parameters(values))


@given(triples, triples, triples, triples)
def test_point_rows_are_the_velocity_along_the_beam(arm, direction, velocity, omega):
    row = point_rows([arm], [direction])[0]
    expected = (velocity + np.cross(omega, arm)) @ direction
    assert row @ np.concatenate([velocity, omega]) == pytest.approx(expected, abs=1e-14)


def test_rows_of_shifted_points_differ_by_the_shifted_rows():
    arms, beams, shift = np.random.default_rng(3).normal(size=(3, 5, 3))
    change = point_rows(arms + shift, beams) - point_rows(arms, beams)
    assert np.allclose(shifted_point_rows(beams, shift), change, atol=1e-14)


def box(a, b, c, mass=1.0):
    return np.diag([mass, mass, mass, *(mass / 12 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2]))])


def test_a_box_is_possible():
    assert inertia_faults(box(1.0, 2.0, 3.0)) == []


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (np.eye(5), "finite 6x6"),
        (np.full((6, 6), np.inf), "finite 6x6"),
        (box(1, 2, 3) + np.eye(6, k=1) * 1e-3, "symmetric"),
        (np.diag([1.0, 2.0, 1.0, 1.0, 1.0, 1.0]), "rigid body"),
        (-box(1, 2, 3), "positive"),
        (np.diag([1, 1, 1, 1, -0.1, 1.0]), "positive definite"),
        (np.diag([1, 1, 1, 1, 1, 3.0]), "triangle inequality"),
    ],
)
def test_impossible_inertia_is_refused(matrix, match):
    with pytest.raises(StapeskitError, match=match):
        check_inertia(matrix)


@pytest.mark.parametrize(("one", "two"), [((5, 3), (5, 3)), ((3,), (5, 3)), ((4, 5, 3), (5, 3))])
def test_products_of_vectors_are_those_of_numpy(one, two):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=one), rng.normal(size=two)
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))

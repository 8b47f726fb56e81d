"""Exact bodies: moments and frames in closed form, identities, and families of stapes."""

from __future__ import annotations

import numpy as np
import pytest

import simulate
from simulate import STAPES, Ear, Solid, Stapes, stapes_solid
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.spatial import inertia_faults, matrix_from_parameters, twist_transfer


def shoelace_moments(polygon):
    """Area and second moments about the origin of a polygon (n, 2)."""
    x, y = polygon.T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    turn = x * y2 - x2 * y
    return 0.5 * turn.sum(), ((x * x + x * x2 + x2 * x2) @ turn / 12.0)


def test_box_has_the_moments_of_a_box():
    lengths, centre = np.array([1.0, 2.0, 0.5]), np.array([100.0, -3.0, 7.0])
    moments = simulate.box(centre - lengths / 2.0, centre + lengths / 2.0).moments()
    assert moments.volume_mm3 == pytest.approx(1.0, rel=1e-14)
    assert moments.centroid_mm == pytest.approx(centre, abs=1e-12)
    assert moments.second_mm5 == pytest.approx(np.diag(lengths**2) / 12.0, abs=1e-12)


@pytest.mark.parametrize("radii", [(1.0, 1.0, 1.0), (0.4, 0.2, 0.9)])
def test_ellipsoid_converges_to_closed_form_with_second_order(radii):
    exact_volume = 4.0 / 3.0 * np.pi * np.prod(radii)
    exact_second = exact_volume * np.square(radii) / 5.0
    errors = []
    for steps in (24, 48, 96):
        moments = simulate.ellipsoid([1.0, 2.0, 3.0], radii, steps).moments()
        second = np.abs(np.diag(moments.second_mm5) / exact_second - 1.0).max()
        errors.append([abs(moments.volume_mm3 / exact_volume - 1.0), second])
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert order == pytest.approx(np.full((2, 2), 2.0), abs=0.05)


def test_rod_and_ring_are_prisms():
    sides, radius, length = 12, 0.3, 1.7
    area = 0.5 * sides * radius**2 * np.sin(2.0 * np.pi / sides)
    moments = simulate.rod([0.0, 1.0, 0.0], [0.0, 1.0 + length, 0.0], radius, sides).moments()
    assert moments.volume_mm3 == pytest.approx(area * length, rel=1e-13)
    assert moments.second_mm5[1, 1] == pytest.approx(area * length**3 / 12.0, rel=1e-12)
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    outline = np.column_stack([1.4 * np.cos(angle), 0.6 * np.sin(angle)])
    inner, inner_second = shoelace_moments(outline)
    moments = simulate.ring(outline, 2.0 * outline, -0.1, 0.4).moments()
    assert moments.volume_mm3 == pytest.approx(3.0 * inner * 0.5, rel=1e-12)
    assert moments.second_mm5[0, 0] == pytest.approx(15.0 * inner_second * 0.5, rel=1e-12)


def test_mass_matrix_follows_the_parallel_axis_and_turns_with_the_body():
    solid = stapes_solid(Stapes())
    body = simulate.uniform_mass(solid.moments(), 1382.4)
    assert body.mass_kg == pytest.approx(3.2e-6, rel=1e-4)
    assert not inertia_faults(body.matrix())
    pose = RigidTransform.from_parts(
        rotation_from_vector([0.4, -0.2, 0.9]), [3.0, -1.0, 2.0], "scan", "footplate"
    )
    turned = simulate.uniform_mass(solid.moved(pose).moments(), 1382.4).matrix()
    # q about the scan origin in scan axes, from q about the footplate centre in footplate axes.
    back = twist_transfer(pose.rotation, pose.inverse().translation_mm * 1e-3)
    expected = np.linalg.inv(back).T @ body.matrix() @ np.linalg.inv(back)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((turned - expected) / scale).max() < 1e-12


def test_point_masses_are_added():
    ear = Ear(loose_masses=((0.1, 3.3, 0.2, 2e-7),))
    extra = ear.moving_mass_si() - ear.mass().matrix()
    assert extra[0, 0] == pytest.approx(2e-7, rel=1e-9)
    assert extra[1, 1] == pytest.approx(2e-7, rel=1e-9)
    assert extra[3, 3] == pytest.approx(2e-7 * (3.3**2 + 0.2**2) * 1e-6, rel=1e-9)
    assert matrix_from_parameters(simulate.point_mass(2e-7, (0.1, 3.3, 0.2)))[3:, 3:] == pytest.approx(
        extra[3:, 3:], rel=1e-9
    )


@pytest.mark.parametrize(
    "family", [name for name in STAPES if "foreign" not in name or name.endswith("base")]
)
def test_families_are_closed_and_lie_in_their_own_frame(family):
    solid = stapes_solid(Stapes(family=family, step_mm=0.07))
    assert solid.is_closed()
    found = simulate.footplate_frame(solid).matrix
    assert np.abs(found - np.eye(4)).max() < 2e-5
    assert solid.vertices_mm[:, 1].max() > 2.5
    assert abs(solid.moments().centroid_mm[0]) < 0.4


def test_footplate_frame_turns_and_moves_with_the_body():
    solid = stapes_solid(Stapes())
    pose = RigidTransform.from_parts(
        rotation_from_vector([0.15, -0.1, 0.2]), [5.0, 2.0, -1.0], "body", "footplate"
    )
    found = simulate.footplate_frame(solid.moved(pose))
    assert np.abs(found.matrix - pose.matrix).max() < 5e-6


def test_mirrored_and_scaled_stapes():
    left, right = stapes_solid(Stapes()), stapes_solid(Stapes(mirrored=True))
    flip = np.array([1.0, 1.0, -1.0])
    assert right.moments().centroid_mm == pytest.approx(left.moments().centroid_mm * flip, abs=1e-12)
    assert right.moments().volume_mm3 == pytest.approx(left.moments().volume_mm3, rel=1e-12)
    scaled = stapes_solid(Stapes(scale=1.1))
    assert scaled.moments().volume_mm3 == pytest.approx(1.1**3 * left.moments().volume_mm3, rel=1e-9)
    warped = stapes_solid(Stapes(warp=0.05, seed=2))
    assert isinstance(warped, Solid)
    assert warped.is_closed()
    assert np.abs(warped.vertices_mm - left.vertices_mm).max() > 0.01

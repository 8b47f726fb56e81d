"""Walls thinner than the blur: how far their half level lies inside them, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from legacy.ct_inertia.grey.thin_walls import smoothed, thin_wall_shift, vertex_normals
from legacy.ct_inertia.surface.surface import Surface
from tests.ct_inertia.balls import ball, places, plate

SPACING, SIGMA = 0.02, 0.024


def surface_of(share):
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(share, 0.5, allow_degenerate=False)
    points = vertices[:, ::-1] * SPACING
    try:
        return Surface(points, faces)
    except ValueError:
        return Surface(points, faces[:, ::-1])


def disc(thickness_mm, radius_mm=0.6):
    x, y, z = places((80, 80, 24), SPACING)
    return plate(z, thickness_mm, SIGMA) * np.clip((radius_mm - np.hypot(x, y)) / SPACING, 0.0, 1.0)


@pytest.mark.parametrize("widths", [1.7, 2.2, 3.0, 4.0])
def test_a_plate_is_shifted_out_to_its_thickness(widths):
    thickness = widths * SIGMA
    share = disc(thickness).astype(np.float32)
    surface = surface_of(share)
    transform = np.diag([SPACING, SPACING, SPACING, 1.0])
    shift = thin_wall_shift(surface, vertex_normals(surface), share, transform, SIGMA)
    middle = 0.5 * (np.array([80, 80, 24]) - 1) * SPACING
    x, y, _ = (surface.vertices_mm - middle).T
    face = np.hypot(x, y) < 0.3
    half = brentq(lambda height: plate(height, thickness, SIGMA) - 0.5, 0.0, thickness)
    assert np.median(shift[face]) == pytest.approx(0.5 * thickness - half, abs=0.03 * SIGMA)


def test_a_thick_body_is_not_shifted():
    x, y, z = places((60, 60, 60), SPACING)
    share = ball(np.sqrt(x * x + y * y + z * z), 0.45, SIGMA).astype(np.float32)
    surface, transform = surface_of(share), np.diag([SPACING, SPACING, SPACING, 1.0])
    shift = thin_wall_shift(surface, vertex_normals(surface), share, transform, SIGMA)
    assert np.max(np.abs(shift)) < 0.02 * SIGMA


def test_normals_of_a_ball_point_outward():
    x, y, z = places((60, 60, 60), SPACING)
    surface = surface_of(ball(np.sqrt(x * x + y * y + z * z), 0.45, SIGMA))
    out = surface.vertices_mm - 0.5 * 59 * SPACING
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    assert np.min(np.sum(vertex_normals(surface) * out, axis=1)) > np.cos(np.radians(4.0))


def test_smoothing_leaves_a_constant_and_calms_noise():
    x, y, z = places((40, 40, 40), SPACING)
    surface = surface_of(ball(np.sqrt(x * x + y * y + z * z), 0.3, SIGMA))
    count = len(surface.vertices_mm)
    assert np.allclose(smoothed(surface, np.ones(count)), 1.0)
    noise = np.random.default_rng(0).standard_normal(count)
    assert np.std(smoothed(surface, noise)) < 0.5

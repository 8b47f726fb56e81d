"""Noise of a surface, carried into a frame: known density of a plane, known frame of a disc."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.frames.footplate_noise import height_covariance, height_noise, rim_influence
from legacy.ct_inertia.frames.footplate_search import face_candidates, sphere
from legacy.ct_inertia.surface.surface_field import Diffusion, Mesh, Patch
from tests.ct_inertia.shapes import box

EDGE = 0.03


def sheet(count=80):
    """A square of triangles in the plane z = 0."""
    axis = np.arange(count) * EDGE
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.column_stack([corner, corner + 1, corner + count])
    upper = np.column_stack([corner + 1, corner + count + 1, corner + count])
    return points, np.vstack([lower, upper])


def even(_distance):
    return np.ones(np.shape(_distance))


def test_the_density_of_height_noise_is_its_variance_times_the_area_of_a_vertex():
    points, faces = sheet()
    sd, grain = 0.002, 2.0 * EDGE
    shown = []
    for seed in range(4):
        lifted = points.copy()
        white = sd * np.random.default_rng(seed).standard_normal((80, 80))
        lifted[:, 2] = gaussian_filter(white, grain / EDGE).ravel()
        mesh = Mesh(lifted, faces)
        inner = np.flatnonzero(np.all((points[:, :2] > 0.3) & (points[:, :2] < 2.0), axis=1))
        normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        shown.append(height_noise(Diffusion(mesh, 0.12), inner, normals, grain))
    assert np.mean(shown) == pytest.approx(sd**2 * EDGE**2, rel=0.1)


def test_noise_of_a_disc_moves_its_plane_as_least_squares_says():
    rng = np.random.default_rng(2)
    cells = 200
    places = np.sqrt(rng.uniform(size=cells)) * np.array([1.0])
    angle = rng.uniform(0.0, 2.0 * np.pi, cells)
    centres = np.column_stack([places * np.cos(angle), np.zeros(cells), places * np.sin(angle)])
    areas = np.full(cells, np.pi / cells)
    density = 1e-6
    covariance = density * height_covariance((np.zeros(3), np.eye(3)), centres, areas, even)
    heights = rng.standard_normal((4_000, cells)) * np.sqrt(density / areas)
    design = np.column_stack([np.ones(cells), centres[:, 0], centres[:, 2]])
    fitted = heights @ np.linalg.pinv(design).T
    # y = a + b x + c z: gamma = b, alpha = -c, and the origin is the mean height.
    expected = np.cov(np.column_stack([heights.mean(axis=1) * 1e-3, -fitted[:, 2], fitted[:, 1]]).T)
    assert np.allclose(covariance[np.ix_([1, 3, 5], [1, 3, 5])], expected, atol=0.08 * expected.max())


def test_a_rim_that_moves_out_all_round_moves_nothing():
    count = 90
    angle = np.linspace(0.0, 2.0 * np.pi, count + 1)
    ring = np.column_stack([np.cos(angle), np.zeros(count + 1), np.sin(angle)])
    segments = np.stack([ring[:-1], ring[1:]], axis=1)
    triangles = np.stack([np.zeros((count, 3)), ring[:-1], ring[1:]], axis=1)
    areas = np.full(count, np.pi / count)
    keys = np.column_stack([np.arange(count), np.arange(1, count + 1)])
    patch = Patch(triangles, areas, np.arange(0), segments, keys, np.ones(count), False)
    influence, length = rim_influence(
        (np.zeros(3), np.eye(3)), patch, areas, triangles.mean(axis=1), 60.0, even
    )
    assert length.sum() == pytest.approx(2.0 * np.pi, rel=1e-3)
    assert np.allclose(length @ influence[:, :3], 0.0, atol=1e-12)
    # The side x > 0 alone: its centre moves by the integral of x over the arc, 2, over the area.
    half = segments.mean(axis=1)[:, 0] > 0.0
    assert (length * half) @ influence[:, 0] == pytest.approx(2.0 / np.pi, rel=2e-3)


def test_the_largest_face_of_a_box_is_found_first():
    surface = box((2.0, 1.0, 1.5))
    faces = face_candidates(Mesh(surface.vertices_mm, surface.faces), float(np.linalg.norm([2.0, 1.0, 1.5])))
    assert faces[0].area_mm2 == pytest.approx(3.0, rel=0.02)
    assert abs(faces[0].outward[1]) > np.cos(np.radians(6.0))
    assert all(a.area_mm2 >= b.area_mm2 for a, b in pairwise(faces))


def test_directions_cover_the_sphere_evenly():
    directions = sphere(300)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert np.allclose(directions.mean(axis=0), 0.0, atol=0.01)
    cosine = directions @ directions.T - 2.0 * np.eye(300)
    assert np.degrees(np.arccos(cosine.max(axis=1))).min() > 6.0

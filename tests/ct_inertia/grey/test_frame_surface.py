"""The surface for the footplate frame: a blurred ball in closed form, and taking the blur back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.frames.footplate_face import correct_blur
from legacy.ct_inertia.grey.frame_surface import frame_surface, height_noise_of
from legacy.ct_inertia.surface.surface import enclosed_volume
from legacy.ct_inertia.surface.surface_field import Diffusion, Mesh
from legacy.stapeskit.frames import vector_from_rotation
from sample_volumes import phantom

RADIUS = 0.5


def blurred_ball(sigma, voxel, shift=(0.013, -0.004, 0.007)):
    """Share (z, y, x) of a ball under a Gaussian blur, in closed form, and its grid (4, 4)."""
    count = int(np.ceil((RADIUS + 5.0 * sigma) / voxel))
    ticks = voxel * np.arange(-count, count + 1)
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    r = np.sqrt((x - shift[0]) ** 2 + (y - shift[1]) ** 2 + (z - shift[2]) ** 2) + 1e-9
    near, far = (RADIUS - r) / sigma, (RADIUS + r) / sigma
    share = 0.5 * (erf(near / np.sqrt(2.0)) + erf(far / np.sqrt(2.0)))
    share -= sigma / (r * np.sqrt(2.0 * np.pi)) * (np.exp(-0.5 * near**2) - np.exp(-0.5 * far**2))
    grid = np.diag([voxel, voxel, voxel, 1.0])
    grid[:3, 3] = -count * voxel - np.array(shift)
    return share.astype(np.float32), grid


def radius(vertices, faces):
    """Radius of the ball that holds as much as a surface."""
    return (enclosed_volume(vertices, faces) * 3.0 / (4.0 * np.pi)) ** (1.0 / 3.0)


@pytest.mark.parametrize(("voxel", "sigma"), [(0.02, 0.024), (0.04, 0.05), (0.0125, 0.02)])
def test_a_blurred_ball_shrinks_and_is_put_back(voxel, sigma):
    surface, blur, _ = frame_surface(*blurred_ball(sigma, voxel), sigma)
    shrunk = blur**2 / RADIUS
    assert blur > sigma
    assert RADIUS - radius(surface.vertices_mm, surface.faces) == pytest.approx(shrunk, rel=0.05)
    back = correct_blur(Diffusion(Mesh(surface.vertices_mm, surface.faces), 0.05), blur)
    assert abs(RADIUS - radius(back, surface.faces)) < 0.05 * shrunk


def test_what_the_curvature_leaves_is_of_fourth_order_in_the_blur():
    """A ball's half level stands at R - s^2 / R - 2 s^4 / (3 R^3) + O(s^6), by series of its closed form."""
    for sigma in (0.08, 0.11):
        surface, blur, _ = frame_surface(*blurred_ball(sigma, 0.03), sigma)
        shrunk = RADIUS - radius(surface.vertices_mm, surface.faces)
        left = (shrunk - blur**2 / RADIUS) / (blur**4 / RADIUS**3)
        assert left == pytest.approx(2.0 / 3.0, rel=0.3)


def test_a_plane_between_the_voxels_is_met_everywhere():
    voxel, sigma = 0.02, 0.024
    for offset in (0.0, 0.003, 0.01, 0.017):
        z = voxel * np.arange(40) - 0.4
        share = np.zeros((40, 30, 30), dtype=np.float32)
        share[...] = (0.5 * (1.0 - erf((z - offset) / (sigma * np.sqrt(2.0)))))[:, None, None]
        surface, *_ = frame_surface(share, np.diag([voxel, voxel, voxel, 1.0]), sigma)
        top = surface.vertices_mm[surface.vertices_mm[:, 2] > 0.3, 2] - 0.4
        assert np.median(top) == pytest.approx(offset, abs=3e-4)


@pytest.mark.parametrize(("voxel", "height_um"), [(0.03, 1.5), (0.04, 2.5)])
def test_the_face_of_the_real_stapes_keeps_its_height(voxel, height_um):
    ear = phantom.Ear(voxel_mm=(voxel,) * 3, plate=False, bone=False, pose_seed=7, noise_seed=7)
    placed = phantom.scene(replace(ear, tilt_deg=80.0))
    share = (phantom.render(placed).astype(np.float32) - ear.levels[0]) / (ear.levels[2] - ear.levels[0])
    surface, blur, _ = frame_surface(
        share, np.diag([voxel, voxel, voxel, 1.0]), voxel * np.sqrt(1.44 + 1 / 12)
    )
    truth = placed.scan_from_footplate
    frame = footplate_frame(surface, AnatomyHints(anterior=truth.rotation[:, 0]), blur)
    between = truth.inverse() @ frame.scan_from_footplate
    assert abs(between.translation_mm[1]) < 1e-3 * height_um
    assert np.linalg.norm(between.translation_mm) < 0.006
    assert np.degrees(np.linalg.norm(vector_from_rotation(between.rotation))) < 0.3
    error = np.concatenate([1e-3 * between.translation_mm, vector_from_rotation(between.rotation)])
    assert np.all(np.abs(error) < 3.0 * np.sqrt(np.diag(frame.covariance)))


def test_noise_that_neighbours_share_moves_a_face_as_foretold():
    voxel, sigma, length, noise = 0.03, 0.036, 1.0, 0.05
    grid = np.diag([voxel, voxel, voxel, 1.0])
    side = 44
    z = voxel * np.arange(24) - 0.35
    step = (0.5 * (1.0 - erf(z / (sigma * np.sqrt(2.0)))))[:, None, None]
    random = np.random.default_rng(4)
    means = []
    for _ in range(40):
        shared = gaussian_filter(random.normal(size=(24, side, side)), length, mode="wrap")
        share = (step + noise / shared.std() * shared).astype(np.float32)
        share[share < 0.1] = 0.0
        surface, blur, _ = frame_surface(share, grid, sigma)
        face = surface.vertices_mm[
            np.all(np.abs(surface.vertices_mm - [0.66, 0.66, 0.35]) < [0.55, 0.55, 0.2], axis=1)
        ]
        means.append(face[:, 2].mean())
    correlation = (2.0 * np.sqrt(np.pi) * length) ** 3
    foretold = height_noise_of(noise, correlation, grid, blur) / 1.1**2
    assert np.var(means) / foretold == pytest.approx(1.0, abs=0.6)
    assert height_noise_of(noise, 1.0, grid, blur) == 0.0


@pytest.mark.parametrize(("thickness", "most_um"), [(0.08, 2.0), (0.1, 1.0), (0.25, 0.5)])
def test_both_faces_of_a_thin_plate_are_found_where_they_are(thickness, most_um):
    """The half level of a plate as thin as twice the blur lies 3 um and more too deep."""
    voxel, sigma = 0.025, 0.035
    z, y, x = (np.arange(n) * voxel for n in (40, 24, 60))
    spread = np.sqrt(2.0) * sigma
    across = 0.5 * (erf((z - 0.5 + 0.5 * thickness) / spread) - erf((z - 0.5 - 0.5 * thickness) / spread))
    along = 0.5 * (erf((x - 0.3) / spread) - erf((x - 1.2) / spread))
    wide = 0.5 * (erf((y - 0.15) / spread) - erf((y - 0.45) / spread))
    share = (across[:, None, None] * wide[None, :, None] * along).astype(np.float32)
    found = frame_surface(share, np.diag([voxel, voxel, voxel, 1.0]), sigma)
    points = found.surface.vertices_mm
    inner = (np.abs(points[:, 0] - 0.75) < 0.25) & (np.abs(points[:, 1] - 0.3) < 0.05)
    away = np.abs(points[inner, 2] - 0.5) - 0.5 * thickness
    assert np.abs(away.mean()) * 1e3 < most_um
    assert (found.wall_shift_mm[inner].mean() > 1e-3) == (thickness < 0.1)

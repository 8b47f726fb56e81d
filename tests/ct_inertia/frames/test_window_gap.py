"""The gap around the footplate: a round plate off centre in a round window, whose distances are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.bodies import WindowWall
from legacy.ct_inertia.frames.window_gap import window_gap
from legacy.ct_inertia.grey.frame_surface import blur_on_grid, coarse_share, frame_surface, straightened
from legacy.ct_inertia.surface.contours import contoured
from legacy.stapeskit.frames import RigidTransform

RADIUS, HALF, ROUND = 0.7, 0.12, 0.08


def shares(voxel, hole, shift):
    """Shares of voxels that a plate and the bone around it fill, and their grid (4, 4)."""
    axes = [voxel * np.arange(-int(m / voxel), int(m / voxel) + 1) for m in (1.2, 0.6, 1.2)]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    across = np.hypot(x, z) - RADIUS + ROUND
    along = np.abs(y) - HALF + ROUND
    plate = np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0)) + np.minimum(
        np.maximum(across, along), 0.0
    )
    wall = np.maximum(hole - np.hypot(x - shift, z), np.abs(y) - 0.35)
    grid = np.diag([voxel, voxel, voxel, 1.0])
    grid[:3, 3] = [axes[2][0], axes[1][0], axes[0][0]]
    return [
        np.clip(0.5 - field / voxel, 0.0, 1.0).astype(np.float32) for field in (plate - ROUND, wall)
    ], grid


def measured(voxel, blur, hole, shift, noise=0.0):
    """The gap that is found, the surfaces of both blurred and noisy bodies given."""
    (plate, wall), grid = shares(voxel, hole, shift)
    rng = np.random.default_rng(5)
    plate, wall = (
        gaussian_filter(part, blur) + np.float32(noise) * rng.standard_normal(part.shape, dtype=np.float32)
        for part in (plate, wall)
    )
    sigma = voxel * np.sqrt(blur**2 + 1.0 / 12.0)
    surface = frame_surface(plate * (plate > 0.1), grid, sigma)
    part, transform, variance = coarse_share(wall * (wall > 0.1), grid)
    points, faces = contoured(straightened(part), 0.0)
    points = points @ transform[:3, :3].T + transform[:3, 3]
    other = WindowWall(points, faces, blur_on_grid(sigma, transform, variance), 0.001, 0.15)
    turn = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    inner = RADIUS - 0.5 * ROUND
    outline = np.column_stack([inner * np.cos(turn), np.full(200, -HALF), inner * np.sin(turn)])
    frame = RigidTransform.from_parts(np.eye(3), np.zeros(3), "scan", "footplate")
    footplate = SimpleNamespace(scan_from_footplate=frame, outline_mm=outline)
    return window_gap(footplate, surface.surface, surface.blur_mm, other)


@pytest.mark.parametrize(
    ("voxel", "blur", "noise"), [(0.025, 1.2, 0.03), (0.03, 0.8, 0.02), (0.04, 1.2, 0.02)]
)
def test_gap_along_the_rim_is_that_of_two_circles(voxel, blur, noise):
    hole, shift = 0.8, 0.03
    gap = measured(voxel, blur, hole, shift, noise)
    x, z = RADIUS / np.linalg.norm(gap.outline_mm, axis=1) * gap.outline_mm.T
    true = hole - np.hypot(x - shift, z)
    assert gap.rim_share == 1.0
    assert abs(gap.median_mm - np.median(true)) < 2.0 * gap.sd_mm
    assert gap.sd_mm < 0.2 * voxel + 0.01 * np.median(true)
    assert abs(gap.harmonic_mm - 1.0 / np.mean(1.0 / true)) < 2.5 * gap.sd_mm
    assert gap.spread_mm == pytest.approx(np.std(true), rel=0.15)
    assert np.std(gap.along_mm - true) < 0.005


def test_without_bone_opposite_no_gap_is_stated():
    assert measured(0.03, 1.2, 1.0, 0.0) is None
    frame = RigidTransform.from_parts(np.eye(3), np.zeros(3), "scan", "footplate")
    assert window_gap(SimpleNamespace(scan_from_footplate=frame), None, 0.0, None) is None


def test_share_of_the_rim_with_bone_opposite():
    """A window 0.23 mm wider and moved by 0.1 mm is nearer than 0.25 mm over a little more than half."""
    gap = measured(0.03, 1.2, 0.93, 0.1)
    x, z = RADIUS / np.linalg.norm(gap.outline_mm, axis=1) * gap.outline_mm.T
    near = 0.93 - np.hypot(x - 0.1, z) < 0.25
    assert gap.rim_share == pytest.approx(np.mean(near), abs=0.03)
    clear = np.abs(0.93 - np.hypot(x - 0.1, z) - 0.25) > 0.01
    assert np.array_equal(np.isfinite(gap.along_mm)[clear], near[clear])

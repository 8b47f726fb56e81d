"""Contours, exact moments, matched moments, and how surfaces are written."""

from __future__ import annotations

import numpy as np
import pytest

from ct_inertia.bodies import Moments
from ct_inertia.surface.contour import contour
from ct_inertia.surface.fields import Diffusion
from ct_inertia.surface.matched import moment_matched
from ct_inertia.surface.surface import Surface
from simulate import Stapes, coverage_of, ellipsoid, stapes_solid
from simulate.solids import Solid
from stapeskit.frames import rotation_from_vector


def ball_field(step_mm: float, radius_mm: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distance from a ball on a turned grid, and its scan_from_index."""
    count = int(np.ceil(1.4 / step_mm))
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_vector([0.3, -0.2, 0.9]) * step_mm
    transform[:3, 3] = [3.0, -2.0, 7.0]
    z, y, x = np.indices((count, count, count)).astype(float)
    index = np.stack([x, y, z], axis=-1)
    centre = np.full(3, 0.5 * (count - 1.0)) + np.array([0.13, -0.21, 0.37])
    away = np.linalg.norm(index - centre, axis=-1) * step_mm
    return (radius_mm - away).astype(np.float32), transform


def test_the_contour_of_a_ball_converges_with_the_second_order() -> None:
    exact = 4.0 / 3.0 * np.pi * 0.5**3
    errors = []
    for step in (0.08, 0.04, 0.02):
        field, transform = ball_field(step)
        errors.append(abs(contour(field, transform).moments().volume_mm3 / exact - 1.0))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 1.7)
    assert errors[-1] < 1e-3


def test_a_contour_is_closed_outward_and_in_scan_coordinates() -> None:
    field, transform = ball_field(0.05)
    surface = contour(field, transform)
    assert Solid(surface.vertices_mm, surface.faces).is_closed()
    assert surface.holes == 0
    count = field.shape[0]
    centre = np.full(3, 0.5 * (count - 1.0)) + np.array([0.13, -0.21, 0.37])
    expected = transform[:3, :3] @ centre + transform[:3, 3]
    np.testing.assert_allclose(surface.moments().centroid_mm, expected, atol=2e-3)
    assert surface.on_border is None


def test_a_body_that_the_grid_cuts_is_closed_half_a_voxel_outside() -> None:
    field, transform = ball_field(0.05)
    half = field[: field.shape[0] // 2]
    surface = contour(half, transform)
    assert Solid(surface.vertices_mm, surface.faces).is_closed()
    assert surface.on_border is not None
    back = np.linalg.inv(transform)
    layer = (surface.vertices_mm @ back[:3, :3].T + back[:3, 3])[surface.on_border, 2]
    inner = np.abs(layer - (len(half) - 0.5)) < 0.01
    assert np.mean(inner) > 0.8  # the rim of the cap rises to it


def test_only_the_largest_piece_is_kept_unless_all_are_asked_for() -> None:
    field = np.full((20, 20, 40), -1.0, dtype=np.float32)
    field[5:15, 5:15, 5:15] = 1.0
    field[8:12, 8:12, 28:32] = 1.0
    one, both = contour(field, np.eye(4)), contour(field, np.eye(4), largest=False)
    assert len(one.faces) < len(both.faces)
    assert one.vertices_mm[:, 0].max() < 20.0


def test_moments_of_an_ellipsoid_and_of_the_same_turned() -> None:
    solid = ellipsoid([10.0, 20.0, -5.0], [0.4, 0.7, 1.1])
    moments = Surface(solid.vertices_mm, solid.faces).moments()
    exact = solid.moments()
    assert moments.volume_mm3 == pytest.approx(exact.volume_mm3, rel=1e-12)
    np.testing.assert_allclose(moments.second_mm5, exact.second_mm5, rtol=1e-9, atol=1e-12)
    turn = rotation_from_vector([0.5, -1.0, 0.2])
    turned = Surface(solid.vertices_mm @ turn.T, solid.faces).moments()
    np.testing.assert_allclose(turned.second_mm5, turn @ moments.second_mm5 @ turn.T, atol=1e-12)
    np.testing.assert_allclose(turned.centroid_mm, turn @ moments.centroid_mm, atol=1e-12)


@pytest.mark.parametrize("step", [0.03, 0.05])
def test_a_matched_surface_has_the_moments_it_was_given(step: float) -> None:
    from scipy.ndimage import gaussian_filter

    solid = stapes_solid(Stapes())
    low = solid.vertices_mm.min(axis=0) - 0.3
    size = tuple(np.ceil((np.ptp(solid.vertices_mm, axis=0) + 0.6) / step).astype(int))
    share = coverage_of(Solid(solid.vertices_mm - low, solid.faces), size, (step,) * 3, samples=3)
    field = gaussian_filter(share.astype(np.float32), 1.1) - np.float32(0.5)
    transform = np.eye(4)
    transform[:3, :3] *= step
    transform[:3, 3] = low
    exact = solid.moments()
    wanted = Moments(exact.volume_mm3, exact.centroid_mm, exact.second_mm5)
    plain = contour(field, transform).moments()
    surface = moment_matched(field, wanted, transform)
    found = surface.moments()
    assert (
        abs(found.volume_mm3 / exact.volume_mm3 - 1.0) < 5e-4 < abs(plain.volume_mm3 / exact.volume_mm3 - 1.0)
    )
    np.testing.assert_allclose(found.centroid_mm, exact.centroid_mm, atol=1e-3)
    np.testing.assert_allclose(found.second_mm5, exact.second_mm5, atol=1e-3 * np.trace(exact.second_mm5))
    assert Solid(surface.vertices_mm, surface.faces).is_closed()
    assert surface.holes == 1


def test_one_step_of_diffusion_damps_a_wave_as_it_should() -> None:
    count, length = 160, 2.0
    step = length / count
    x, y = np.meshgrid(np.arange(count + 1) * step, np.arange(9) * step, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    quads = np.arange(count)[:, None] * 9 + np.arange(8)
    faces = np.concatenate(
        [np.stack([quads, quads + 9, quads + 10], -1), np.stack([quads, quads + 10, quads + 1], -1)]
    ).reshape(-1, 3)
    diffusion = Diffusion(points, faces, 0.05)
    wave_number = 2.0 * np.pi * 4.0 / length
    wave = np.cos(wave_number * points[:, :1])  # its slope vanishes at both ends
    damped = diffusion.step(wave)
    ratio = float((damped * wave).sum() / (wave * wave).sum())
    assert ratio == pytest.approx(1.0 / (1.0 + (0.5 * 0.05 * wave_number) ** 2), rel=2e-3)

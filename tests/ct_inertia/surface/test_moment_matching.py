"""The iso surface carries the moments of the body: volume, centre and inertia, also at coarse voxels."""

import numpy as np
import pytest

from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.surface.moment_matching import moment_matched
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.grid_operations import gaussian
from tests.ct_inertia.solids import stapes_field, stapes_surface

LOW, HIGH = np.array([-1.7, -0.4, -0.9]) - 0.2, np.array([1.7, 3.4, 0.9]) + 0.2


def blurred_stapes(step, sigma_voxels=1.3):
    """Share of bone [z, y, x] of a stapes, blurred, and its place; shares of voxels from the signed field."""
    x, y, z = (np.arange(a, b, step) for a, b in zip(LOW, HIGH, strict=True))
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    share = np.clip(0.5 - stapes_field(points) / step, 0.0, 1.0).transpose(2, 1, 0)
    place = np.diag([step, step, step, 1.0])
    place[:3, 3] = LOW
    return gaussian(np.ascontiguousarray(share, dtype=np.float32), sigma_voxels), place


@pytest.mark.parametrize("step", [0.05, 0.06])
def test_the_surface_has_the_moments_that_were_asked_for(step):
    exact = stapes_surface(0.05).moments()
    field, place = blurred_stapes(step)
    surface, level = moment_matched(field, exact, place)
    found = surface.moments()
    assert found.volume_mm3 == pytest.approx(exact.volume_mm3, rel=1e-3)
    assert np.linalg.norm(found.centroid_mm - exact.centroid_mm) < 1e-3
    assert np.abs(found.inertia_mm5 - exact.inertia_mm5).max() < 3e-3 * np.trace(exact.inertia_mm5) / 3.0
    assert 0.1 < level < 0.5
    assert surface.euler_characteristic == 0
    half = iso_surface(field, 0.5, place).moments()
    assert abs(half.volume_mm3 / exact.volume_mm3 - 1.0) > 5e-3


def test_moments_out_of_reach_leave_a_closed_surface_near_them():
    exact = stapes_surface(0.05).moments()
    away = Moments(exact.volume_mm3, exact.centroid_mm + np.array([0.0, 0.3, 0.0]), exact.second_mm5)
    field, place = blurred_stapes(0.06)
    surface, _ = moment_matched(field, away, place)
    assert surface.volume_mm3 == pytest.approx(exact.volume_mm3, rel=0.2)

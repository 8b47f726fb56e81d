"""The stiffness along the rim, from K of springs that are known, and an even ring in closed form."""

import numpy as np
import pytest

from fitting.ring import Rim, even_ring, linear_ratio, ring_of
from tests.fit.fit_cases import M, fit, paper_motion, with_outline


def outline(n=20000):
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return np.column_stack([1.4 * np.cos(angle) + 0.1, 0.65 * np.sin(angle) - 0.05])


def entries_of(points_mm, stiffness):
    """Return K11, K12, K13 of springs normal to the footplate, (n,) N/m each."""
    x, z = points_mm.T * 1e-3
    return np.array([stiffness.sum(), -(stiffness * z).sum(), (stiffness * x).sum()])


@pytest.mark.parametrize("gradient", [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.5)])
def test_a_linear_stiffness_is_found_exactly(gradient):
    points = outline()
    ahead = np.roll(points, -1, axis=0) - points
    behind = points - np.roll(points, 1, axis=0)
    length = 0.5 * (np.hypot(*ahead.T) + np.hypot(*behind.T))
    weight = length / length.sum()
    density = 1.0 + (points - weight @ points) @ gradient
    found = linear_ratio(points, entries_of(points, 1700.0 * weight * density))
    assert found == pytest.approx(
        density, abs=1e-7
    )  # of the polygon, whose second moments are those of springs to 1 / n^2


@pytest.mark.parametrize(
    ("side", "direction", "name"),
    [
        ("left", (1, 1), "anterior-superior"),
        ("right", (1, 1), "anterior-inferior"),
        ("left", (-1, 0), "posterior"),
        ("right", (0, -1), "superior"),
    ],
)
def test_places_have_the_names_of_the_side(side, direction, name):
    angle = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    ratio = 1.0 + points @ (0.5 * np.array(direction) / np.hypot(*direction))
    rim = Rim(points, ratio, np.full(len(points), 0.05), side)
    assert rim.name_of(rim.stiffest) == name
    assert name in rim.sentence()


def test_nothing_is_claimed_within_the_uncertainty():
    points = outline()
    rim = Rim(points, 1.0 + 0.1 * points[:, 0], np.full(len(points), 0.2), "left")
    assert rim.is_even
    assert "±" not in rim.sentence()


def test_an_even_ring_around_a_circle_in_closed_form():
    angle = 2.0 * np.pi * np.arange(2000) / 2000
    ring = even_ring(1e-3 * np.column_stack([np.cos(angle), np.sin(angle)]))
    length = 2.0 * np.pi * 1e-3
    assert np.diag(ring) == pytest.approx([length, 0.5e-6 * length, 0.5e-6 * length], rel=1e-5)
    assert np.abs(ring - np.diag(np.diag(ring))).max() < 1e-9 * length


def test_the_ring_of_a_fit_is_even_where_the_ligament_is():
    angle = 2.0 * np.pi * np.arange(200) / 200
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    ring = 1700.0 / (2.0 * np.pi * 1e-3) * even_ring(1e-3 * circle)
    motion, _ = paper_motion(0.001, 1, 60, stiffness=ring, damping=1e-5 * ring)
    found = ring_of(with_outline(fit(motion, M), circle))
    assert found.rocking_ratio == pytest.approx((1.0, 1.0), rel=0.02)
    assert found.shear_pa[0] == pytest.approx(1700.0 / found.length_m, rel=0.01)
    assert found.loss_factor[0] == pytest.approx(2e-5 * np.pi * np.sqrt(400.0 * 5000.0), rel=0.02)
    assert 0.0 < found.loss_factor[1] < 0.02

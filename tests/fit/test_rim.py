"""The stiffness along the rim, from K of springs that are known."""

import numpy as np
import pytest

from fitting.rim import RimStiffness, linear_ratio


def outline(n=400):
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
    assert found == pytest.approx(density, abs=1e-9)


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
    rim = RimStiffness(points, ratio, np.full(len(points), 0.05), side)
    assert rim.name_of(rim.stiffest) == name
    assert name in rim.sentence()


def test_nothing_is_claimed_within_the_uncertainty():
    points = outline()
    rim = RimStiffness(points, 1.0 + 0.1 * points[:, 0], np.full(len(points), 0.2), "left")
    assert rim.is_even
    assert "±" not in rim.sentence()

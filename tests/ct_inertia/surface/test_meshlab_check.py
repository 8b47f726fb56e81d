"""A second program agrees on volume, centre, inertia and topology, far from the origin too."""

import sys

import numpy as np
import pytest

from legacy.ct_inertia.surface.meshlab_check import second_opinion
from legacy.ct_inertia.surface.surface import Surface
from sample_volumes import bodies


@pytest.fixture(scope="module")
def stapes():
    return bodies.stapes_in_footplate()


@pytest.mark.parametrize("shift_mm", [0.0, 500.0])
def test_pymeshlab_agrees_with_our_moments_of_the_real_stapes(stapes, shift_mm):
    found = second_opinion(Surface(stapes.vertices_mm + shift_mm, stapes.faces))
    assert abs(found.volume_difference) < 1e-9
    assert abs(found.inertia_difference) < 1e-9
    assert found.centroid_difference_mm < 1e-9
    assert found.genus == 1
    assert found.two_manifold


def test_a_box_has_no_hole():
    solid = bodies.box(np.zeros(3), np.array([1.0, 2.0, 3.0]))
    found = second_opinion(Surface(solid.vertices, solid.faces))
    assert found.genus == 0
    assert abs(found.volume_difference) < 1e-12


def test_without_pymeshlab_there_is_no_second_opinion(stapes, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    assert second_opinion(stapes) is None

"""Units as programs write them: their sizes follow from definitions and from each other."""

import numpy as np
import pytest

from legacy.kinematics.readers.unit_labels import length_scale, motion_unit, phase_scale


@pytest.mark.parametrize(
    ("many", "small", "large"),
    [(12, "in", "ft"), (2.54, "cm", "in"), (100, "cm", "m"), (10, "mm", "cm"), (1e12, "pm", "m")],
)
def test_lengths_make_each_other(many, small, large):
    assert many * length_scale(small) == pytest.approx(length_scale(large), rel=1e-15)
    for rate, order in (("", 0), ("/s", 1), ("/s2", 2), ("/s/s", 2)):
        unit = motion_unit(small + rate)
        assert (unit.order, many * unit.scale) == (order, pytest.approx(length_scale(large), rel=1e-15))


def test_half_a_turn_is_pi():
    assert 180.0 * phase_scale("deg") == pytest.approx(np.pi * phase_scale("rad"), rel=1e-15)
    assert phase_scale("rad") == 1.0


def test_a_body_falls_as_far_as_gravity_makes_it():
    assert motion_unit("g").scale == pytest.approx(32.174 * motion_unit("ft/s2").scale, rel=1e-5)

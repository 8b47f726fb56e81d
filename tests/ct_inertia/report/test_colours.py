"""Colours that carry meaning stay apart for readers with deuteranopia."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from legacy.ct_inertia.report.colours import AXIS_COLOURS, BODY_COLOURS

# Machado, Oliveira and Fernandes 2009, doi:10.1109/TVCG.2009.113: deuteranopia, linear RGB.
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour):
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = XYZ @ np.clip(DEUTERANOPIA @ linear, 0.0, 1.0) / np.array([0.9505, 1.0, 1.089])
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize("colours", [tuple(BODY_COLOURS.values()), AXIS_COLOURS])
def test_colours_differ_for_deuteranopes(colours):
    for first, second in combinations(colours, 2):
        assert np.linalg.norm(lab(first) - lab(second)) > 20.0

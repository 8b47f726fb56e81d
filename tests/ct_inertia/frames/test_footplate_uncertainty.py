"""What blur leaves uncertain of the frame, on an elliptic footplate whose arms are known."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame, footplate_pose
from tests.ct_inertia.shapes import stapes

HINTS = AnatomyHints(np.array([1.0, 0.0, 0.0]), {}, None)


def test_blur_tilts_an_ellipse_by_its_arms():
    """Independent heights tilt an ellipse with half axes a and b as 1 / b about x and as 1 / a about z."""
    frame = footplate_frame(stapes(0.05), HINTS, blur_mm=0.03)
    left = frame.contributions["blur"]
    ratio = np.sqrt(left[5, 5] / left[3, 3])
    assert ratio == pytest.approx(frame.width_mm / frame.length_mm, rel=0.03)
    assert abs(left[3, 5]) < 0.02 * left[3, 3]
    twice = footplate_frame(stapes(0.05), HINTS, blur_mm=0.06).contributions["blur"]
    assert np.sqrt(twice[3, 3] / left[3, 3]) == pytest.approx(4.0)
    assert np.allclose(np.linalg.eigvalsh(left) >= 0.0, True)


def test_a_pose_alone_is_that_of_the_whole_frame():
    surface = stapes(0.05)
    whole = footplate_frame(surface, HINTS, blur_mm=0.03).scan_from_footplate.matrix
    assert np.array_equal(footplate_pose(surface, HINTS, 0.03).matrix, whole)

"""Rings, phase contrast and motion are named; scans without them are not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d, laplace

from ct_inertia.bodies import Levels
from ct_inertia.grey.artefacts import artefact_notices
from ct_inertia.segment.cutting import Cut

AIR, BONE, NOISE, H = 2000.0, 20000.0, 200.0, 0.025
LEVELS = Levels(AIR, BONE, None, NOISE, 1.0, 1.0)


def cut(change=lambda share: share, rings=0.0):
    """A blurred ball of bone in air."""
    rng = np.random.default_rng(3)
    place = np.indices((64, 60, 60)) - np.array([31.6, 29.7, 30.2])[:, None, None, None]
    ball = np.linalg.norm(place, axis=0) < 15.0
    share = change(gaussian_filter(ball.astype(np.float32), 1.3))
    share = share + rings * rng.standard_normal((60, 60))
    grey = AIR + (BONE - AIR) * share + NOISE * rng.standard_normal(share.shape)
    nothing = np.zeros(ball.shape, dtype=bool)
    return Cut(np.zeros(3, dtype=np.int64), grey.astype(np.float32), ball, nothing, nothing, "")


@pytest.mark.parametrize(
    ("scan", "code"),
    [
        (cut(), None),
        (cut(rings=0.01), "ring_artefacts"),
        (cut(lambda share: share - 0.6 * laplace(share)), "phase_fringes"),
        (cut(lambda share: gaussian_filter1d(share, 1.6, axis=2)), "blur_uneven"),
    ],
)
def test_each_artefact_is_named_alone(scan, code):
    found = [notice.code for notice in artefact_notices(scan, LEVELS, 1.3 * H, np.full(3, H))]
    assert found == ([] if code is None else [code])


def test_the_axis_of_motion_is_stated():
    moved = cut(lambda share: gaussian_filter1d(share, 1.6, axis=1))
    notice = artefact_notices(moved, LEVELS, 1.3 * H, np.full(3, H))[0]
    assert "most along y" in notice.text

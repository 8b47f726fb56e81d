"""Rings are named; air without them is not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.bodies import Levels
from legacy.ct_inertia.grey.ring_artefacts import ring_notices
from legacy.ct_inertia.segment.extract_stapes import Cut

AIR, BONE, NOISE, H = 2000.0, 20000.0, 200.0, 0.025
LEVELS = Levels(AIR, BONE, None, NOISE, 1.0, 1.0)


def cut(rings=0.0):
    """A blurred ball of bone in air."""
    rng = np.random.default_rng(3)
    place = np.indices((64, 60, 60)) - np.array([31.6, 29.7, 30.2])[:, None, None, None]
    ball = np.linalg.norm(place, axis=0) < 15.0
    share = gaussian_filter(ball.astype(np.float32), 1.3) + rings * rng.standard_normal((60, 60))
    grey = AIR + (BONE - AIR) * share + NOISE * rng.standard_normal(share.shape)
    nothing = np.zeros(ball.shape, dtype=bool)
    return Cut(np.zeros(3, dtype=np.int64), grey.astype(np.float32), ball, nothing, nothing, "")


@pytest.mark.parametrize(("rings", "codes"), [(0.0, []), (0.01, ["ring_artefacts"])])
def test_rings_are_named_where_they_are(rings, codes):
    found = ring_notices(cut(rings), LEVELS, 1.3 * H, np.full(3, H))
    assert [notice.code for notice in found] == codes

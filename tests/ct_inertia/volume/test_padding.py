"""A constant outside of what was scanned is no material; air that the export has clipped is."""

import numpy as np
import pytest

from legacy.ct_inertia.volume.coarse_view import coarse_overview
from legacy.ct_inertia.volume.volume import Volume

AIR, BONE, NOISE = 0.0, 1000.0, 30.0


@pytest.fixture
def bone_in_air():
    rng = np.random.default_rng(4)
    grey = rng.normal(AIR, NOISE, (80, 80, 80)).astype(np.float32)
    grey[20:60, 20:60, 20:60] += BONE - AIR
    return grey


def levels(grey):
    return coarse_overview(Volume(grey, np.full(3, 0.05), np.zeros(3), np.eye(3))).levels


@pytest.mark.parametrize("value", [-400.0, -150.0])
def test_padding_is_not_taken_for_air(bone_in_air, value):
    y, x = np.mgrid[:80, :80]
    bone_in_air[:, np.hypot(y - 40, x - 40) > 38] = value
    # Bone that the field of view crops lies at the padding.
    bone_in_air[:10] = value
    bone_in_air[10:14, 30:50, 30:50] += BONE
    assert levels(bone_in_air) == pytest.approx([AIR, BONE], abs=NOISE / 3)


def test_clipped_air_beside_plastic_stays_a_level(bone_in_air):
    bone_in_air[:, :16] += 400.0
    clipped = np.maximum(bone_in_air, 200.0)
    assert levels(clipped)[0] == pytest.approx(200.0, abs=NOISE / 3)

"""Levels from before storing, on a plane edge of bone whose stored mean is that of a clipped normal."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.air_level import Air, Surroundings
from legacy.ct_inertia.grey.clipped_levels import clipped_levels, undo_storing
from legacy.ct_inertia.volume.normal_distribution import normal_cdf

SPACING, SIGMA, BONE, NOISE = np.full(3, 0.03), 0.036, 180.0, 8.0


def edge(air):
    """Return a stored edge of bone, z < 0.45 mm, as surroundings, its air shell and the air as stored."""
    z = 0.03 * np.arange(40)
    true = air + (BONE - air) * normal_cdf((0.45 - z) / SIGMA)
    grey = true[:, None, None] + NOISE * np.random.default_rng(3).standard_normal((40, 30, 30))
    stored = np.clip(np.rint(grey), 0.0, 255.0).astype(np.float32)
    bone = np.broadcast_to((z < 0.45)[:, None, None], stored.shape).copy()
    shell = np.broadcast_to((z > 0.65)[:, None, None], stored.shape).copy()
    seen = stored[shell].astype(float)
    around = Surroundings(stored, bone, np.zeros(bone.shape, dtype=bool), SPACING, None)
    return around, shell, Air(float(seen.mean()), float(seen.std()), 0.05, 1.0, 0.0)


def test_air_at_the_lowest_value_is_put_back_by_the_mean_of_a_clipped_normal():
    around, shell, air = edge(0.0)
    assert air.level == pytest.approx(NOISE / np.sqrt(2.0 * np.pi), abs=0.1)
    stored = clipped_levels(around, air, shell, SIGMA)
    known = stored.air_known(air)
    assert abs(known.level) < 4.0 * known.sd
    assert abs(stored.bone.level - BONE) < 4.0 * stored.bone_sd(0.0) + 0.1
    assert stored.moved[0] == pytest.approx(NOISE / np.sqrt(2.0 * np.pi), abs=4.0 * known.sd)
    back = undo_storing(around.grey, around, np.ones(shell.shape, dtype=bool), stored, SIGMA)
    assert abs(float(back[shell].mean())) < 4.0 * known.sd
    assert float(back[:10].mean()) == pytest.approx(BONE, abs=0.3)


def test_well_stored_values_are_left_alone_and_lost_air_is_refused():
    around, shell, air = edge(60.0)
    assert clipped_levels(around, air, shell, SIGMA) is None
    around, shell, air = edge(-40.0)
    with pytest.raises(CtInertiaError) as refusal:
        clipped_levels(around, air, shell, SIGMA)
    assert refusal.value.faults[0].thing == "the grey value of air"

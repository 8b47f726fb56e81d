"""Levels behind a clipped range and coarse steps: within their deviations, or refused where open."""

import numpy as np
import pytest

from ct_inertia.grey.storing import Range, find_storing, stored_level
from stapeskit.faults import StapeskitError


def stored(values, low, high, step):
    return np.clip(low + step * np.rint((values - low) / step), low, high)


@pytest.mark.parametrize("low", [-300.0, 0.0, 60.0])
def test_levels_of_clipped_air_lie_within_their_deviation(low):
    """The lowest stored value lies from three deviations below the air to half a deviation above it."""
    z = []
    for seed in range(12):
        values = stored(np.random.default_rng(seed).normal(0.0, 100.0, 4000), low, 5000.0, 1.0)
        level = stored_level(values, Range(low, 5000.0, 1.0))
        z.append(level.level / level.sd)
        assert level.noise == pytest.approx(100.0, rel=0.15)
    assert np.abs(z).max() < 4.0
    assert np.sum(np.abs(z) < 1.96) >= 8


def test_steps_wider_than_the_noise_leave_a_level_open_to_a_part_of_a_step():
    rng = np.random.default_rng(1)
    air = stored(rng.normal(3.3, 0.25, 5000), 0.0, 64.0, 1.0)
    bone = stored(rng.normal(40.6, 0.25, 5000), 0.0, 64.0, 1.0)
    storing = find_storing(np.concatenate([air, bone, np.arange(64.0)]), air, bone, 1.0)
    assert storing.coarse
    assert abs(storing.air.level - 3.3) < 4.0 * storing.air_sd
    assert abs(storing.bone.level - 40.6) < 4.0 * storing.bone_sd


def test_the_mean_of_stored_values_is_undone():
    rng = np.random.default_rng(2)
    air, bone = rng.normal(10.0, 100.0, 20_000), rng.normal(1000.0, 100.0, 20_000)
    every = stored(np.concatenate([air, bone]), 0.0, 1100.0, 1.0)
    storing = find_storing(every, every[:20_000], every[20_000:], 1.0)
    for true in (-50.0, 10.0, 400.0, 1050.0):
        seen = stored(true + 100.0 * rng.standard_normal(200_000), 0.0, 1100.0, 1.0).mean()
        change = float(storing.change(np.array([true], dtype=np.float32))[0])
        assert seen - change == pytest.approx(true, abs=6.0)


def test_a_wide_range_with_fine_steps_needs_nothing():
    rng = np.random.default_rng(3)
    air, bone = np.rint(rng.normal(8000, 400, 5000)), np.rint(rng.normal(30000, 400, 5000))
    assert find_storing(np.concatenate([air, bone]), air, bone, 1.0) is None


def test_air_of_one_value_beside_noise_is_open():
    """The export has clipped all of the air: nothing tells how far below it lies."""
    bone = np.random.default_rng(3).normal(30000.0, 400.0, 5000)
    with pytest.raises(StapeskitError) as error:
        find_storing(np.concatenate([np.zeros(5000), bone]), np.zeros(5000), bone, 1.0)
    assert error.value.faults[0].thing == "the range of the grey values"


def test_levels_that_are_open_are_refused():
    rng = np.random.default_rng(4)
    air = stored(rng.normal(-400.0, 100.0, 5000), 0.0, 5000.0, 1.0)
    bone = stored(rng.normal(1000.0, 20.0, 5000), 0.0, 5000.0, 1.0)
    with pytest.raises(StapeskitError) as error:
        find_storing(np.concatenate([air, bone]), air, bone, 1.0)
    assert error.value.faults[0].thing == "the range of the grey values"

"""Levels from before storing, on a population of levels, noises, ends and steps; the mean by simulation."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.grey.quantisation import Quantisation, level_of, quantisation_of

COUNT = 40_000


def stored(rng, level, noise, store):
    """Return values as a scanner stores them."""
    true = level + noise * rng.standard_normal(COUNT)
    return np.clip(store.low + store.step * np.rint((true - store.low) / store.step), store.low, store.high)


@pytest.mark.parametrize("seed", range(6))
def test_the_mean_effect_is_that_of_simulated_storing(seed):
    rng = np.random.default_rng(seed)
    store = Quantisation(0.0, 255.0, float(rng.choice((1.0, 5.0))))
    noise = rng.uniform(1.0, 12.0)
    for level in (-1.5 * noise, 0.3 * noise, 100.2, 255.0 - 0.5 * noise, 255.0 + noise):
        values = stored(rng, level, noise, store)
        scatter = values.std() / np.sqrt(COUNT) + 1e-9
        assert abs(store.mean_stored(np.array([level]), noise)[0] - values.mean()) < 5.0 * scatter + 0.01


def test_levels_beyond_an_end_are_found_within_their_standard_deviations():
    z = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        store, noise = Quantisation(0.0, 255.0, 1.0), rng.uniform(2.0, 10.0)
        level = rng.uniform(-1.5, 1.5) * noise + rng.choice((0.0, 255.0))
        found = level_of(stored(rng, level, noise, store), store)
        assert found.sd < 0.1 * noise
        z.append((found.level - level) / found.sd)
    assert np.mean(np.abs(z) < 1.96) > 0.85
    assert np.max(np.abs(z)) < 4.5


def test_levels_between_wide_steps_are_found_within_a_part_of_a_step():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        store = Quantisation(0.0, 248.0, 8.0)
        level, noise = rng.uniform(60.0, 180.0), rng.uniform(1.0, 8.0)
        found = level_of(stored(rng, level, noise, store), store)
        assert abs(found.level - level) < 4.5 * found.sd + 0.05 * store.step


def test_range_and_step_are_read_from_the_values():
    found = quantisation_of(np.array([8, 24, 16, 104, 96, 8]))
    assert (found.low, found.high, found.step) == (8.0, 104.0, 8.0)
    assert found.clips_low is False
    assert found.clips_high is False

"""Lasers whose noise differs by more than the noise of channels of one laser does."""

from __future__ import annotations

import numpy as np

from kinematics.fit.laser_groups import noise_shares


def test_lasers_differ_beyond_what_their_channels_scatter():
    laser = np.tile([0, 1, 2], 9)
    own = np.exp(np.random.default_rng(1).normal(scale=0.5, size=27))
    assert noise_shares(laser, own) is None
    found = noise_shares(laser, own * np.array([16.0, 16.0, 1.0])[laser])
    assert np.allclose(found[:3] / found[2], [4.0, 4.0, 1.0], rtol=0.3)
    assert np.isclose(np.prod(found), 1.0)


def test_a_loud_channel_is_no_loud_laser_and_one_laser_is_not_compared():
    laser, energy = np.tile([0, 1, 2], 9), np.ones(27)
    energy[4] = 1000.0
    assert noise_shares(laser, energy + 1e-3 * np.arange(27)) is None
    assert noise_shares(np.zeros(27, dtype=int), energy) is None
    assert noise_shares(np.array([0, 1, 2]), np.array([1.0, 9.0, np.nan])) is None

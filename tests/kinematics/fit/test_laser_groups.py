"""Lasers whose noise differs by more than the noise of channels of one laser does."""

from __future__ import annotations

import numpy as np

from legacy.kinematics.fit.laser_groups import laser_channels, noise_shares


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


def towards(heads_mm, points_mm):
    beams = heads_mm[None] - points_mm[:, None]
    return (beams / np.linalg.norm(beams, axis=2, keepdims=True)).reshape(-1, 3)


def test_channels_are_grouped_by_the_heads_that_they_point_to():
    heads = np.array([[60.0, 200.0, 0.0], [-40.0, 200.0, 50.0], [0.0, 180.0, -70.0]])
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (6, 3))
    groups = laser_channels(towards(heads, points), range(18))
    assert groups == [list(range(head, 18, 3)) for head in range(3)]
    assert laser_channels(towards(heads, points), [1, 4, 6]) == [[1, 4], [6]]


def test_opposite_beams_are_two_lasers():
    beam = np.array([0.0, 0.6, 0.8])
    assert laser_channels(np.stack([beam, -beam, beam]), range(3)) == [[0, 2], [1]]

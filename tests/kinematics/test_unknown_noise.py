"""Noise of channels that nobody stated: alike until residuals say otherwise; faults beside it are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged
from kinematics.faults.fault_model import solve
from kinematics.faults.noise.channel_noise import own_noise
from kinematics.faults.noise.unknown_noise import evened
from kinematics.faults.packed.compact import compact
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene

FOOTPLATE = "footplate, 5 points 3D"


def packed(made):
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, made.value, np.broadcast_to(np.median(made.sd), made.sd.shape).copy())
    return compact(fit, body("stapes", made), made.freq_hz)


def louder(made, factor):
    """Make the noise of each channel larger by a factor (channel,)."""
    quiet = scene(31, snr=np.inf).value
    return replace(made, value=quiet + factor[:, None] * (made.value - quiet))


def accused(fault, seed, stated):
    made = drawn(seed, FOOTPLATE, fault)
    found = judged(made, seed, stated)
    return {c for c, v in enumerate(found.channels) if v.verdict != "ok"}, set(made.culprits)


def test_channels_with_the_same_noise_keep_the_same_weight():
    data = packed(scene(31))
    even, doubt = evened(data, np.zeros(len(data.points)))
    assert np.ptp(even.a[data.live] / data.a[data.live]) < 1e-9
    assert np.all(doubt >= 0.0)


def test_channels_of_different_lasers_get_the_weights_of_their_noise():
    made = scene(31)
    factor = np.tile([1.0, 1.5, 0.6], len(made.points) // 3)
    data = packed(louder(made, factor))
    weight = evened(data, np.zeros(len(data.points)))[0].a * factor
    assert weight / np.mean(weight) == pytest.approx(np.ones(len(weight)), abs=0.12)


def test_noise_of_a_channel_is_not_taken_for_motion():
    made = drawn(77001, FOOTPLATE, "noise x4")
    found = judged(made, 77001)
    fit = found.fits[(0, 0)]
    data = compact(fit, found.measurement.bodies[0], made.freq_hz)
    state = solve(data)
    (culprit,) = made.culprits
    energy, count = own_noise(state, state.rest(), culprit)
    h = state.h[culprit]
    expected = (16.0 * (1.0 - h) + h) if h < 1.0 else 1.0
    assert energy == pytest.approx(expected, rel=5.0 / np.sqrt(count))


def test_clean_files_without_sd_seldom_raise_an_alarm():
    alarms = sum(bool(accused("", 640_000 + seed, False)[0]) for seed in range(60))
    assert alarms <= 3


@pytest.mark.parametrize("fault", ["noise x4", "flexible 3 %"])
@pytest.mark.parametrize("stated", [True, False])
def test_culprits_on_few_points_are_named(fault, stated):
    named = 0
    for seed in range(641_000, 641_012):
        found, true = accused(fault, seed, stated)
        named += found == true
    assert named >= 11

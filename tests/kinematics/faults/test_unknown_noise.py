"""Noise of channels that nobody stated: alike until residuals say otherwise; faults beside it are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged
from legacy.kinematics.faults.estimated_weights import equalise_noise
from legacy.kinematics.faults.noise_size import channel_noise_energy
from legacy.kinematics.faults.nuisance import Nuisance
from legacy.kinematics.faults.packed_readings import Source, initial
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene

FOOTPLATE = "footplate, 5 points 3D"


def packed(made):
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, made.value, np.broadcast_to(np.median(made.sd), made.sd.shape).copy())
    some = body("stapes", made)
    return initial(Source.of(fit, some, made.freq_hz, False), some)


def louder(made, factor):
    """Make the noise of each channel larger by a factor (channel,)."""
    quiet = scene(31, snr=np.inf).value
    return replace(made, value=quiet + factor[:, None] * (made.value - quiet))


def accused(fault, seed, stated):
    made = drawn(seed, FOOTPLATE, fault)
    found = judged(made, seed, stated)
    return {c for c, v in enumerate(found.channels) if v.verdict != "ok"}, set(made.culprits)


def equalised(data):
    return equalise_noise(data, Nuisance.of(data, np.zeros(len(data.points))))


def test_channels_with_the_same_noise_keep_the_same_weight():
    even = equalised(packed(scene(31)))
    assert np.ptp(even.assumed.loud) < 1e-9 * np.max(even.assumed.loud)


def test_channels_of_different_lasers_get_the_weights_of_their_noise():
    made = scene(31)
    factor = np.tile([1.0, 1.5, 0.6], len(made.points) // 3)
    weight = factor / equalised(packed(louder(made, factor))).assumed.loud
    assert weight / np.mean(weight) == pytest.approx(np.ones(len(weight)), abs=0.12)


def test_noise_of_a_channel_is_not_taken_for_motion():
    made = drawn(77001, FOOTPLATE, "noise x4")
    found = judged(made, 77001)
    some = found.measurement.bodies[0]
    state = State.of(initial(Source.of(found.fits[(0, 0)], some, made.freq_hz, True), some))
    (culprit,) = made.culprits
    energy, count = channel_noise_energy(state, culprit)
    h = float(np.mean(state.leverage[:, culprit]))
    assert energy == pytest.approx(16.0 * (1.0 - h) + h, rel=5.0 / np.sqrt(count))


def test_clean_files_without_sd_seldom_raise_an_alarm():
    alarms = sum(bool(accused("", 640_000 + seed, False)[0]) for seed in range(60))
    assert alarms <= 3


@pytest.mark.parametrize(("fault", "scenes"), [("noise x4", 4), ("flexible 3 %", 1)])
@pytest.mark.parametrize("stated", [True, False])
def test_culprits_on_few_points_are_named(fault, scenes, stated):
    named = 0
    for seed in range(641_000, 641_000 + scenes):
        found, true = accused(fault, seed, stated)
        named += found == true
    assert named == scenes

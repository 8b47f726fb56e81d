"""Few lines without a stated noise: its level is estimated jointly with the position errors."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.corrections import fitted
from benchmarks.fault_bodies import draw
from benchmarks.fault_scenes import scene
from benchmarks.points_faults import judged
from legacy.kinematics.faults.noise_size import common_level
from legacy.kinematics.faults.nuisance import Nuisance
from legacy.kinematics.faults.packed_readings import Source, initial
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.spatial import DOF_NAMES

STAPES = "stapes, 10 points 3D"


def level(seed, lines, position_sd_mm, stated_mm):
    """Return the estimated over the true variance of the noise, and its degrees of freedom."""
    made = scene(seed, STAPES, lines=lines, position_sd_mm=position_sd_mm)
    rng = np.random.default_rng(seed)
    noise = made.sd * (rng.normal(size=made.sd.shape) + 1j * rng.normal(size=made.sd.shape))
    beams = beam_set("stapes", made.reported, made.directions, DOF_NAMES)
    value = made.faulty() + noise
    fit = fit_lines(beams, value, made.sd)
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value[None])
    data = initial(Source.of(fit, body, made.freq_hz, True), body)
    return common_level(data, Nuisance.of(data, np.full(len(made.points), stated_mm * 1e-3)))


@pytest.mark.parametrize("lines", [2, 6, 20])
@pytest.mark.parametrize("position_sd_mm", [0.0, 0.05])
def test_level_of_the_noise_is_unbiased_whatever_the_position_errors(lines, position_sd_mm):
    found = np.array([level(seed, lines, position_sd_mm, position_sd_mm) for seed in range(30)])
    ratio, freedom = found[:, 0], found[0, 1]
    assert np.mean(ratio) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom / len(ratio)))
    assert np.std(ratio) == pytest.approx(np.sqrt(2.0 / freedom), rel=0.5)


def test_position_errors_that_nobody_stated_are_in_the_level():
    assert level(1, 12, 0.05, 0.0)[0] > 1.5


@pytest.mark.parametrize("lines", [2, 12])
def test_clean_files_with_few_lines_and_position_errors_seldom_raise_an_alarm(lines):
    alarms = 0
    for seed in range(30):
        made = scene(810_000 + seed, STAPES, lines=lines, position_sd_mm=0.05)
        found = judged(made, seed, stated=False, position_sd_mm=0.05)
        alarms += any(verdict.verdict != "ok" for verdict in found.channels)
    assert alarms <= 3


@pytest.mark.parametrize("fault", ["sign", "position 200 um", "noise x4"])
def test_faults_in_few_lines_are_named(fault):
    named = 0
    for seed in range(820_000, 820_003):
        made = scene(seed, STAPES, fault, lines=12, position_sd_mm=0.02)
        found = judged(made, seed, stated=False, position_sd_mm=0.02)
        accused = {c: v.verdict for c, v in enumerate(found.channels) if v.verdict != "ok"}
        named += accused == dict.fromkeys(made.culprits, made.verdict)
    assert named == 3


@pytest.mark.parametrize("fault", ["delay 8 us", "drift 7 %", "sign", "head delay 10 us"])
@pytest.mark.parametrize("stated", [True, False])
def test_changes_over_eight_lines_are_told_from_noise_and_from_a_wrong_sign(fault, stated):
    named = 0
    for seed in range(3):
        made = draw(seed, "rod, 8 points, 2-3 heads", fault, lines=8)
        found = fitted(made, correct=False, stated=stated)
        accused = {c: v.verdict for c, v in enumerate(found.channels) if v.verdict != "ok"}
        named += accused == dict.fromkeys(made.culprits, made.verdict)
    assert named == 3

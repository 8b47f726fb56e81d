"""The residual map shows a faulty channel against the motion of the others."""

from __future__ import annotations

import numpy as np

from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.report.draw_residuals import residual_map, without_culprits
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import scene


def test_a_culprit_does_not_darken_the_others():
    made = scene(5, "sign", lines=30)
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    culprit = made.culprits[0]
    others = np.arange(len(made.points)) != culprit
    before = residual_map(fit, made.freq_hz)
    after = residual_map(without_culprits(fit, [culprit]), made.freq_hz)
    assert np.max(after.rms[others]) < 1.6
    assert np.max(before.rms[others]) > 2.0 * np.max(after.rms[others])
    assert after.rms[culprit] > before.rms[culprit]
    assert np.median(after.size[others]) < 1.6


def test_channels_that_the_motion_needs_stay():
    made = scene(5, lines=4)
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    assert without_culprits(fit, list(range(20))) is fit
    assert without_culprits(fit, []) is fit

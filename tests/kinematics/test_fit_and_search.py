"""The search of all bodies, and what bounds it."""

from __future__ import annotations

import numpy as np

from legacy.kinematics.faults import diagnose
from legacy.kinematics.fit_options import Options
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, measurement, scene


def fitted(fault="", stated=False):
    made = scene(1, fault, lines=20)
    placed = measurement(body("stapes", made, sd=stated), freq_hz=made.freq_hz)
    return placed, points2dof(placed, options=Options(tuple(DOF_NAMES)))


def test_a_body_of_very_many_channels_is_fitted_but_not_searched(monkeypatch):
    _, searched = fitted("sign")
    monkeypatch.setattr(diagnose, "MOST_CHANNELS", 26)
    _, unsearched = fitted("sign")
    assert [len(one.diagnoses[0, 0].findings) for one in (searched, unsearched)] == [1, 0]
    codes = [{notice.code for notice in one.motion.notices} for one in (searched, unsearched)]
    assert ["faults_not_searched" in one for one in codes] == [False, True]
    assert np.all(np.isfinite(unsearched.motion.q))
    assert fitted("sign", stated=True)[1].diagnoses[0, 0].findings

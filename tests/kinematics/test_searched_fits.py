"""The search of all bodies, and what bounds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics import searched_fits as searches
from kinematics.faults import each_body
from kinematics.faults.packed.compact import compact
from kinematics.faults.packed.mixing import Mixing
from kinematics.points2dof import Options, points2dof
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, measurement, scene


def fitted(fault=""):
    made = scene(1, fault, lines=20)
    placed = measurement(body("stapes", made), freq_hz=made.freq_hz)
    return placed, points2dof(placed, options=Options(tuple(DOF_NAMES)))


def test_a_body_of_very_many_channels_is_fitted_but_not_searched(monkeypatch):
    _, searched = fitted("sign")
    monkeypatch.setattr(each_body, "MOST_CHANNELS", 26)
    monkeypatch.setattr(searches, "MOST_CHANNELS", 26)
    _, unsearched = fitted("sign")
    assert [len(one.diagnoses[0, 0].findings) for one in (searched, unsearched)] == [1, 0]
    codes = [{notice.code for notice in one.motion.notices} for one in (searched, unsearched)]
    assert ["faults_not_searched" in one for one in codes] == [False, True]
    assert np.all(np.isfinite(unsearched.motion.q))


def test_white_transposed_is_the_transpose_of_white():
    placed, result = fitted()
    data = compact(result.fits[0, 0], placed.bodies[0], placed.freq_hz)
    rng, count = np.random.default_rng(0), len(data.a)
    pairs = np.kron(np.eye(count // 3), np.full((3, 3), 0.4)) + 0.6 * np.eye(count)
    for mixing in (None, Mixing.of(pairs, list(range(count)))):
        some = replace(data, mixing=mixing)
        one, other = rng.normal(size=(2, count, 4))
        assert np.allclose(other.T @ some.white(one), some.white_transposed(other).T @ one)

"""The refit with a factor over the lines gives what the factorisation of all rows at every line gives."""

from __future__ import annotations

import numpy as np
import pytest

from kinematics.faults.fault_kinds import delay, drift, gain
from kinematics.faults.packed.compact import compact
from kinematics.faults.refit import Places, Refit
from kinematics.faults.refit_factor import FactorRefit, refit
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene


def packed_scene():
    made = scene(23, "gain")
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    return compact(fit, body("stapes", made), made.freq_hz)


@pytest.mark.parametrize("sd_m", [0.0, 2e-5])
@pytest.mark.parametrize("channels", [[4], [3, 4, 5], list(range(2, 27, 3))])
@pytest.mark.parametrize("kind", ["drift", "delay"])
def test_same_objective_and_steps(kind, channels, sd_m):
    data = packed_scene()
    places = Places.of(data, np.full(len(data.points), sd_m))
    fault = drift(channels) if kind == "drift" else delay(data, channels)
    rng = np.random.default_rng(3)
    theta = fault.scale * rng.normal(size=fault.size)
    shift = 1e-5 * rng.normal(size=(len(places.owners), 3))
    short = refit(data, places, fault, theta, shift, None)
    whole = Refit(data, places, fault, theta, shift)
    assert isinstance(short, FactorRefit)
    assert short.objective == pytest.approx(whole.objective, rel=1e-11)
    np.testing.assert_allclose(short.z, whole.z, atol=1e-11 * np.max(np.abs(whole.z)))
    np.testing.assert_allclose(short.e, whole.e, atol=1e-11 * np.max(np.abs(data.a[:, None] * data.y)))
    for one, two in zip(short.step(), whole.step(), strict=True):
        scale = np.max(np.abs(two), axis=-1, keepdims=True)
        np.testing.assert_allclose(one, two, atol=1e-7 * float(np.max(scale)))


def test_motion_that_the_rows_do_not_determine_takes_the_longer_way():
    data = packed_scene()
    fault = drift(list(range(len(data.points))))
    gone = np.concatenate([[-1.0], np.zeros(3)])
    found = refit(data, Places(), fault, gone, np.zeros((0, 3)), None)
    assert isinstance(found, Refit)
    assert isinstance(refit(data, Places(), gain([4]), np.zeros(1), np.zeros((0, 3)), None), Refit)

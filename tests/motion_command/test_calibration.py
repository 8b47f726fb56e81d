"""Calibration: drawn errors of axes, beams, lasers and positions lie within what it states of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinematics.joint.expected import lasers_of, stated_errors
from kinematics.joint.pack import Readings, pack
from kinematics.joint.tangents import Geometry
from kinematics.place.errors import estimate_errors, parameters_of, with_errors
from tests.motion_command.ears import error_in_sd, measured, rewrite, simulated
from tests.motion_command.test_shared_errors import fitted, measurement

LASER_SD = {"laser_gain": 0.01, "laser_phase": np.deg2rad(0.5), "laser_delay": 1e-6}


def drawn(seed, position_sd=2e-5):
    """Return a measurement as assumed, the drawn errors in SI, and their names."""
    true = measurement(seed, points=8, lines=60, position_sd=position_sd)
    rng = np.random.default_rng([seed, 5])
    body = true.bodies[0]
    stated = stated_errors(true.bodies, LASER_SD, calibrate=True)
    parameters = parameters_of(true, stated)
    off = 1.0
    while off > 1e-9:  # the normals of a beam jump where two of its components are alike: draw again
        errors = parameters.sd * rng.normal(size=len(parameters))
        directions = body.directions  # those from which the drawn errors lead to the true ones
        for _ in range(8):
            assumed = Geometry(body.arms_m, directions, np.ones((1, len(body.points)), dtype=complex))
            moved = assumed.moved(parameters, errors, np.zeros(60), 2.0 * np.pi * true.freq_hz)
            directions = directions + body.directions - moved.directions
            directions = directions / np.linalg.norm(directions, axis=1)[:, None]
        off = np.max(np.abs(moved.directions - body.directions))
    sd = 0.03 * float(np.sqrt(np.mean(np.abs(body.value) ** 2)))
    noise = sd * rng.normal(size=(*body.value.shape, 2)).view(complex)[..., 0]
    value = body.value * moved.factor.T + noise
    given = replace(
        body,
        positions_m=2.0 * body.arms_m - moved.positions_m,
        directions=directions,
        value=value,
        sd=np.full(value.shape, sd),
    )
    return replace(true, bodies=(given,)), errors, [error.name for error in stated]


def calibrate(placed):
    body = placed.bodies[0]
    packed = pack(Readings.of(body.value, body.sd, placed.freq_hz, body.arms_m, body.directions))
    return estimate_errors(placed, stated_errors(placed.bodies, LASER_SD, calibrate=True), {0: packed})


def test_errors_lie_within_what_is_stated_of_them():
    distances, gained, free = [], [], 0
    for seed in range(12):
        placed, errors, names = drawn(seed)
        found = calibrate(placed)
        assert found.names == tuple(names)
        scale = found.prior_sd
        covariance = found.covariance / np.outer(scale, scale)
        left = (found.values - errors) / scale
        distances.append(left @ np.linalg.solve(covariance + 1e-9 * np.eye(len(left)), left))
        gained.append(np.mean(found.sd / found.prior_sd))
        free = len(left)
    assert np.median(distances) / free == pytest.approx(1.0, abs=0.2)
    assert np.max(distances) < 2.0 * free
    assert np.mean(gained) < 0.9


def test_the_calibrated_motion_fits_better_and_estimates_are_not_beyond_their_priors():
    placed, _, _ = drawn(5)
    found = calibrate(placed)
    before, after = (float(np.nansum(fitted(one)[0, 0].chi2)) for one in (placed, with_errors(placed, found)))
    n_dof = int(np.sum(fitted(placed)[0, 0].n_dof))
    assert after < n_dof + 4.0 * np.sqrt(2.0 * n_dof) < before
    assert found.p_value > 1e-3
    assert [notice.code for notice in found.notices()] == []


def test_values_far_off_do_not_move_the_geometry(tmp_path):
    truth = simulated(tmp_path, seed=74, in_footplate=True)

    def spoil(table):
        far = np.random.default_rng(3).random(len(table)) < 0.01
        table.loc[far, ["re_m_s", "im_m_s"]] *= 3.0

    rewrite(tmp_path / "ldv.csv", spoil)
    result = measured(tmp_path, calibrate=True, robust="huber")
    assert {notice.code for notice in result.notices} == {"outliers"}
    assert np.sqrt(np.mean(error_in_sd(result, truth) ** 2)) < 1.3


def test_what_an_estimate_leaves_of_a_disagreement_is_a_share():
    """A turned phase of one laser is more than what is stated allows to correct: not all of it is gone."""
    placed, _, _ = drawn(4)
    body = placed.bodies[0]
    value = body.value.copy()
    value[:, lasers_of(placed.bodies)[0][0]] *= np.exp(1j * np.deg2rad(40.0))
    wrong = replace(placed, bodies=(replace(body, value=value),))
    sound, found = calibrate(placed), calibrate(wrong)
    assert sound.share_left < 0.2
    assert 0.02 < found.share_left < 1.0


def test_errors_beyond_their_priors_are_reported():
    placed, _, _ = drawn(4)
    body = placed.bodies[0]
    off = body.arms_m.copy()
    off[body.channels_of(body.points[0])] += 4e-4
    wrong = replace(placed, bodies=(replace(body, positions_m=off),))
    found = calibrate(wrong)
    assert [notice.code for notice in found.notices()] == ["stated_errors_exceeded"]
    worst = int(np.argmax(np.abs(found.values) / found.prior_sd))
    assert found.names[worst].startswith("position.stapes.")

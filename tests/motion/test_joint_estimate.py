"""The model of a channel and its estimator: derivatives, covariance, priors, packing without loss."""

import numpy as np
import pytest

from kinematics.joint.estimate import State, joint, system
from kinematics.joint.pack import Readings, pack
from kinematics.joint.tangents import COUNT, DELAY, GAIN, GAIN_DRIFT, PHASE, SHIFT, TURN, Parameters
from tests.motion.bodies import as_measurement, recorded


def readings_of(seed, **given):
    """Return the readings of a simulated body, with the noise that it has."""
    body = as_measurement(recorded(seed, **given)).bodies[0]
    freq = recorded(seed, **given).freq_hz
    return Readings.of(body.value, body.sd, freq, body.arms_m, body.directions)


@pytest.mark.parametrize("missing", [0.0, 0.1])
@pytest.mark.parametrize("tangent", range(COUNT))
def test_scores_are_derivatives_of_the_squares(tangent, missing):
    packed = pack(readings_of(1, missing=missing))
    parameters = Parameters.of(27, [([4, 5], tangent, np.inf)])
    score = system(State(packed), parameters)[0][0]
    step = 1e-9 if tangent in (*SHIFT, DELAY) else 1e-6
    moved = [
        State(
            packed, packed.geometry.moved(parameters, np.array([sign * step]), packed.tau, packed.omega)
        ).energy
        for sign in (1.0, -1.0)
    ]
    slope = -0.5 * (moved[0] - moved[1]) / (2.0 * step)
    assert score == pytest.approx(slope, rel=1e-3, abs=1e-4 * abs(score) + 1e-2 / step * 1e-6)


@pytest.mark.parametrize("factor", [-2.1, -0.7, 0.5])
@pytest.mark.parametrize("tangent", [GAIN, PHASE, GAIN_DRIFT])
def test_scores_of_factors_are_derivatives_where_a_channel_was_reversed_or_scaled(tangent, factor):
    packed = pack(readings_of(1))
    parameters = Parameters.of(27, [([4], GAIN, np.inf), ([4], tangent, np.inf)])

    def moved(step):
        values = np.array([factor, step])
        return State(packed, packed.geometry.moved(parameters, values, packed.tau, packed.omega))

    slope = -0.5 * (moved(1e-6).energy - moved(-1e-6).energy) / 2e-6
    assert system(moved(0.0), parameters)[0][1] == pytest.approx(slope, rel=1e-3)


def test_packing_keeps_all_squares_of_motion_and_noise():
    readings = readings_of(2, lines=96)
    state = State(pack(readings))
    rows = readings.geometry.rows()
    q = np.linalg.qr(rows / readings.sd[:, :1])[0]
    white = readings.value / readings.sd
    whole = np.sum(np.abs(white - q @ (q.T @ white)) ** 2)
    energy, freedom = state.noise_energy
    assert state.energy + energy.sum() == pytest.approx(whole, rel=1e-9)
    assert state.freedom + freedom.sum() == pytest.approx(2 * (27 - 6) * 96)


def test_estimates_are_unbiased_and_state_their_covariance():
    entries = [
        ([3], GAIN, np.inf),
        ([3], PHASE, np.inf),
        ([10], GAIN_DRIFT, np.inf),
        ([15, 16, 17], SHIFT[0], np.inf),
    ]
    size = np.array([0.04, 0.03, 0.05, 5e-5])
    parameters = Parameters.of(27, entries)
    pulls = []
    for seed in range(40):
        readings = readings_of(seed, lines=60)
        wrong = readings.geometry.moved(parameters, size, readings.tau, readings.omega)
        truth = readings.geometry.rows()
        turned = np.linalg.lstsq(truth, readings.value, rcond=None)[0]
        change = (wrong.factor.T * (wrong.rows() @ turned)) - truth @ turned
        packed = pack(Readings(**{**readings.__dict__, "value": readings.value + change}))
        found = joint(packed, parameters)
        pulls.append((found.values - size) / np.sqrt(np.diag(found.covariance)))
    pulls = np.array(pulls)
    assert np.all(np.abs(pulls.mean(axis=0)) < 0.75)
    assert 0.75 < np.mean(pulls**2) < 1.3


def test_a_prior_keeps_what_data_do_not_show():
    packed = pack(readings_of(3))
    every = list(range(27))
    found = joint(packed, Parameters.of(27, [(every, GAIN, 0.01), (every, SHIFT[1], 1e-5)]))
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([0.01, 1e-5], rel=1e-6)
    assert found.values == pytest.approx([0.0, 0.0], abs=1e-6)


def test_turn_of_all_beams_is_found_against_the_positions():
    recording = recorded(4, faults=[{"kind": "axes", "size": 2.0}])
    body = as_measurement(recording).bodies[0]
    packed = pack(Readings.of(body.value, body.sd, recording.freq_hz, body.arms_m, body.directions))
    found = joint(packed, Parameters.of(27, [(range(27), axis, np.inf) for axis in TURN]))
    assert np.linalg.norm(found.values) == pytest.approx(np.radians(2.0), rel=0.25)
    assert found.chi2 < found.state.freedom + 5.0 * np.sqrt(2.0 * found.state.freedom)

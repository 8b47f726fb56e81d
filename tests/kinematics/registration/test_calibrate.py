"""Geometry and motion together: honest errors, what no residual shows, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.calibrate import calibrate
from legacy.kinematics.registration.calibrated_fit import calibration_errors
from legacy.kinematics.registration.geometry_model import GeometryModel, GeometryPriors
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.spatial import DOF_NAMES, point_rows
from tests.kinematics.simulated import readings, smooth_motion, stapes_points, three_beams

COUNT = 7


def laser_errors(rng, beams, axes_deg, beam_deg):
    """Turn all beams together, and each about two axes across itself."""
    whole = rotation_from_vector(np.radians(axes_deg) * rng.normal(size=3))
    turned = []
    for beam in beams:
        first = np.cross(beam, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        size = np.radians(beam_deg) * rng.normal(size=2)
        turned.append(whole @ rotation_from_vector(size[0] * first + size[1] * np.cross(beam, first)) @ beam)
    return np.array(turned), whole


def ear(seed, *, pos=0.05, axes=1.0, beam=0.5, gain=0.0, snr=100.0, lines=60, sd_known=True):
    """Return a measurement of two bodies with errors of its geometry, the true motion, and the true turn."""
    rng = np.random.default_rng([seed, 21])
    freq = np.linspace(400.0, 5000.0, lines)
    reported = three_beams()
    beams, whole = laser_errors(rng, reported, axes, beam)
    gains = np.tile(1.0 + 0.01 * gain * rng.normal(size=3), COUNT)
    bodies, motions = [], []
    for name in ("stapes", "base"):
        places, q = stapes_points(rng, COUNT), smooth_motion(rng, freq)
        true = places + pos * rng.normal(size=places.shape)
        clean = gains[:, None] * readings(np.repeat(true, 3, axis=0), np.tile(beams, (COUNT, 1)), q)
        sd = np.full(clean.shape, np.sqrt(np.mean(np.abs(clean) ** 2) / 2.0) / snr)
        value = clean + sd * (rng.normal(size=(*clean.shape, 2)) @ [1.0, 1j])
        bodies.append(
            BodyChannels(
                name, tuple(str(1 + c // 3) for c in range(3 * COUNT)), np.repeat(places, 3, axis=0),
                np.tile(reported, (COUNT, 1)), value[None], sd[None] if sd_known else None, not sd_known,
                np.full(3 * COUNT, pos),
            )
        )  # fmt: skip
        motions.append(q)
    return Measurement("footplate", ("1",), freq, tuple(bodies), 0), np.array(motions), whole


def nees(result, truth):
    """Return the mean squared Mahalanobis distance of the motion per degree of freedom, all errors in."""
    motion, found = result.motion, []
    for body in range(len(motion.bodies)):
        for line in range(0, len(motion.freq_hz), 15):
            slopes = motion.shared.derivatives[:, 0, body, line]
            parts = np.vstack([slopes.real.T, slopes.imag.T])
            covariance = parts @ motion.shared.covariance @ parts.T
            noise = 0.5 * motion.covariance[0, body, line].real
            covariance += np.kron(np.eye(2), noise)
            error = truth[body, line] - motion.q[0, body, line]
            error = np.concatenate([error.real, error.imag])
            found.append(error @ np.linalg.solve(covariance, error) / len(error))
    return np.mean(found)


@pytest.mark.parametrize("case", [{}, {"gain": 1.0, "pos": 0.02}, {"sd_known": False}])
def test_errors_of_the_motion_are_honest(case):
    priors = GeometryPriors(1.0, 0.5, case.get("gain", 0.0))
    both = []
    for seed in range(18):
        measurement, truth, _ = ear(seed, **case)
        both.append(nees(points2dof(measurement, options=Options(calibrate=priors)), truth))
    assert np.mean(both) == pytest.approx(1.0, abs=0.2)


def test_without_it_errors_of_the_axes_are_not_in_the_covariance():
    plain = [nees(points2dof(ear(seed)[0]), ear(seed)[1]) for seed in range(4)]
    assert np.mean(plain) > 1.7


def test_the_turn_between_beams_and_positions_is_found():
    errors = []
    for seed in range(15):
        measurement, _, whole = ear(seed, pos=0.01, axes=2.0, beam=0.01)
        made = calibrate(measurement, [DOF_NAMES] * 2, GeometryPriors(3.0, 0.01), stated(measurement))
        found = rotation_from_vector(made.values[:3])
        turn = found @ whole.T
        errors.append(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
        assert np.all(made.seen[:3])
        assert made.p_value > 1e-4
    assert np.rad2deg(np.sqrt(np.mean(np.square(errors)))) < 0.5


def stated(measurement):
    return {(0, body): 0.5 / one.sd[0] ** 2 for body, one in enumerate(measurement.bodies)}


def test_common_shifts_and_turns_leave_no_residual():
    """Shift and turn the positions of a body with all beams: nothing to find, and said so."""
    measurement, _, _ = ear(3, pos=0.05, axes=0.0, beam=0.0)
    priors = GeometryPriors(1.0, 0.0)
    base = calibrate(measurement, [DOF_NAMES] * 2, priors, stated(measurement))
    turn = rotation_from_vector([0.02, -0.01, 0.03])
    bodies = tuple(
        replace(
            one,
            positions_mm=one.positions_mm @ turn.T + [0.1, -0.2, 0.1],
            directions=one.directions @ turn.T,
        )
        for one in measurement.bodies
    )
    moved = calibrate(replace(measurement, bodies=bodies), [DOF_NAMES] * 2, priors, stated(measurement))
    assert moved.fall == pytest.approx(base.fall, rel=1e-6)
    assert moved.chi2 == pytest.approx(base.chi2, rel=1e-4)
    places = [k for k, name in enumerate(base.model.names) if name.startswith("position.stapes")]
    together = np.zeros((len(base.names), 3))
    for axis in range(3):
        together[places[axis::3], axis] = 1.0
    spread = together.T @ np.linalg.solve(base.covariance, together)
    before = together.T @ (together / base.model.prior_sd[:, None] ** 2)
    assert np.allclose(spread, before, rtol=1e-6, atol=1e-6 * before[0, 0])
    assert "No residual shows a shift of all points" in base.notices[0].text


def test_a_geometry_beyond_its_priors_is_told():
    measurement, _, _ = ear(5, pos=0.005, axes=4.0, beam=0.0)
    result = points2dof(measurement, options=Options(calibrate=GeometryPriors(0.2, 0.1)))
    codes = [notice.code for notice in result.notices]
    assert "calibration_beyond_priors" in codes
    assert result.calibration.p_value < 1e-6


def test_lines_with_gaps_or_uneven_noise_give_what_even_ones_do():
    """The compressed path and the line-by-line path are one estimate."""
    measurement, _, _ = ear(7, lines=30)
    priors = GeometryPriors()
    weights = stated(measurement)
    even = calibrate(measurement, [DOF_NAMES] * 2, priors, weights)
    slightly = {key: value.copy() for key, value in weights.items()}
    for value in slightly.values():
        value[0, 0] *= 1.0 + 1e-4
    uneven = calibrate(measurement, [DOF_NAMES] * 2, priors, slightly)
    assert np.allclose(
        even.values, uneven.values, atol=0.02 * np.min(even.sd / even.model.prior_sd) * even.sd
    )
    assert np.allclose(even.sd, uneven.sd, rtol=1e-2)
    gap = {key: value.copy() for key, value in weights.items()}
    gap[0, 0][4, 10:20] = 0.0
    assert np.all(calibrate(measurement, [DOF_NAMES] * 2, priors, gap).sd >= 0.999 * even.sd)


def test_changes_are_the_derivatives_of_the_rows():
    measurement, _, _ = ear(2, gain=1.0)
    model = GeometryModel.of(measurement, GeometryPriors(1.0, 0.5, 1.0))
    rng = np.random.default_rng(0)
    values = 1e-6 * model.prior_sd * rng.normal(size=len(model.names))

    def rows(at):
        body = model.body(1, at)
        return (1.0 + model.gains(1, at))[:, None] * point_rows(body.positions_mm * 1e-3, body.directions)

    slopes = np.zeros((len(model.names), *rows(values).shape))
    for change in model.changes(1, values):
        slopes[change.parameter, change.channels] += change.rows
    for parameter in range(len(model.names)):
        step = np.zeros(len(values))
        step[parameter] = 1e-6
        numeric = (rows(values + step) - rows(values - step)) / 2e-6
        assert np.allclose(slopes[parameter], numeric, atol=1e-6)


def test_many_parameters_are_kept_as_combinations(monkeypatch):
    measurement, _, _ = ear(1)
    whole = points2dof(measurement, options=Options(calibrate=GeometryPriors()))
    monkeypatch.setattr("legacy.kinematics.registration.calibrated_fit._NAMED_BYTES", 0)
    names, covariance, slopes = calibration_errors(whole.calibration, whole.fits, whole.motion.q.shape)
    assert len(names) == 40
    full = whole.motion.shared
    for body in range(2):
        kept = np.einsum("pfm,pq,qfm->fm", slopes[:, 0, body], covariance, slopes[:, 0, body].conj()).real
        wanted = np.einsum(
            "pfm,pq,qfm->fm",
            full.derivatives[:, 0, body],
            full.covariance,
            full.derivatives[:, 0, body].conj(),
        ).real
        assert np.all(kept <= 1.0001 * wanted)
        assert np.median(kept / wanted) > 0.98


def test_impossible_calibrations_are_refused():
    with pytest.raises(StapeskitError, match="--axes-sd must be a number from 0 to 20"):
        GeometryPriors(-1.0)
    measurement, _, _ = ear(0, pos=0.0)
    with pytest.raises(StapeskitError, match="--calibrate must be used with something to estimate"):
        points2dof(measurement, options=Options(calibrate=GeometryPriors(0.0, 0.0, 0.0)))

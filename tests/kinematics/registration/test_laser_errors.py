"""Errors of lasers as shared parameters: their effect, their estimates, what the data leave undetermined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.laser_groups import group_lasers
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.laser_errors import LaserPriors, Lasers, laser_parts
from legacy.kinematics.registration.prior_errors import compare_with_priors, shown
from tests.kinematics.simulated import readings, scene

FREQ = np.linspace(400.0, 5000.0, 40)


def measured(
    seed=1, snr=300.0, gain=(0.0, 0.0, 0.0), phase=(0.0, 0.0, 0.0), delay=(0.0, 0.0, 0.0), stated=True, **more
):
    """Readings of three lasers with errors of their own; their noise may be left unstated."""
    made = scene(seed, lines=len(FREQ), snr=snr, **more)
    lasers, _ = group_lasers([made.directions])
    omega = 2.0 * np.pi * made.freq_hz
    factor = (1.0 + np.array(gain)[:, None]) * np.exp(
        1j * (np.array(phase)[:, None] - np.outer(delay, omega))
    )
    value = made.value * factor[lasers[0]]
    body = {
        "points": made.points,
        "positions_mm": made.positions_mm,
        "directions": made.directions,
        "value": value,
    }
    if stated:
        body["sd"] = made.sd
    return from_arrays({"stapes": body}, made.freq_hz, order=0), made


def with_gaps(measurement, share, seed=0):
    """Leave out a share of the values, at other lines in each channel."""
    body = measurement.bodies[0]
    lost = np.random.default_rng([seed, 7]).random(body.displacement.shape) < share
    value = np.where(lost, np.nan, body.displacement)
    return replace(measurement, bodies=(replace(body, displacement=value),))


def test_the_parts_of_the_lasers_add_up_and_scale_with_their_readings():
    measurement, _ = measured()
    body = measurement.bodies[0]
    beams = beam_set("stapes", body.positions_mm, body.directions, ("x", "y", "z", "alpha", "beta", "gamma"))
    (lasers,), _ = group_lasers([body.directions])
    value = body.displacement[0].copy()
    value[2, 5] = np.nan
    before = fit_lines(beams, value, body.sd[0])
    parts = laser_parts(before, lasers, 3)
    assert np.allclose(parts.sum(axis=0), before.q, rtol=1e-9)
    for laser in range(3):
        louder = np.where((lasers == laser)[:, None], 1.01, 1.0) * value
        after = fit_lines(beams, louder, body.sd[0])
        size = np.max(np.abs(before.q), axis=0)
        assert np.max(np.abs(after.q - before.q - 0.01 * parts[laser]) / size) < 1e-9


@pytest.mark.parametrize(
    ("kind", "true"),
    [("gain", (0.02, -0.01, -0.01)), ("phase", (0.015, 0.0, -0.015)), ("delay", (2e-6, -1e-6, -1e-6))],
)
def test_what_the_beams_tell_corrects_the_motion(kind, true):
    measurement, made = measured(**{kind: true})
    free = points2dof(measurement)
    place = ("gain", "phase", "delay").index(kind)
    found = free.lasers.estimate.values[3 * place : 3 * place + 3]
    sd = free.lasers.sd[3 * place : 3 * place + 3]
    assert np.all(np.abs(found - true) < 4.0 * sd)
    assert np.max(sd) < 0.3 * np.max(np.abs(true))
    exact = points2dof(measurement, options=Options(lasers=LaserPriors(0.0, 0.0, 0.0)))
    size = np.sqrt(np.mean(np.abs(made.q) ** 2, axis=0))

    def off(result):
        common = np.mean(true) * {"gain": 1.0, "phase": 1j, "delay": 1.0}[kind]
        assert abs(common) < 1e-12
        return np.sqrt(np.mean(np.abs((result.motion.q[0, 0] - made.q) / size) ** 2))

    assert off(free) < 0.4 * off(exact)
    assert exact.lasers is None


def test_readings_freed_of_their_errors_are_those_without_and_move_the_motion_as_the_derivatives_say():
    errors = {"gain": (0.02, 0.0, -0.01), "phase": (0.01, -0.02, 0.0), "delay": (0.0, 2e-6, -1e-6)}
    plain, wrong = measured(count=5)[0], measured(count=5, **errors)[0]
    lasers = Lasers.of(plain, LaserPriors())
    freed = lasers.corrected(wrong, np.concatenate(list(errors.values())))
    assert freed.bodies[0].displacement == pytest.approx(plain.bodies[0].displacement, rel=1e-9)
    body = plain.bodies[0]
    beams = beam_set("stapes", body.positions_mm, body.directions, ("x", "y", "z", "alpha", "beta", "gamma"))

    def fit(measurement):
        return fit_lines(beams, measurement.bodies[0].displacement[0], body.sd[0])

    slopes = lasers.errors(plain, {(0, 0): fit(plain)}, agreement(plain)).derivatives[:, 0, 0]
    size = np.max(np.abs(fit(plain).q), axis=0)
    for place, step in enumerate(np.repeat([1e-4, 1e-4, 1e-8], 3)):
        ends = [fit(lasers.corrected(plain, sign * step * np.eye(9)[place])).q for sign in (1.0, -1.0)]
        change = (ends[0] - ends[1]) / (2.0 * step)
        assert np.max(np.abs(slopes[place] - change) / size) * step < 1e-7


def agreement(measurement, priors=None):
    """The errors of the lasers without a search for faults."""
    body = measurement.bodies[0]
    beams = beam_set("stapes", body.positions_mm, body.directions, ("x", "y", "z", "alpha", "beta", "gamma"))
    fit = fit_lines(beams, body.displacement[0], body.sd[0])
    lasers = Lasers.of(measurement, priors or LaserPriors())
    return lasers.estimate(measurement, {(0, 0): fit})


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_estimates_spread_as_stated(missing):
    deviations = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = rng.standard_normal((3, 3)) * np.array([[0.01], [np.deg2rad(0.5)], [1e-6]])
        measurement, _ = measured(seed + 100, snr=100.0, gain=true[0], phase=true[1], delay=true[2])
        found = agreement(with_gaps(measurement, missing, seed))
        relative = (true - true.mean(axis=1, keepdims=True)).ravel()
        deviations.append((found.values - relative) / found.sd)
    spread = np.sqrt(np.mean(np.array(deviations) ** 2))
    assert 0.85 < spread < 1.15


def test_stated_position_errors_leave_the_lasers_open():
    measurement, _ = measured()
    vague = replace(
        measurement,
        bodies=tuple(
            replace(body, position_sd_mm=np.full(len(body.points), 0.1)) for body in measurement.bodies
        ),
    )
    sharp, blurred = agreement(measurement), agreement(vague)
    assert np.min(blurred.sd[:3]) > 3.0 * np.max(sharp.sd[:3])
    shared = points2dof(vague).motion.shared
    values = np.linalg.eigvalsh(shared.covariance / np.sqrt(np.outer(*[np.diag(shared.covariance)] * 2)))
    assert values[0] > -1e-9


def test_lasers_and_positions_share_what_a_displaced_point_makes_of_the_estimate():
    """What is left of a laser, e - e', has the covariance -sd^2 de'/dp with the error p of a coordinate."""
    measurement, made = measured(count=5)
    sd, step = 0.05e-3, 1e-6
    body = replace(measurement.bodies[0], position_sd_mm=np.full(len(made.points), 1e3 * sd))
    change = readings(made.positions_mm + 1e3 * step * np.eye(3)[1], made.directions, made.q)
    change -= readings(made.positions_mm, made.directions, made.q)
    change *= np.array([name == made.points[0] for name in made.points])[:, None]
    before, after = (
        agreement(replace(measurement, bodies=(replace(body, displacement=body.displacement + shift),)))
        for shift in (0.0, change)
    )
    gains = slice(0, 3)
    expected = -(sd**2) * (after.values - before.values)[gains] / step
    found = before.across[0, made.points[0]][gains, 1]
    assert found == pytest.approx(expected, abs=0.03 * np.abs(expected).max())


def test_lasers_beyond_what_is_stated_are_reported():
    measurement, _ = measured(gain=(0.06, -0.03, -0.03), snr=30.0)
    codes = {notice.code for notice in points2dof(measurement).notices}
    assert "lasers_disagree" in codes


def test_one_laser_agrees_with_itself():
    measurement, _ = measured()
    body = measurement.bodies[0]
    one = replace(
        measurement,
        bodies=(replace(body, directions=np.tile([0.0, 1.0, 0.0], (len(body.points), 1)),
                        reported_directions=np.empty(0)),),
    )  # fmt: skip
    result = points2dof(one, options=Options(dof=("y", "alpha", "gamma")))
    assert result.lasers is None
    assert result.motion.shared is None


def test_many_directions_are_grouped_without_comparing_all_pairs():
    rng = np.random.default_rng(5)
    heads = np.array([[0.0, 0.0, 1.0], [0.0, 0.34, 0.94], [0.6, 0.0, 0.8]])
    beams = np.repeat(heads, 5000, axis=0) + 0.02 * rng.standard_normal((15000, 3))
    beams /= np.linalg.norm(beams, axis=1)[:, None]
    (lasers,), means = group_lasers([beams])
    assert np.array_equal(lasers, np.repeat([0, 1, 2], 5000))
    assert np.max(np.abs(means - heads / np.linalg.norm(heads, axis=1)[:, None])) < 5e-3


@pytest.mark.parametrize("sizes", [(-1.0, 0.5, 1.0), (1.0, 25.0, 1.0), (1.0, 0.5, float("nan"))])
def test_priors_out_of_range_are_refused(sizes):
    with pytest.raises(KinematicsError):
        LaserPriors(*sizes)


def test_errors_are_shown_in_the_units_in_which_they_are_stated():
    stated = (1.5, 0.25, 3.0)
    sd = LaserPriors(*stated).sd_by_kind()
    assert [shown(f"{kind}.2")[1] * size for kind, size in sd.items()] == pytest.approx(stated)
    assert [shown(kind)[2] for kind in sd] == ["%", "°", "us"]
    assert shown("gain.stapes.1")[1:] == shown("laser_gain.1")[1:]
    assert shown("position.stapes.1.x")[1:] == (1e6, "um")
    assert shown("turn.stapes.z")[1] * np.pi == pytest.approx(180.0)


def test_estimates_are_judged_by_what_the_data_add_to_their_priors():
    """Of n errors that the data leave the share s of their variance, chi2 is that of (1 - s) of it."""
    prior, left, values = np.array([0.01, 0.02, 1e-6]), 0.36, np.array([0.02, 0.0, -2e-6])
    chi2, count, chance = compare_with_priors(values, left * np.diag(prior**2), prior, np.eye(3))
    assert (chi2, count) == (pytest.approx((4.0 + 4.0) / 0.64), 3)
    assert chance == pytest.approx(stats.chi2.sf(12.5, 3))
    nothing = compare_with_priors(values, np.diag(prior**2), prior, np.eye(3))
    assert nothing == (0.0, 0, 1.0)


def test_a_laser_that_is_off_by_as_much_as_the_report_says_is_mostly_found():
    found = dict.fromkeys((0.3, 1.0), 0)
    least = float(agreement(measured(0, gain=(0.003, 0.012, -0.008), count=6)[0]).detectable[0])
    assert 0.055 < least < 0.065  # (3.26 + 1.64) / sqrt(2 / 3) %
    for seed in range(12):
        rng = np.random.default_rng([seed, 5])
        scatter = 0.01 * rng.normal(size=3)
        for share in found:
            gain = scatter + share * least * np.eye(3)[seed % 3] * rng.choice([-1.0, 1.0])
            result = points2dof(measured(seed, gain=tuple(gain), count=6)[0])
            found[share] += any(channel.verdict != "ok" for channel in result.channels)
    assert found[1.0] >= 11
    assert found[0.3] <= 3


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_a_usual_scatter_of_lasers_is_no_fault_where_the_noise_is_not_stated(missing):
    rng = np.random.default_rng(5)
    alarms = 0
    for seed in range(8):
        gain, phase, delay = (sd * rng.normal(size=3) for sd in (0.01, np.radians(0.5), 1e-6))
        readings, _ = measured(100 + seed, 150.0, gain, phase, delay, stated=False, count=6)
        readings = with_gaps(readings, missing, seed)
        alarms += any(channel.verdict != "ok" for channel in points2dof(readings).channels)
    # An alarm in one of a hundred files: two in eight have a probability of .003.
    assert alarms <= 1


def test_a_laser_that_is_far_off_is_named_where_the_noise_is_not_stated():
    readings, made = measured(3, 150.0, gain=(0.0, 0.08, 0.0), stated=False)
    (lasers,), _ = group_lasers([made.directions])
    verdicts = [channel.verdict for channel in points2dof(readings).channels]
    assert {verdict for verdict, laser in zip(verdicts, lasers, strict=True) if laser == 1} == {"gain"}
    assert {verdict for verdict, laser in zip(verdicts, lasers, strict=True) if laser != 1} == {"ok"}

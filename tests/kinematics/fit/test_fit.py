"""The rigid fit: exact on exact data, at the Cramer-Rao bound on noise, honest about what it cannot see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.kinematics.fit.beams import UNOBSERVABLE, beam_set, observability, unseen_motions
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement, from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import (
    body,
    measurement,
    readings,
    scene,
    smooth_motion,
    stapes_points,
    three_beams,
)

PAPER_DOF = ("y", "alpha", "gamma")


def fitted(made, dof=DOF_NAMES, sd=None, robust="none"):
    beams = beam_set("stapes", made.positions_mm, made.directions, dof)
    return fit_lines(beams, made.value, made.sd if sd is None else sd, robust)


@given(st.integers(0, 400))
@settings(max_examples=40)
def test_exact_data_give_the_exact_motion(seed):
    made = scene(seed, lines=7, snr=np.inf)
    found = fitted(made, sd=np.full(made.value.shape, 1e-9))
    assert np.max(np.abs(found.q - made.q) / np.max(np.abs(made.q), axis=0)) < 1e-11
    assert np.max(np.abs(found.residual)) < 1e-12 * np.max(np.abs(made.value))


def test_weights_that_differ_by_a_million_cost_no_digits():
    made = scene(3, lines=7, snr=np.inf)
    rng = np.random.default_rng(3)
    sd = 10.0 ** rng.uniform(-12.0, -6.0, made.value.shape)
    found = fitted(made, sd=sd)
    assert np.max(np.abs(found.q - made.q) / np.max(np.abs(made.q), axis=0)) < 1e-7


def test_result_does_not_depend_on_units_of_the_lever():
    """A body a hundred times larger with rotations a hundred times smaller reads the same."""
    made = scene(5, lines=5)
    small = fitted(made)
    beams = beam_set("stapes", made.positions_mm * 1e4, made.directions, DOF_NAMES)
    large = fit_lines(beams, made.value, made.sd)
    assert np.allclose(large.q[:, :3], small.q[:, :3], rtol=1e-10)
    assert np.allclose(large.q[:, 3:] * 1e4, small.q[:, 3:], rtol=1e-10)


def test_variance_is_that_of_the_bound_and_intervals_cover():
    rng = np.random.default_rng(11)
    freq = np.linspace(400.0, 5000.0, 3000)
    q = smooth_motion(rng, freq)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(three_beams(), (9, 1))
    sd = 1e-9 * 10.0 ** rng.uniform(-1.0, 1.0, (27, 1)) * np.ones(3000)
    value = readings(places, beams, q) + sd * (rng.normal(size=(27, 3000, 2)) @ [1.0, 1j])
    found = fit_lines(beam_set("s", places, beams, DOF_NAMES), value, sd)
    arms = places * 1e-3
    matrix = np.hstack([beams, np.cross(arms, beams)])
    bound = np.linalg.inv((matrix / sd[:, :1] ** 2).T @ matrix)
    error = found.q - q
    ratio = np.mean(np.concatenate([error.real, error.imag]) ** 2, axis=0) / np.diag(bound)
    assert np.all(np.abs(ratio - 1.0) < 0.08)
    claimed = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2) / 2.0)
    covered = np.mean(np.abs(np.concatenate([error.real, error.imag])) < 1.96 * np.concatenate([claimed] * 2))
    assert 0.94 < covered < 0.96
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance[0]), error.T)
    assert np.allclose(whitened @ whitened.conj().T / 3000, np.eye(6), atol=0.08)
    plain = fit_lines(found.beams, value, np.ones_like(sd)).q - q
    assert np.mean(np.abs(plain) ** 2) > 1.5 * np.mean(np.abs(error) ** 2)


def test_chi2_raises_five_alarms_in_a_hundred():
    from scipy.special import chdtrc

    alarms = []
    for seed in range(8):
        found = fitted(scene(seed, lines=500))
        assert np.all(found.n_dof == 2 * (27 - 6))
        alarms.append(chdtrc(found.n_dof, found.chi2) < 0.05)
    assert np.mean(alarms) == pytest.approx(0.05, abs=0.011)


@pytest.mark.parametrize(("kind", "clean", "dirty"), [("huber", 1.06, 1.7), ("t4", 1.16, 1.6)])
def test_robust_fits_resist_outliers_and_say_what_they_cost(kind, clean, dirty):
    made = scene(21, lines=1500)
    plain = fitted(made)
    truth = made.q
    scale = np.sqrt(np.mean(np.diagonal(plain.covariance, axis1=1, axis2=2), axis=0))

    def loss(found):
        return float(np.mean(np.abs((found.q - truth) / scale) ** 2))

    robust = fitted(made, robust=kind)
    assert loss(robust) < clean * loss(plain)
    stated = np.mean(np.diagonal(robust.covariance, axis1=1, axis2=2) / scale**2)
    assert stated == pytest.approx(loss(robust) / loss(plain), abs=0.05)
    rng = np.random.default_rng(1)
    hit = rng.random(made.value.shape) < 0.05
    made.value[hit] += (30.0 * made.sd * (rng.normal(size=(*hit.shape, 2)) @ [1.0, 1j]))[hit]
    found = fitted(made, robust=kind)
    assert loss(found) < dirty
    assert loss(fitted(made)) > 5.0 * loss(found)
    claimed = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2) / 2.0)
    covered = np.mean(np.abs((found.q - truth).real) < 1.96 * claimed)
    assert 0.93 < covered < 0.97


def test_missing_channels_cost_only_themselves():
    made = scene(8, lines=20)
    whole = fitted(made)
    holes = made.value.copy()
    holes[4, 3] = holes[11, 3] = holes[20, 7] = np.nan
    made.value = holes
    found = fitted(made)
    same = [k for k in range(20) if k not in (3, 7)]
    assert np.allclose(found.q[same], whole.q[same], rtol=1e-12)
    assert found.n_dof[[3, 7, 0]].tolist() == [38, 40, 42]
    keep = [c for c in range(27) if c not in (4, 11)]
    beams = beam_set("s", made.positions_mm[keep], made.directions[keep], DOF_NAMES)
    alone = fit_lines(beams, holes[keep][:, [3]], made.sd[keep][:, [3]])
    assert np.allclose(found.q[3], alone.q[0], rtol=1e-10)
    assert np.allclose(found.covariance[3], alone.covariance[0], rtol=1e-8)


def test_lines_with_too_few_channels_stay_empty():
    made = scene(8, lines=6)
    made.value[5:, 2] = np.nan
    result = points2dof(measurement(body("stapes", made), freq_hz=made.freq_hz))
    assert np.isnan(result.motion.q[0, 0, 2]).all()
    assert np.isfinite(result.motion.q[0, 0, [0, 1, 3]]).all()
    assert "lines_undetermined" in [notice.code for notice in result.notices]


def refusal(places, beams, dof=DOF_NAMES):
    with pytest.raises(StapeskitError) as caught:
        beam_set("stapes", places, beams, dof)
    return str(caught.value)


def test_unobservable_motions_are_named():
    line = np.repeat(np.outer([0.0, 1.0, 2.0], [1.0, 0.0, 0.0]), 3, axis=0)
    axes = np.tile(np.eye(3), (3, 1))
    text = refusal(line, axes)
    assert "unobservable: rotation about the x axis" in text
    assert "Choose --dof x,y,z,beta,gamma" in text
    turn = rotation_from_vector([0.0, 0.0, 0.6435011])
    assert "rotation about (0.800, 0.600, 0.000)" in refusal(line @ turn.T, axes @ turn.T)
    assert "alpha" in refusal(line, axes, PAPER_DOF)
    one_way = np.tile([0.0, 1.0, 0.0], (9, 1))
    text = refusal(np.random.default_rng(0).normal(size=(9, 3)), one_way)
    assert "translation along the x axis" in text
    assert "translation along the z axis" in text
    assert "rotation about the y axis" in text
    assert "--dof y,alpha,gamma" in text
    assert "2 beams" in refusal(line[:2], axes[:2])
    assert len(unseen_motions(line, axes)) == 1
    assert unseen_motions(np.random.default_rng(0).normal(size=(9, 3)), np.tile(three_beams(), (3, 1))) == []


@given(st.integers(0, 100), st.floats(-4.0, 0.0))
@settings(max_examples=40)
def test_points_near_a_line_are_seen_as_such(seed, log_width):
    rng = np.random.default_rng(seed)
    width = 10.0**log_width
    places = np.outer(np.arange(5.0), [1.0, 0.0, 0.0]) + width * rng.normal(size=(5, 3)) * [0, 1, 1]
    arms, beams = np.repeat(places, 3, axis=0) * 1e-3, np.tile(np.eye(3), (5, 1))
    weakest = observability(arms, beams, DOF_NAMES)[-1]
    assert weakest < 3.0 * width
    if weakest > 10 * UNOBSERVABLE:
        q = rng.normal(size=(1, 6)) * [1, 1, 1, 1e3, 1e3, 1e3] + 0j
        made = beam_set("s", places.repeat(3, axis=0), beams, DOF_NAMES)
        found = fit_lines(made, readings(places.repeat(3, axis=0), beams, q), np.ones((15, 1)))
        assert np.allclose(found.q, q, rtol=1e-7 / width, atol=1e-9 / width)


def test_a_distant_reference_point_hides_nothing():
    made = scene(2, lines=3, snr=np.inf)
    far = made.positions_mm + np.array([0.0, 0.0, 600.0])
    strength = observability(far * 1e-3, made.directions, DOF_NAMES)
    assert np.allclose(strength, observability(made.positions_mm * 1e-3, made.directions, DOF_NAMES))
    beam_set("s", far, made.directions, DOF_NAMES)


def test_noise_is_estimated_from_residuals():
    made = scene(31, lines=400, snr=50.0)
    w = 2.0 * np.pi * made.freq_hz
    level = 3e-6
    rng = np.random.default_rng(2)
    clean = readings(made.positions_mm, made.directions, made.q)
    made.value = clean + level / w * (rng.normal(size=(27, 400, 2)) @ [1.0, 1j])
    result = points2dof(measurement(body("stapes", made, sd=False), freq_hz=made.freq_hz, order=1))
    found = np.array([result.fits[0, 0].sd[0, k] * w[k] for k in range(400)])
    assert np.all(np.abs(found / level - 1.0) < 0.15)
    error = result.motion.q[0, 0] - made.q
    covered = np.mean(np.abs(error.real) < 1.96 * standard_deviation(result.motion)[0, 0])
    assert 0.93 < covered < 0.97
    assert "noise_estimated" in [notice.code for notice in result.notices]
    assert [v.verdict for v in result.channels] == ["ok"] * 27


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_noise_that_nobody_states_is_told_apart_by_laser(times):
    """A vibrometer that reports x, y, z of beams near its axis is several times as noisy across it."""
    made = scene(31, lines=200, snr=50.0)
    w, rng = 2.0 * np.pi * made.freq_hz, np.random.default_rng(4)
    level = 3e-6 * np.where(np.arange(27) % 3 == 0, times, 1.0)[:, None]
    clean = readings(made.positions_mm, made.directions, made.q)
    made.value = clean + level / w * (rng.normal(size=(27, 200, 2)) @ [1.0, 1j])
    result = points2dof(measurement(body("stapes", made, sd=False), freq_hz=made.freq_hz, order=1))
    found = np.sqrt(np.mean((result.fits[0, 0].sd * w) ** 2, axis=1))
    assert np.all(np.abs(found / level[:, 0] - 1.0) < 0.15)
    error = result.motion.q[0, 0] - made.q
    covered = np.mean(np.abs(error.real) < 1.96 * standard_deviation(result.motion)[0, 0])
    assert 0.93 < covered < 0.97
    assert [v.verdict for v in result.channels] == ["ok"] * 27


def test_relative_noise_weighs_and_is_scaled():
    made = scene(32, lines=300)
    n_avg = np.where(np.arange(27) % 3 == 0, 100.0, 1.0)
    rng = np.random.default_rng(3)
    clean = readings(made.positions_mm, made.directions, made.q)
    noise = 2e-9 / np.sqrt(n_avg)[:, None] * np.ones(300)
    made.value = clean + noise * (rng.normal(size=(27, 300, 2)) @ [1.0, 1j])
    relative = np.broadcast_to(1.0 / np.sqrt(n_avg)[:, None], clean.shape)
    channels = BodyChannels(
        "stapes", made.points, made.positions_mm, made.directions, made.value[None], relative[None], True
    )
    result = points2dof(Measurement("footplate", ("1",), made.freq_hz, (channels,), 0))
    assert np.allclose(result.fits[0, 0].sd / noise, 1.0, atol=0.15)


def test_as_many_channels_as_motions_leave_the_noise_unknown():
    made = scene(33, lines=10)
    channels = body("stapes", made, sd=False)
    pick = [0, 4, 13, 19, 23, 26]
    channels = BodyChannels(
        "stapes",
        tuple(made.points[c] for c in pick),
        made.positions_mm[pick],
        made.directions[pick],
        channels.displacement[:, pick],
    )
    result = points2dof(Measurement("footplate", ("1",), made.freq_hz, (channels,), 0))
    assert "noise_unknown" in [notice.code for notice in result.notices]
    assert np.isnan(standard_deviation(result.motion)).all()
    assert np.isfinite(result.motion.q).all()


def test_zero_sd_has_a_floor():
    made = scene(34, lines=10, snr=np.inf)
    result = points2dof(measurement(body("stapes", made), freq_hz=made.freq_hz))
    assert np.allclose(result.motion.q[0, 0], made.q, rtol=1e-9, atol=1e-20)
    assert np.all(standard_deviation(result.motion) > 0.0)
    assert [v.verdict for v in result.channels] == ["ok"] * 27


def tilted(angle_deg, q, count=9):
    """A vibrometer with one beam direction, tilted about z."""
    rng = np.random.default_rng(7)
    places = stapes_points(rng, count)
    angle = np.radians(angle_deg)
    beams = np.tile([np.sin(angle), np.cos(angle), 0.0], (count, 1))
    return places, beams, readings(places, beams, q)


@pytest.mark.parametrize("angle", [15.0, 30.0, 45.0])
def test_a_tilted_single_beam_neglects_motion_and_says_so(angle):
    freq = np.linspace(400.0, 5000.0, 50)
    q = np.zeros((50, 6), dtype=complex)
    q[:, 1], q[:, 0] = 1e-7, 2e-8
    places, beams, value = tilted(angle, q)
    parts = {"points": [str(k) for k in range(9)], "positions_mm": places, "directions": beams}
    data = from_arrays({"stapes": {**parts, "value": value, "sd": 1e-11}}, freq, order=0)
    result = points2dof(data, options=Options(PAPER_DOF))
    text = next(notice.text for notice in result.notices if notice.code == "neglected_motion")
    assert "cannot tell x from the fitted motion" in text
    leak = np.tan(np.radians(angle)) * 100.0
    assert f"{leak:.0f} % of it enters y" in text
    bias = np.abs(result.motion.q[0, 0, :, 0] / 1e-7 - 1.0)
    assert np.allclose(bias, 0.2 * np.tan(np.radians(angle)), rtol=1e-6)
    assert np.nanmax(result.motion.chi2) < 1e-6 * result.motion.n_dof.max()
    assert {v.verdict for v in result.channels} == {"ok"}


def test_a_straight_single_beam_neglects_nothing():
    freq = np.linspace(400.0, 5000.0, 50)
    q = smooth_motion(np.random.default_rng(1), freq)
    places, beams, value = tilted(0.0, q)
    parts = {"points": [str(k) for k in range(9)], "positions_mm": places, "directions": beams}
    data = from_arrays({"stapes": {**parts, "value": value, "sd": 1e-10}}, freq, order=0)
    result = points2dof(data, options=Options(PAPER_DOF))
    assert [notice.code for notice in result.notices] == []


def test_a_subset_of_oblique_beams_neglects_measured_motion_and_says_so():
    made = scene(12, lines=60)
    leaning = made.directions @ rotation_from_vector([0.0, 0.0, np.radians(25.0)]).T
    noise = made.value - readings(made.positions_mm, made.directions, made.q)
    value = readings(made.positions_mm, leaning, made.q) + noise
    channels = BodyChannels("stapes", made.points, made.positions_mm, leaning, value[None], made.sd[None])
    result = points2dof(
        Measurement("footplate", ("1",), made.freq_hz, (channels,), 0), options=Options(PAPER_DOF)
    )
    texts = [notice.text for notice in result.notices if notice.code == "neglected_motion"]
    assert len(texts) == 1
    assert "measured motion in x, z, beta is left out" in texts[0]
    assert {v.verdict for v in result.channels} == {"ok"}
    full = points2dof(Measurement("footplate", ("1",), made.freq_hz, (channels,), 0))
    assert full.notices == ()


def test_subset_columns_follow_the_order_of_the_names():
    made = scene(13, lines=4, snr=np.inf, q=np.zeros((4, 6)) + np.array([0, 1e-7, 0, 2e-5, 0, 3e-5]))
    found = fitted(made, PAPER_DOF, sd=np.full(made.value.shape, 1e-10))
    assert np.allclose(found.q, [1e-7, 2e-5, 3e-5])


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Options(robust="median"), "--robust must be one of none, huber, t4"),
        (lambda: Options(("gamma", "y")), "dof must be names in the order"),
        (lambda: Options(()), "dof must be names in the order"),
    ],
)
def test_faulty_options_are_refused(make, match):
    with pytest.raises(StapeskitError, match=match):
        make()


def test_faulty_measurements_are_refused():
    made = scene(1, lines=4)
    good = body("stapes", made)
    with pytest.raises(StapeskitError, match="positions_mm of body a must be"):
        BodyChannels("a", good.points, good.positions_mm[:3], good.directions, good.displacement)
    with pytest.raises(StapeskitError, match="beam directions of body a must be unit vectors"):
        BodyChannels("a", good.points, good.positions_mm, 2.0 * good.directions, good.displacement)
    with pytest.raises(StapeskitError, match="the data of body stapes must be of shape"):
        Measurement("footplate", ("1", "2"), made.freq_hz, (good,))
    with pytest.raises(StapeskitError, match="freq_hz must be positive and ascending"):
        Measurement("footplate", ("1",), made.freq_hz[::-1], (good,))
    with pytest.raises(StapeskitError, match="a measurement must be of at least one body"):
        Measurement("footplate", ("1",), made.freq_hz, ())


def test_mirrored_coordinates_are_turned_round():
    made = scene(14, lines=4)
    data = measurement(body("stapes", made), freq_hz=made.freq_hz)
    sign = np.array([1.0, -1.0, 1.0])
    turned = replace(made, positions_mm=made.positions_mm * sign, directions=made.directions * sign)
    flipped = measurement(body("stapes", turned), freq_hz=made.freq_hz)
    assert np.allclose(points2dof(flipped.mirrored("y")).motion.q, points2dof(data).motion.q)

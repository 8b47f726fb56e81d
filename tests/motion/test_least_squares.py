"""The fit at many lines: exact data, its bound, coverage, gaps, and robust estimates that state their sd."""

from dataclasses import replace

import numpy as np
import pytest

from kinematics.fit.beams import beam_set
from kinematics.fit.lsq import solve
from kinematics.fit.noise import fit_with_noise
from kinematics.fit.rigid_fit import fit_lines
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.faults import StapeskitError
from stapeskit.spatial import DOF_NAMES
from tests.motion.bodies import as_measurement, fitted, recorded


def noise_of(rng, shape):
    """Return noise whose real and imaginary parts have unit variance."""
    return rng.normal(size=(*shape, 2)).view(complex)[..., 0]


def basis_of(rng, points, beams=3):
    """Return orthonormal rows (c, m) of random points: six motions of 3D beams, three of parallel ones."""
    places = rng.uniform(-1.0, 1.0, (points, 3)) * [1.0, 0.3, 0.7]
    if beams == 1:
        rows = np.column_stack([np.ones(points), places[:, 2], -places[:, 0]])
    else:
        directions = np.tile(np.eye(3), (points, 1))
        rows = np.hstack([directions, np.cross(np.repeat(places, 3, axis=0), directions)])
    return np.linalg.svd(rows, full_matrices=False)[0]


def test_exact_data_give_the_true_motion():
    recording = recorded(1, exact=True)
    _body, (fit,) = fitted(as_measurement(recording, stated=False))
    truth = recording.motion_m["stapes"][0]
    assert np.max(np.abs(fit.q - truth) / np.abs(truth).max(axis=0)) < 1e-12
    assert np.all(np.isfinite(fit.covariance))


@pytest.mark.parametrize("case", ["equal", "channels", "values", "gaps", "one channel dead", "block of gaps"])
def test_mean_squares_reach_the_bound_and_intervals_cover(case):
    rng = np.random.default_rng(5)
    basis, lines = basis_of(rng, 9), 6000
    shape = {"channels": (27, 1), "values": (27, lines)}.get(case, (1, 1))
    sd = 10.0 ** rng.uniform(-0.5, 0.5, shape) if case in ("channels", "values") else np.ones((1, 1))
    truth = noise_of(rng, (6, lines)) * 100.0
    value = basis @ truth + sd * noise_of(rng, (27, lines))
    if case == "gaps":
        value[rng.random(value.shape) < 0.1] = np.nan
    if case == "one channel dead":
        value[3] = np.nan
    if case == "block of gaps":
        value[5, 1000:4000] = np.nan
    fit = solve(basis, value, sd)
    error = fit.z - truth
    inverse = np.linalg.inv(fit.covariance)
    ratio = np.einsum("il,lij,jl->l", error.conj(), inverse, error).real / 6
    assert abs(np.mean(ratio) - 1.0) < 4.0 / np.sqrt(6 * lines)
    spread = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2).T / 2.0)
    inside = np.mean([np.abs(error.real) < 1.96 * spread, np.abs(error.imag) < 1.96 * spread])
    assert abs(inside - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / (12 * lines))
    freedom = 2 * (np.isfinite(value).sum(axis=0) - 6)
    assert abs(np.sum(fit.chi2) / np.sum(freedom) - 1.0) < 4.0 * np.sqrt(2.0 / np.sum(freedom))
    energy = np.nansum(np.abs((value - basis @ fit.z) / sd) ** 2, axis=1)
    known = fit.freedom > 0.0
    assert np.max(np.abs(energy[known] / fit.freedom[known] - 1.0)) < 6.0 * np.sqrt(2.0 / lines)


@pytest.mark.parametrize("seed", [40, 42])
def test_noise_of_channels_that_differ_is_found_from_the_residuals(seed):
    """Quiet channels with much leverage among them: weights that err change what columns hold no motion."""
    recording, rng = recorded(seed, lines=3000, exact=True), np.random.default_rng(seed)
    measured = as_measurement(recording, stated=False)
    value = measured.bodies[0].value
    sd = 0.01 * np.sqrt(np.mean(np.abs(value) ** 2)) * 10.0 ** rng.uniform(-0.5, 0.5, (27, 1))
    body = replace(measured.bodies[0], value=value + sd * noise_of(rng, value.shape))
    _body, (fit,) = fitted(replace(measured, bodies=(body,)))
    error = fit.q - recording.motion_m["stapes"][0]
    ratio = np.mean(np.abs(error) ** 2, axis=0) / np.diagonal(fit.covariance, axis1=1, axis2=2).mean(axis=0)
    assert np.all((ratio > 0.85) & (ratio < 1.15))


def test_noise_of_a_line_scales_its_fit():
    _body, (fit,) = fitted(as_measurement(recorded(1)))
    factor = 10.0 ** np.random.default_rng(4).uniform(-1.0, 1.0, fit.value.shape[1])
    own = fit_lines(fit.beams, fit.value, fit.sd, fit.per_displacement, factor=factor)
    scaled = fit.with_line_noise(factor)
    for name in ("q", "covariance", "chi2"):
        np.testing.assert_allclose(getattr(scaled, name), getattr(own, name), rtol=1e-6, err_msg=name)


def test_lines_with_weights_of_their_own_agree_with_a_plain_solver():
    rng = np.random.default_rng(2)
    basis = basis_of(rng, 4)
    sd = 10.0 ** rng.uniform(-3, 3, (12, 40))
    value = noise_of(rng, (12, 40))
    value[rng.random(value.shape) < 0.15] = np.nan
    fit = solve(basis, value, sd)
    for line in range(40):
        used = np.isfinite(value[:, line])
        rows = basis[used] / sd[used, line, None]
        want = np.linalg.lstsq(rows, value[used, line] / sd[used, line], rcond=None)[0]
        if fit.good[line]:
            assert np.linalg.norm(fit.z[:, line] - want) < 1e-5 * np.linalg.norm(want)
    assert np.count_nonzero(fit.good) > 30


def test_lines_that_do_not_determine_the_motion_are_missing():
    rng = np.random.default_rng(3)
    value = noise_of(rng, (9, 30))
    value[4:, 7] = value[:, 21] = np.nan
    fit = solve(basis_of(rng, 3), value, np.ones((1, 1)))
    assert np.flatnonzero(~fit.good).tolist() == [7, 21]
    assert np.isnan(fit.z[:, [7, 21]]).all()
    assert np.isnan(fit.chi2[[7, 21]]).all()


@pytest.mark.parametrize("kind", ["huber", "t4"])
@pytest.mark.parametrize(("points", "beams"), [(3, 3), (4, 3), (5, 1)])
def test_robust_estimates_of_few_points_state_their_sd(kind, points, beams):
    ratios = []
    for draw in range(20):
        rng = np.random.default_rng([draw, points])
        basis = basis_of(rng, points, beams)
        fit = solve(basis, noise_of(rng, (len(basis), 300)), np.ones((1, 1)), kind)
        stated = np.mean(np.diagonal(fit.covariance, axis1=1, axis2=2), axis=0)
        ratios.append(np.sqrt(stated / np.mean(np.abs(fit.z) ** 2, axis=1)))
    assert np.min(ratios) > 0.8
    assert np.max(ratios) < 1.3


@pytest.mark.parametrize("kind", ["huber", "t4"])
def test_robust_estimates_withstand_outliers(kind):
    rng = np.random.default_rng(4)
    basis = basis_of(rng, 12)
    noise = noise_of(rng, (36, 800))
    noise[rng.random(noise.shape) < 0.05] *= 30.0
    fit = solve(basis, noise, np.ones((1, 1)), kind)
    plain = solve(basis, noise, np.ones((1, 1)))
    variance = np.mean(np.abs(fit.z) ** 2)
    assert variance < 0.15 * np.mean(np.abs(plain.z) ** 2)
    stated = np.mean(np.diagonal(fit.covariance, axis1=1, axis2=2))
    assert 0.8**2 < stated / variance < 1.3**2


@pytest.mark.parametrize("kind", ["huber", "t4"])
def test_robust_estimates_find_the_noise_next_to_large_drop_outs(kind):
    """Thousands of sd large: the levels of channels and lines followed them, and the motion was lost."""
    recording = recorded(3, points=8, lines=60)
    value = recording.velocity_m_s.copy()
    far = np.random.default_rng(3).random(value.shape) < 0.02
    value[far] *= -30.0
    _, (fit,) = fitted(as_measurement(replace(recording, velocity_m_s=value), stated=False), robust=kind)
    sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2) / 2.0)
    pulls = np.abs(fit.q - recording.motion_m["stapes"][0]) / sd
    assert 0.8 < np.mean(pulls**2) / 2.0 < 1.3
    assert np.median(fit.factor) * fit.sd[0, 0] == pytest.approx(recording.sd_m_s[0, 0, 0], rel=0.15)


@pytest.mark.parametrize(("points", "lines"), [(9, 12), (9, 24)])
def test_few_lines_without_stated_noise_state_their_sd(points, lines):
    """Weights that are estimated from few values cost as much again in the covariance made with them."""
    ratios = []
    for seed in range(60):
        recording = recorded(1000 + seed, points=points, lines=lines)
        _body, (fit,) = fitted(as_measurement(recording, stated=False))
        error = fit.q - recording.motion_m["stapes"][0]
        distance = np.einsum("li,lij,lj->l", error.conj(), np.linalg.inv(fit.covariance), error).real
        ratios.append(np.mean(distance) / 6.0)
    # known to 1 %; 1.05 to 1.08 without that cost
    assert np.sqrt(np.mean(ratios)) == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize("kind", ["none", "huber"])
def test_noise_that_is_not_stated_is_estimated_in_its_size(kind):
    """27 channels at 120 lines: 5000 residuals know the level to 1 %, their median to 1.5 %."""
    exact = recorded(4, exact=True)
    rng = np.random.default_rng(8)
    sd = 0.02 * float(np.sqrt(np.mean(np.abs(exact.velocity_m_s) ** 2)))
    noise = sd * noise_of(rng, exact.velocity_m_s.shape)
    loud = as_measurement(replace(exact, velocity_m_s=exact.velocity_m_s + noise), stated=False)
    _, (fit,) = fitted(loud, robust=kind)
    assert np.median(fit.sd * fit.factor) == pytest.approx(sd, rel=0.05)


def test_channels_of_unlike_noise_get_their_weights_where_none_is_stated():
    """The error is that of true weights within a tenth, where equal weights lose a factor."""
    squares = []
    for seed in range(6):
        recording = recorded(seed, lines=150, noise_spread=(0.3, 3.0))
        _, (known,) = fitted(as_measurement(recording))
        _, (fit,) = fitted(as_measurement(recording, stated=False))
        size = np.diagonal(known.covariance, axis1=1, axis2=2)
        error = fit.q - recording.motion_m["stapes"][0]
        spread = np.diagonal(fit.covariance, axis1=1, axis2=2)
        squares.append((np.mean(np.abs(error) ** 2 / size), np.mean(np.abs(error) ** 2 / spread)))
    assert np.mean(squares, axis=0) == pytest.approx([1.05, 1.0], abs=0.1)


@pytest.mark.parametrize("level_lines", [2000, 60])
def test_lines_at_which_a_body_was_not_measured_leave_the_others_as_they_are(level_lines, monkeypatch):
    """Levels of channels come from lines that have values, however many are skipped."""
    monkeypatch.setattr("kinematics.fit.noise._LEVEL_LINES", level_lines)
    recording = recorded(7, lines=120, noise_spread=(0.3, 3.0))
    whole = as_measurement(recording, stated=False)
    (body,) = whole.bodies
    value = body.value.copy()
    value[..., ::2] = np.nan
    _, (holed,) = fitted(replace(whole, bodies=(replace(body, value=value),)))
    alone = replace(body, value=body.value[..., 1::2])
    _, (dense,) = fitted(replace(whole, freq_hz=whole.freq_hz[1::2], bodies=(alone,)))
    assert np.allclose(holed.q[1::2], dense.q, rtol=1e-9, atol=0.0)
    assert np.allclose(holed.covariance[1::2], dense.covariance, rtol=0.1, atol=0.0)


def _of_noise(channels, dof):
    """Return a body without motion and without stated noise, its points in 3D or all seen along y."""
    rng, count = np.random.default_rng(1), channels if len(dof) == 3 else channels // 3
    beams = np.tile([[0.0, 1.0, 0.0]], (channels, 1)) if len(dof) == 3 else np.tile(np.eye(3), (count, 1))
    places = np.repeat(rng.uniform(-2e-3, 2e-3, (count, 3)), channels // count, axis=0)
    names = tuple(str(channel * count // channels) for channel in range(channels))
    body = BodyChannels("stapes", names, places, beams, 1e-9 * noise_of(rng, (channels, 80))[None])
    placed = Measurement("footplate", ("1",), np.linspace(400.0, 5000.0, 80), (body,), "displacement")
    return placed, body, beam_set("stapes", body.arms_m, beams, dof)


@pytest.mark.parametrize("kind", ["huber", "t4"])
@pytest.mark.parametrize(("channels", "dof"), [(5, ("y", "alpha", "gamma")), (9, DOF_NAMES)])
def test_noise_of_robust_fits_of_few_points_is_found(kind, channels, dof):
    """The motion takes most of the noise of few channels: a start that forgets it is 5 times too low."""
    placed, body, beams = _of_noise(channels, dof)
    fit, _ = fit_with_noise(placed, 0, body, beams, kind)
    sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2).real / 2.0)
    assert np.sqrt(np.mean(np.abs(fit.q / sd) ** 2) / 2.0) < 2.0


def test_a_robust_fit_with_one_spare_channel_and_unknown_noise_is_refused():
    placed, body, beams = _of_noise(4, ("y", "alpha", "gamma"))
    with pytest.raises(StapeskitError):
        fit_with_noise(placed, 0, body, beams, "huber")

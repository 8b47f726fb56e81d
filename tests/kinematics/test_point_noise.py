"""Noise that x, y, z solved from oblique beams have in common is no flexibility; faults are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import bound
from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged as run
from kinematics.faults.fault_kinds import drift, gain, position
from kinematics.faults.fault_model import fit_fault, solve, static
from kinematics.faults.packed.compact import compact
from kinematics.faults.packed.mixing import Mixing, block_covariance, by_chance, scaled
from kinematics.faults.refit import Others, Places, Refit
from kinematics.faults.score_tests import ScoreTests, axes_batch, batches
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from kinematics.points2dof import points2dof
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, measurement, scene


def solved(made, seed, spread=0.5):
    """Return a scene as x, y, z of its points, whose three beams have noise of different size."""
    rng = np.random.default_rng([seed, 71])
    louder = np.exp(rng.uniform(0.0, spread, len(made.sd)))[:, None]
    noise = rng.normal(size=(*made.value.shape, 2)) @ np.array([1.0, 1j])
    value = made.value + made.sd * np.sqrt(louder**2 - 1.0) * noise
    inverse = np.linalg.inv(made.directions[:3])
    count = len(made.points) // 3
    value = np.concatenate([inverse @ value[3 * k : 3 * k + 3] for k in range(count)])
    variance = (made.sd * louder) ** 2
    sd = np.concatenate([np.sqrt(inverse**2 @ variance[3 * k : 3 * k + 3]) for k in range(count)])
    return replace(made, value=value, sd=sd, directions=np.tile(np.eye(3), (count, 1)))


def verdicts(made, sd):
    result = points2dof(measurement(body("stapes", made, sd=sd), freq_hz=made.freq_hz))
    return {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}


@pytest.mark.parametrize("sd", [True, False])
def test_clean_coordinates_solved_from_oblique_beams_raise_no_alarm(sd):
    alarms = [verdicts(solved(scene(700 + seed), seed), sd) for seed in range(8)]
    assert sum(map(bool, alarms)) == 0


@pytest.mark.parametrize("fault", ["flexible", "position", "label_swap"])
def test_faults_are_found_in_coordinates_solved_from_oblique_beams(fault):
    for seed in (720, 721):
        made = solved(scene(seed, fault), seed)
        assert verdicts(made, False) == dict.fromkeys(made.culprits, fault)


def test_faults_of_single_columns_are_found_in_them():
    made = solved(scene(730), 730)
    made.value[7] *= 1.05
    assert verdicts(made, False) == {7: "gain"}
    made.value[7] *= -1.0 / 1.05
    assert verdicts(made, False) == {7: "sign"}


def test_one_loud_channel_is_no_noise_in_common():
    for seed in range(2000, 2004):
        made = drawn(seed, "footplate, 5 points 3D", "noise x4")
        result = run(made, seed)
        wrong = {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}
        assert wrong in ({}, dict.fromkeys(made.culprits, "noise"))
        assert wrong or bound(made) < 0.999


def correlation(count, seed=1):
    rng = np.random.default_rng(seed)
    whole = np.eye(count)
    for k in range(0, count, 3):
        held = rng.normal(size=(3, 6))
        held = held @ held.T
        sd = np.sqrt(np.diag(held))
        whole[k : k + 3, k : k + 3] = held / np.outer(sd, sd)
    return whole


def mixed(seed, change=1.0, channel=4):
    """Return packed data whose noise has a known correlation within points."""
    made = scene(seed)
    rng = np.random.default_rng([seed, 73])
    whole = correlation(27)
    noise = rng.normal(size=(*made.value.shape, 2)) @ np.array([1.0, 1j])
    rows = np.hstack([made.directions, np.cross(made.positions_mm * 1e-3, made.directions)])
    made.value = rows @ made.q.T + made.sd * (np.linalg.cholesky(whole) @ noise)
    made.value[channel] *= change
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    data = compact(fit, body("stapes", made), made.freq_hz)
    return replace(data, mixing=Mixing.of(whole, data.live)).repacked()


def test_whitening_undoes_a_correlation_and_keeps_to_the_channels_in_use():
    whole = correlation(6)
    mixing = Mixing.of(whole, [0, 1, 3, 4, 5])
    held = whole.copy()
    held[2, :] = held[:, 2] = 0.0
    held[2, 2] = 1.0
    np.testing.assert_allclose(mixing.whiten @ held @ mixing.whiten.T, np.eye(6), atol=1e-12)
    np.testing.assert_allclose(mixing.whiten @ mixing.back, np.eye(6), atol=1e-12)


def test_covariance_within_points_is_found_behind_a_projection():
    rng = np.random.default_rng(5)
    count = 27
    size = np.tile([1.0, 1.5, 2.0], 9)
    whole = correlation(count)
    noise = rng.normal(size=(count, 40_000, 2)) @ np.array([1.0, 1j]) / np.sqrt(2.0)
    noise = size[:, None] * (np.linalg.cholesky(whole) @ noise)
    span, _ = np.linalg.qr(rng.normal(size=(count, 6)))
    project = np.eye(count) - span @ span.T
    points, live = tuple("aaabbbcccdddeeefffggghhhiii"), list(range(count))
    made, sd = scaled(block_covariance(project @ noise, project, points, live))
    np.testing.assert_allclose(sd, size, rtol=0.1)
    np.testing.assert_allclose(made, whole, atol=0.1)
    assert not by_chance(made, np.ones(count), points, live, 40_000)
    assert by_chance(np.eye(count), np.ones(count), points, live, 40_000)
    assert block_covariance(noise[:, :10], project, points, live) is None


def test_scores_under_common_noise_are_chi_squared():
    found: dict[str, list[float]] = {}
    for seed in range(12):
        data = mixed(740 + seed)
        tests = ScoreTests(solve(data), Places())
        groups = [list(range(3 * k, 3 * k + 3)) for k in range(9)]
        for batch in [*batches(tests, list(range(27)), groups, []), axes_batch(tests)]:
            held = tests.run(batch)
            found.setdefault(f"{batch.owner} {batch.kind}", []).extend(held.statistic / held.freedom)
    for name in ("channel gain", "channel direction", "point position"):
        assert np.mean(found[name]) == pytest.approx(1.0, abs=0.3)


def test_score_and_refit_agree_under_common_noise():
    data = mixed(760, 1.006)
    tests = ScoreTests(solve(data), Places())
    found = next(t for t in map(tests.run, batches(tests, [4], [], [])) if t.batch.kind == "gain")
    flat = static(data)
    before = float(np.sum(np.abs(solve(flat).e) ** 2))
    fit, _ = fit_fault(flat, Places(), gain([4]), before)
    assert 2.0 * fit.drop == pytest.approx(found.statistic[0], rel=0.05)
    assert 1.0 / found.information[0, 0, 0] == pytest.approx(fit.covariance[0, 0], rel=0.05)


@pytest.mark.parametrize("kind", ["gain", "drift", "position"])
def test_gathered_channels_give_the_same_fit(kind):
    made = scene(23, "gain")
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    data = compact(fit, body("stapes", made), made.freq_hz)
    channels = [3, 4, 5]
    fault = position(data, channels) if kind == "position" else {"gain": gain, "drift": drift}[kind](channels)
    theta = 0.01 * fault.scale
    whole = Refit(data, Places(), fault, theta, np.zeros((0, 3)))
    few = Refit(data, Places(), fault, theta, np.zeros((0, 3)), Others.of(data, channels))
    assert few.objective == pytest.approx(whole.objective, rel=1e-9)
    for one, two in zip(few.step(), whole.step(), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-9 * np.max(np.abs(two)))


@pytest.mark.parametrize("common", [True, False])
@pytest.mark.parametrize("kind", ["gain", "drift"])
def test_steps_beside_positions_lead_to_the_least_objective(kind, common):
    """The slope of the objective vanishes where the steps end."""
    data = mixed(770, 1.02) if common else replace(mixed(770, 1.02), mixing=None).repacked()
    places = Places.of(data, np.full(27, 2e-5))
    fault = {"gain": gain, "drift": drift}[kind]([4])
    fit, shift = fit_fault(data, places, fault)
    here = Refit(data, places, fault, fit.parameters, shift).objective
    steps = [0.02 * np.sqrt(np.diag(fit.covariance)) * sign for sign in (1.0, -1.0)]
    around = [Refit(data, places, fault, fit.parameters + step, shift).objective for step in steps]
    assert abs(around[0] - around[1]) < 0.02
    moved = shift.copy()
    moved[2, 1] += 1e-7
    other = shift.copy()
    other[2, 1] -= 1e-7
    sides = [Refit(data, places, fault, fit.parameters, place).objective for place in (moved, other)]
    assert abs(sides[0] - sides[1]) < 0.02
    assert min(*around, *sides) > here - 0.01

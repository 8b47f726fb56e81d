"""Noise that x, y, z solved from oblique beams have in common is no flexibility; faults are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_bounds import bound
from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged as run
from legacy.kinematics.faults.nuisance import Marginal, Nuisance
from legacy.kinematics.faults.packed_readings import Source, initial, whitening
from legacy.kinematics.faults.point_noise import by_chance, point_covariance, scaled
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.faults.score_tests import score_tests
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.spatial import DOF_NAMES
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
        made = solved(scene(seed, fault, lines=80), seed)
        assert verdicts(made, False) == dict.fromkeys(made.culprits, fault)


def test_faults_of_single_columns_are_found_in_them():
    made = solved(scene(730, lines=80), 730)
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
    some = body("stapes", made)
    data = initial(Source.of(fit, some, made.freq_hz, True), some)
    return data.under(replace(data.assumed, correlation=whole))


def test_whitening_undoes_a_correlation_and_keeps_to_the_channels_in_use():
    whole = correlation(6)
    live = np.array([True, True, False, True, True, True])
    held = whole.copy()
    held[2, :] = held[:, 2] = 0.0
    held[2, 2] = 1.0
    made = whitening(whole, live)
    np.testing.assert_allclose(made @ held @ made.T, np.eye(6), atol=1e-12)


def test_covariance_within_points_is_found_behind_a_projection():
    data = mixed(741)
    plain = State.of(data.under(replace(data.assumed, correlation=None)))
    rng = np.random.default_rng(5)
    size, whole = np.tile([1.0, 1.5, 2.0], 9), correlation(27)
    noise = rng.normal(size=(27, 20_000, 2)) @ np.array([1.0, 1j]) / np.sqrt(2.0)
    noise = size[:, None] * (np.linalg.cholesky(whole) @ noise)
    span = plain.span[0].real
    residual = noise - span @ (span.T @ noise)
    made = point_covariance(plain, residual, 20_000)
    np.testing.assert_allclose(np.sqrt(np.diag(made)), size, rtol=0.15)
    np.testing.assert_allclose(scaled(made), whole, atol=0.15)
    assert not by_chance(plain, residual, 20_000)
    apart = rng.normal(size=(27, 2_000, 2)) @ np.array([1.0, 1j]) / np.sqrt(2.0)
    apart[4] *= 4.0
    assert by_chance(plain, apart - span @ (span.T @ apart), 2_000)
    assert point_covariance(plain, residual[:, :10], 10) is None


def test_scores_under_common_noise_are_chi_squared():
    found: dict[str, list[float]] = {}
    groups = [list(range(3 * k, 3 * k + 3)) for k in range(9)]
    places = {"channel": [[c] for c in range(27)], "point": groups, "body": [list(range(27))]}
    for seed in range(8):
        data = mixed(740 + seed)
        near = Marginal(State.of(data), Nuisance.of(data, np.zeros(len(data.points))))
        for one in score_tests(near, places):
            found.setdefault(f"{one.owner} {one.kind}", []).extend(one.statistic / one.freedom)
    for name in ("channel gain", "channel direction", "point position"):
        assert np.mean(found[name]) == pytest.approx(1.0, abs=0.3)

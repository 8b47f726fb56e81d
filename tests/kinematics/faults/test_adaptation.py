"""Faults that are corrected on request, and how far the motion can be trusted then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corrections import EXACT, errors, fitted
from benchmarks.fault_bodies import draw
from legacy import stapeskit
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.faults.adaptation import CORRECTED, LEFT_OUT, RAISED
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.options import LdvOptions
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.simulated import HEADER, body, csv_rows, scene

FIVE = "shell, 5 points, 3 heads"
FAULTS = ("gain 6 %", "sign", "position", "direction 4 deg", "names of points", "head gain 5 %")


@pytest.fixture(scope="module")
def pairs():
    """Return the clean and the corrected motion of the same motion, by fault."""
    made = {}
    for number, fault in enumerate(FAULTS):
        truth = draw(40 + number, FIVE, lines=40).twist.T
        clean = fitted(draw(40 + number, FIVE, lines=40), correct=False)
        right = fitted(draw(40 + number, FIVE, fault, lines=40), correct=True)
        made[fault] = truth, clean, right
    return made


def test_the_motion_is_as_good_as_without_the_fault(pairs):
    for truth, clean, right in pairs.values():
        assert {one.action for one in right.corrections} == {CORRECTED}
        assert not right.diagnoses[0, 0].findings
        before, after = (np.sqrt(np.mean(errors(one, truth)[0] ** 2)) for one in (clean, right))
        assert after < 1.3 * before


def test_the_motion_lies_within_its_stated_uncertainty(pairs):
    lines, mean = zip(*(errors(right, truth)[1:] for truth, _, right in pairs.values()), strict=True)
    assert 0.90 < np.mean(np.abs(lines) < 1.96) < 0.98
    assert np.mean(np.abs(mean) < 1.96) > 0.85


def test_an_estimate_is_a_shared_error_of_the_motion(pairs):
    motion = pairs["position"][2].motion
    names = [name for name in motion.shared.names if name.startswith("correction.incus.")]
    assert len(names) == 3
    places = [motion.shared.names.index(name) for name in names]
    assert np.all(np.diag(motion.shared.covariance)[places] > 0.0)
    assert np.all(np.any(motion.shared.derivatives[places] != 0.0, axis=(1, 2, 3, 4)))


def test_what_was_corrected_stays_named(pairs):
    right = pairs["gain 6 %"][2]
    (wrong,) = [v for v in right.channels if v.verdict != "ok"]
    assert wrong.verdict == "gain"
    assert wrong.estimate.endswith("; corrected")
    assert [n.code for n in right.notices if n.code in ("corrected", "channel_gain")] == ["corrected"]


def of_runs(*scenes, sd=True, position_sd_mm=np.nan):
    """Return runs of one body."""
    runs = [body("stapes", made, position_sd_mm, sd) for made in scenes]
    values = np.concatenate([one.displacement for one in runs])
    noise = np.concatenate([one.sd for one in runs]) if sd else None
    whole = replace(runs[0], displacement=values, sd=noise)
    names = tuple(str(k + 1) for k in range(len(scenes)))
    return Measurement("footplate", names, scenes[0].freq_hz, (whole,), 0)


def corrected(data):
    return points2dof(data, options=Options(lasers=EXACT, correct=True))


def test_a_position_that_two_runs_show_is_corrected_once_by_both():
    one, two = scene(3, "position", lines=30), scene(3, "position", lines=30)
    two.value[:] = two.value + 0.3 * two.sd * np.random.default_rng(1).normal(size=two.value.shape)
    alone, both = corrected(of_runs(one)), corrected(of_runs(one, two))
    (first,), (second,) = alone.corrections, both.corrections
    assert np.trace(second.covariance) < 0.7 * np.trace(first.covariance)
    assert not both.diagnoses[1, 0].findings


def test_a_stated_position_error_is_not_counted_twice():
    made = scene(4, "position", lines=30)
    exact, stated = corrected(of_runs(made)), corrected(of_runs(made, position_sd_mm=0.02))
    (one,), (two,) = exact.corrections, stated.corrections
    assert np.trace(two.covariance) < 4.0 * np.trace(one.covariance) + 0.02e-3**2
    point = made.points[made.culprits[0]]
    assert not any(name.startswith(f"position.stapes.{point}.") for name in stated.motion.shared.names)


@pytest.mark.parametrize("sd", [True, False])
def test_a_loud_channel_weighs_less(sd):
    made = scene(5, "noise", lines=60)
    right = corrected(of_runs(made, sd=sd))
    (one,) = right.corrections
    assert (one.action, one.channels) == (RAISED, made.culprits)
    weight = right.fits[0, 0].channel_weight
    assert weight[made.culprits[0]] < 0.2 * np.median(weight)


@pytest.mark.parametrize("sd", [True, False])
def test_a_channel_that_reads_nothing_is_left_out(sd):
    made = scene(7, lines=60)
    noise = np.random.default_rng(2).normal(size=(*made.value[4].shape, 2)) @ np.array([1.0, 1j])
    made.value[4] = np.broadcast_to(made.sd, made.value.shape)[4] * noise
    right = corrected(of_runs(made, sd=sd))
    (one,) = right.corrections
    assert (one.action, one.channels) == (LEFT_OUT, [4])
    assert not right.diagnoses[0, 0].findings


def test_what_two_faults_explain_alike_is_left_out():
    made = draw(0, "disc, 40 points, 1 head", lines=40)
    value = made.value.copy()
    value[7] *= np.linspace(1.0, 1.5, 40) ** 2 * np.exp(1j * np.linspace(0.0, 2.0, 40) ** 3)
    right = fitted(replace(made, value=value), correct=True)
    assert [one.action for one in right.corrections if 7 in one.channels][-1] == LEFT_OUT
    assert 7 not in {c for f in right.diagnoses[0, 0].findings for c in f.channels}


def test_sparse_outliers_are_left_out_one_by_one():
    made = scene(6, lines=100)
    rng = np.random.default_rng(2)
    far = rng.random(made.value.shape) < 0.03
    made.value[far] *= 3.0
    right = corrected(of_runs(made))
    assert [one.finding.code for one in right.corrections] == ["sparse_outliers"]
    assert np.mean(np.isnan(right.measurement.bodies[0].displacement[0][far])) > 0.8
    assert {one.action for one in right.corrections} == {CORRECTED}


def test_a_body_that_bends_is_left_as_it_is():
    right = corrected(of_runs(scene(7, "flexible", lines=60)))
    assert right.corrections == ()
    assert [finding.kind for finding in right.diagnoses[0, 0].findings] == ["flexible"]


def test_files_are_corrected_by_the_names_that_they_use(tmp_path):
    made = scene(8, "position", lines=20)
    file = tmp_path / "ldv.csv"
    file.write_text("\n".join([HEADER, *csv_rows("stapes", made)]) + "\n")
    result = stapeskit.points2dof(file, correct=True, delay_sd=0.0, phase_sd=0.0, gain_sd=0.0)
    (one,) = result.corrections
    listed = one.as_json(result.measurement)
    assert listed["points"] == [made.points[made.culprits[0]]]
    assert (listed["verdict"], listed["action"]) == ("position", CORRECTED)


def test_correction_and_calibration_exclude_each_other(tmp_path):
    with pytest.raises(KinematicsError) as caught:
        LdvOptions.of(ldv=[tmp_path / "ldv.csv"], correct=True, calibrate=True)
    assert [fault.thing for fault in caught.value.faults] == ["{correct}"]

"""Packing loses nothing, tests are calibrated; faults of lasers, beams and whole bodies are told apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import bound, measured, two_faults
from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged as run
from kinematics.faults.fault_kinds import gain
from kinematics.faults.fault_model import fit_fault, solve, static
from kinematics.faults.packed.compact import compact
from kinematics.faults.refit import Places
from kinematics.faults.score_tests import ScoreTests, batches
from kinematics.faults.search import Search
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from kinematics.points2dof import points2dof
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, measurement, scene
from tests.kinematics.test_diagnose import driven

LASERS = "stapes, 9 points, lasers at 20 deg"


def packed(made, sd=None):
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, made.value, made.sd if sd is None else sd)
    return fit, compact(fit, body("stapes", made), made.freq_hz)


def test_packed_lines_hold_all_energy_and_all_products_with_the_motion():
    made = scene(20, "gain")
    fit, data = packed(made)
    state = solve(data)
    whitened = fit.residual / (np.sqrt(2.0) * fit.sd)
    both = np.sum(np.abs(state.e) ** 2, axis=1) + np.sum(np.abs(state.rest()) ** 2, axis=1)
    np.testing.assert_allclose(both, np.sum(np.abs(whitened) ** 2, axis=1), rtol=1e-9)
    line = np.sqrt(0.5) / made.sd[0] / np.mean(np.sqrt(0.5) / made.sd[0])
    products = whitened @ (fit.solution.z * line).conj().T
    np.testing.assert_allclose(state.score(), products, atol=1e-9 * np.max(np.abs(products)))
    assert data.y.shape[1] + data.rest.shape[1] == len(made.freq_hz)


def test_packing_anew_changes_nothing_while_rows_and_weights_stay():
    _, data = packed(scene(21))
    again = solve(data.repacked())
    np.testing.assert_allclose(np.sum(np.abs(again.e) ** 2), np.sum(np.abs(solve(data).e) ** 2), rtol=1e-9)


def test_score_and_refit_agree_on_a_small_fault():
    made = scene(22)
    made.value[4] *= 1.004
    _, data = packed(made)
    tests = ScoreTests(solve(data), Places())
    found = next(t for t in map(tests.run, batches(tests, [4], [], [])) if t.batch.kind == "gain")
    flat = static(data)
    before = float(np.sum(np.abs(solve(flat).e) ** 2))
    fit, _ = fit_fault(flat, Places(), gain([4]), before)
    assert 2.0 * fit.drop == pytest.approx(found.statistic[0], rel=0.05)
    assert fit.parameters[0] == pytest.approx(0.004, abs=3.0 * np.sqrt(fit.covariance[0, 0]))
    assert 1.0 / found.information[0, 0, 0] == pytest.approx(fit.covariance[0, 0], rel=0.05)


def test_score_tests_of_clean_data_have_uniform_p_values():
    from scipy.stats import kstest

    chances: dict[str, list[float]] = {}
    for seed in range(30):
        _, data = packed(scene(3000 + seed, lines=60))
        tests = ScoreTests(solve(data), Places())
        groups = [list(range(3 * k, 3 * k + 3)) for k in range(9)]
        for batch in batches(tests, list(range(27)), groups, []):
            found = tests.run(batch)
            chances.setdefault(batch.kind, []).extend(found.p_values()[::5])
    for kind, values in chances.items():
        assert kstest(values, "uniform").pvalue > 1e-3, kind


def test_missing_values_and_uneven_noise_keep_estimates_right():
    made = scene(23, "gain")
    rng = np.random.default_rng(5)
    made.sd = made.sd * rng.uniform(0.7, 1.4, made.sd.shape)
    made.value = scene(23, "gain", snr=np.inf).value + made.sd * (
        rng.normal(size=(*made.sd.shape, 2)) @ np.array([1.0, 1j])
    )
    made.value[made.culprits[0], ::4] = np.nan
    result = points2dof(measurement(body("stapes", made), freq_hz=made.freq_hz))
    wrong = [c for c, v in enumerate(result.channels) if v.verdict != "ok"]
    assert wrong == made.culprits
    assert float(result.channels[wrong[0]].estimate.split()[1]) == pytest.approx(1.05, abs=0.01)


@pytest.mark.parametrize(
    "fault", ["laser sign", "laser gain 5 %", "beams swapped", "delay 10 us", "point sign", "axes 2 deg"]
)
def test_faults_of_lasers_beams_and_points_are_named(fault):
    made = drawn(2001, LASERS, fault)
    result = run(made, 2001)
    accused = {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}
    assert accused == dict.fromkeys(made.culprits, made.verdict)
    said = " ".join(notice.text for notice in result.notices)
    if fault.startswith("laser"):
        assert "all 9 beams along" in said
    if fault.startswith("delay"):
        assert "delayed, phase lag" in said


def test_the_frequency_from_which_a_body_bends_is_told():
    made = scene(24)
    bend = (made.positions_mm[:, 1] / 3.0) ** 2 * made.directions[:, 1]
    size = 0.08 * np.sqrt(np.mean(np.abs(made.q[:, 1]) ** 2))
    made.value += size * np.outer(bend, np.exp(1j * made.freq_hz / 900.0) * (made.freq_hz > 3200.0))
    result = points2dof(measurement(body("stapes", made), freq_hz=made.freq_hz))
    text = next(notice.text for notice in result.notices if notice.code == "flexible")
    assert float(text.split("from about ")[1].split()[0]) == pytest.approx(3200.0, abs=450.0)
    assert "most at channel stapes" in text


def test_a_body_with_the_wrong_sign_is_told_from_conjugated_data():
    data = driven(False)
    stapes = data.bodies[0]
    turned = replace(data, bodies=(replace(stapes, displacement=-stapes.displacement), data.bodies[1]))
    notices = points2dof(turned).notices
    assert [notice.code for notice in notices] == ["body_sign"]
    assert "standard deviations" in notices[0].text


def test_the_phase_is_judged_through_noise():
    data = driven(True)
    rng = np.random.default_rng(1)
    noisy = []
    for each in data.bodies:
        size = 0.1 * np.sqrt(np.mean(np.abs(each.displacement) ** 2))
        noise = rng.normal(size=(*each.displacement.shape, 2)) @ np.array([1.0, 1j])
        sd = np.full(each.displacement.shape, size)
        noisy.append(replace(each, displacement=each.displacement + size * noise, sd=sd))
    codes = [notice.code for notice in points2dof(replace(data, bodies=tuple(noisy))).notices]
    assert "phase_convention" in codes


def test_no_test_sees_what_is_not_there_and_every_test_sees_a_sign():
    made = drawn(2002, LASERS, "sign")
    assert bound(made) == pytest.approx(1.0)
    made.factor[:] = 1.0
    assert bound(made) == pytest.approx(0.01, abs=1e-3)
    assert measured(made, 1).shape == made.sd.shape


@pytest.mark.parametrize("fault", ["gain 2 %", "sign", "direction 3 deg", "label swap", "noise x4"])
def test_suspects_that_are_not_fitted_could_not_have_been_the_culprit(fault, monkeypatch):
    made = drawn(41, "stapes, 9 points, lasers at 20 deg", fault)
    fitted = []
    kept = Search.fitted
    monkeypatch.setattr(Search, "fitted", lambda self, one: fitted.append(one) or kept(self, one))
    few, number = run(made, 41), len(fitted)
    monkeypatch.setattr(Search, "_likely", lambda self, faults: [self.fitted(one) for one in faults])
    found = [(v.verdict, v.estimate) for v in run(made, 41).channels]
    assert found == [(v.verdict, v.estimate) for v in few.channels]
    assert number <= len(fitted) - number


def test_two_large_faults_that_hide_each_other_are_both_named():
    made = two_faults(41_006, "stapes, 10 points 3D", ("sign", "sign"))
    found = {c: v.verdict for c, v in enumerate(run(made, 41_006).channels) if v.verdict != "ok"}
    assert found == dict.fromkeys(made.culprits, "sign")


def test_a_body_that_bends_is_not_taken_for_two_channels_that_drift():
    made = drawn(31_017, "footplate, 5 points 3D", "flexible 3 %")
    assert {v.verdict for v in run(made, 31_017).channels} == {"flexible"}


def test_a_beam_that_reads_motion_of_its_own_is_no_body_that_bends_and_may_be_off_its_direction():
    made = drawn(31_008, "1D, 40 points", "direction 3 deg")
    found = {c: v for c, v in enumerate(run(made, 31_008).channels) if v.verdict != "ok"}
    assert list(found) == made.culprits
    assert "a beam off its direction" in found[made.culprits[0]].estimate

"""Faults of lasers, beams and whole bodies are found and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_bounds import bound
from benchmarks.fault_scenes import measured, two_faults
from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged as run
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.faults.test_diagnose import driven
from tests.kinematics.simulated import body, measurement, scene

LASERS = "stapes, 9 points, lasers at 20 deg"


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

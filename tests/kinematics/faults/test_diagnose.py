"""One fault gives one verdict of the right kind on the right channels; a clean file gives none."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.fault_sections import clean_words
from tests.kinematics.simulated import FAULTS, body, measurement, scene


def judged(made, position_sd_mm=np.nan, sd=True, options=None):
    """Return the result, and {verdict: channels} of what is not ok."""
    data = measurement(body("stapes", made, position_sd_mm, sd), freq_hz=made.freq_hz)
    result = points2dof(data, options=options)
    found: dict[str, list[int]] = {}
    for channel, verdict in enumerate(result.channels):
        if verdict.verdict != "ok":
            found.setdefault(verdict.verdict, []).append(channel)
    return result, found


@pytest.mark.parametrize("fault", FAULTS)
def test_one_fault_gives_one_verdict(fault):
    named = 0
    for seed in range(2):
        made = scene(seed, fault)
        result, found = judged(made)
        named += found == {fault: made.culprits}
        if found == {fault: made.culprits}:
            first = result.channels[made.culprits[0]]
            assert first.estimate
            assert first.p_value < 0.01
            codes = [notice.code for notice in result.notices]
            assert codes == ["flexible" if fault == "flexible" else f"channel_{fault}"]
    assert named == 2


def test_clean_files_raise_no_alarm():
    alarms = [bool(judged(scene(1000 + seed))[1]) for seed in range(12)]
    assert sum(alarms) == 0


@pytest.mark.parametrize("fault", ["gain", "position", "noise"])
def test_faults_are_found_without_stated_noise(fault):
    made = scene(50, fault)
    assert judged(made, sd=False)[1] == {fault: made.culprits}
    assert judged(scene(51), sd=False)[1] == {}


def test_estimates_say_how_large_the_fault_is():
    made = scene(1, "gain")
    text = judged(made)[0].channels[made.culprits[0]].estimate
    assert float(text.split()[1]) == pytest.approx(1.05, abs=0.01)
    made = scene(1, "direction")
    text = judged(made)[0].channels[made.culprits[0]].estimate
    assert float(text.split()[3]) == pytest.approx(4.0, abs=1.0)
    made = scene(1, "noise")
    text = judged(made)[0].channels[made.culprits[0]].estimate
    assert float(text.split()[1]) == pytest.approx(4.0, abs=0.5)


def test_position_errors_of_the_stated_size_are_no_fault():
    wrong = scene(3, position_sd_mm=0.02)
    assert judged(wrong)[1] != {}
    for seed in range(5):
        assert judged(scene(seed, position_sd_mm=0.02), 0.02)[1] == {}


@pytest.mark.parametrize("fault", ["sign", "gain", "label_swap", "position"])
def test_faults_are_found_beside_stated_position_errors(fault):
    made = scene(5, fault, position_sd_mm=0.02)
    assert judged(made, 0.02)[1] == {fault: made.culprits}


def test_two_culprits_are_both_named():
    made = scene(6, "gain")
    other = (made.culprits[0] + 12) % 27
    made.value[other] *= -1.0
    assert judged(made)[1] == {"gain": made.culprits, "sign": [other]}


def test_turned_beam_axes_are_told_of_the_whole_body():
    from legacy.stapeskit.frames import rotation_from_vector

    made = scene(7)
    made.directions = made.directions @ rotation_from_vector(np.radians([0.0, 2.0, 1.0]))
    result, found = judged(made)
    assert found == {"direction": list(range(27))}
    assert "all beams turned together" in result.channels[0].estimate


def test_understated_noise_is_no_fault_of_a_channel():
    made = scene(8)
    made.sd = made.sd / 2.0
    result, found = judged(made)
    assert found == {}
    text = next(notice.text for notice in result.notices if notice.code == "noise_level")
    assert "residuals are 2 times the stated noise" in text
    assert "noise_level" in clean_words(result)


def test_a_fitted_subset_does_not_accuse_channels_of_the_motion_it_leaves_out():
    _, found = judged(scene(9), options=Options(("y", "alpha", "gamma")))
    assert found == {}


def test_rows_of_zeros_are_left_out_and_told():
    made = scene(10)
    whole = points2dof(measurement(body("stapes", made), freq_hz=made.freq_hz))
    made.value[4] = 0.0
    result, found = judged(made)
    assert found == {"zeros": [4]}
    assert np.isnan(result.channels[4].p_value)
    assert result.channels[4].weight == 0.0
    assert "zero_rows" in [notice.code for notice in result.notices]
    error = np.abs(result.motion.q - whole.motion.q) / np.max(np.abs(whole.motion.q), axis=2, keepdims=True)
    assert np.max(error) < 0.05
    made.value[7, 20:30] = 0.0
    result, _ = judged(made)
    text = next(notice.text for notice in result.notices if notice.code == "zero_rows")
    assert "10 single values of body stapes are exactly zero" in text


def test_zeros_are_believed_where_nothing_moves():
    made = scene(11, snr=np.inf, q=np.zeros((200, 6)) + np.array([0, 1e-7, 0, 0, 0, 0]))
    across = np.tile([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], (9, 1))
    made.directions, made.value = across, np.outer(across[:, 1], np.full(200, 1e-7 + 0j))
    made.sd[:] = 1e-10
    result, found = judged(made)
    assert found == {}
    assert result.notices == ()
    made.value[:] = 0.0
    result, found = judged(made)
    assert "all channels of body stapes read zero" in result.notices[0].text
    assert np.all(result.motion.q == 0.0)


def test_channels_without_values_are_unused():
    made = scene(12)
    made.value[3] = np.nan
    made.sd[5] = np.nan
    _, found = judged(made)
    assert found == {"unused": [3, 5]}


def driven(conjugate):
    """A stapes that follows its base through a spring and a damper, and the base."""
    freq = np.linspace(400.0, 5000.0, 100)
    base = np.zeros((100, 6), dtype=complex)
    base[:, 1] = 1e-7
    stapes = base.copy()
    ratio = freq / 1750.0
    stapes[:, 1] *= (1 + 0.24j * ratio) / (1 - ratio**2 + 0.24j * ratio)
    parts = []
    for name, q in (("stapes", stapes), ("base", base)):
        made = scene(13, lines=100, q=q)
        made.value = made.value.conj() if conjugate else made.value
        parts.append(body(name, made))
    return measurement(*parts, freq_hz=freq)


def test_conjugated_data_are_told():
    codes = [notice.code for notice in points2dof(driven(True)).notices]
    assert codes == ["phase_convention"]
    assert points2dof(driven(False)).notices == ()
    for conjugate in (True, False):
        both = driven(conjugate)
        alone = points2dof(Measurement("footplate", ("1",), both.freq_hz, both.bodies[:1], 0))
        assert ["cannot show its phase" in notice.text for notice in alone.notices] == [True] * conjugate


def test_bodies_at_other_frequencies_are_told():
    one, two = scene(15, lines=10), scene(16, lines=10)
    two.value[:, 7:] = np.nan
    data = measurement(body("a", one), body("b", two), freq_hz=one.freq_hz)
    result = points2dof(data)
    assert [notice.code for notice in result.notices] == ["frequencies_differ"]
    assert "a at 10, b at 7 were measured, 7 of them on all bodies" in result.notices[0].text


def test_runs_are_judged_apart():
    clean, faulty = scene(14), scene(14, "sign")
    both = BodyChannels(
        "stapes",
        clean.points,
        clean.positions_mm,
        clean.directions,
        np.stack([clean.value, faulty.value]),
        np.stack([clean.sd, faulty.sd]),
    )
    result = points2dof(Measurement("footplate", ("a", "b"), clean.freq_hz, (both,), 0))
    counts = Counter((v.run, v.verdict) for v in result.channels)
    assert counts == {("a", "ok"): 27, ("b", "ok"): 26, ("b", "sign"): 1}
    assert "in run b" in result.notices[0].text


def test_directions_that_fit_nothing_are_no_turn_of_all_beams():
    made = scene(12)
    made.directions = np.tile([0.0, 1.0, 0.0], (27, 1))
    result, found = judged(made, options=Options(("y", "alpha", "gamma")))
    assert found == {"flexible": list(range(27))}
    assert "non-rigid motion" in result.channels[0].estimate

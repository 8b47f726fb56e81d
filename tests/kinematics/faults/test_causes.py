"""Causes of a misfit on many channels: each is found by its code, and a body that bends keeps its name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corrections import errors, fitted
from benchmarks.fault_bodies import draw
from benchmarks.fault_scenes import measured, scene
from benchmarks.points_faults import judged
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof

STAPES = "stapes, 10 points 3D"
CAUSES = {
    "sparse_outliers",
    "mains_lines",
    "gains_scattered",
    "drift_between_points",
    "conjugated_laser",
    "unit_slip",
    "flexible",
}


def spikes(made, value, rng):
    """Add noise as large as the signal to 3 % of the values."""
    some = rng.random(value.shape) < 0.03
    size = np.sqrt(np.mean(np.abs(value) ** 2))
    value[some] += size * (rng.normal(size=some.sum()) + 1j * rng.normal(size=some.sum()))


def dropouts(made, value, rng):
    """Pull 10 % of the values towards zero."""
    some = rng.random(value.shape) < 0.1
    value[some] *= rng.uniform(0.0, 0.7, some.sum())


def multiples(made, value, rng):
    """Make 3 % of the values three times what they should be."""
    value[rng.random(value.shape) < 0.03] *= 3.0


def hum(made, value, rng):
    """Add another pattern at every odd multiple of 50 Hz, on a grid of 12.5 Hz."""
    near = np.abs(made.freq_hz % 100.0 - 50.0) < 1.0
    size = 0.2 * np.sqrt(np.mean(np.abs(value) ** 2))
    shape = (len(value), near.sum())
    value[:, near] += size * (rng.normal(size=shape) + 1j * rng.normal(size=shape))


def gains(made, value, rng):
    """Scatter the gains of all channels by 1.5 %."""
    value *= (1.0 + 0.015 * rng.normal(size=len(value)))[:, None]


def drying(made, value, rng):
    """Let the readings fall by 8 % from the first point to the last."""
    number = np.array([int(point) for point in made.points])
    value *= (1.0 - 0.08 * (number - 1) / number.max())[:, None]


def conjugate(made, value, rng):
    """Conjugate the readings of one laser."""
    own = np.abs(made.directions @ made.directions[1]) > 0.9
    value[own] = value[own].conj()


def another_range(made, value, rng):
    """Let four of ten points read twice what they should, as two ranges of a vibrometer differ."""
    value[np.isin([int(point) for point in made.points], rng.permutation(np.arange(1, 11))[:4])] *= 2.0


SPOILED = {
    "sparse_outliers": (spikes, dropouts, multiples),
    "mains_lines": (hum,),
    "gains_scattered": (gains,),
    "drift_between_points": (drying,),
    "conjugated_laser": (conjugate,),
    "unit_slip": (another_range,),
}


def found(seed, spoil=None, *, stated=True, fault="", position_um=0.0, geometry=STAPES):
    """Return the codes of causes, and the finding that has one."""
    made = scene(830_000 + seed, geometry, fault)
    if position_um:
        off = np.random.default_rng(seed).normal(0.0, 1e-3 * position_um, (len(set(made.points)), 3))
        number = np.unique(made.points, return_inverse=True)[1]
        made = replace(made, reported=made.reported + off[number])
    if spoil is hum:
        made = replace(made, freq_hz=400.0 + 12.5 * np.arange(len(made.freq_hz)))
    value = measured(made, seed)
    if spoil is not None:
        spoil(made, value, np.random.default_rng(seed))
    result = judged(made, seed, stated, 1e-3 * position_um, value)
    causes = [finding for finding in result.diagnoses[0, 0].findings if finding.code]
    return {notice.code for notice in result.notices} & CAUSES, causes, result


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("code", "spoil"), [(code, one) for code, many in SPOILED.items() for one in many])
def test_cause_is_found_by_its_code(code, spoil, stated):
    codes, causes, result = found(1, spoil, stated=stated)
    assert codes == {code}
    assert causes[0].step
    assert {verdict.verdict for verdict in result.channels} <= {
        "ok",
        "noise",
        "gain",
        "drift",
        "sign",
    }


@pytest.mark.parametrize("order", [0, 1])
def test_conjugates_of_what_was_measured_are_found(order):
    made = scene(830_001, STAPES, "")
    value = measured(made, 1)
    own = np.abs(made.directions @ made.directions[1]) > 0.9
    rate = (2j * np.pi * made.freq_hz) ** order
    value[own] = (value[own] * rate).conj() / rate
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value[None], made.sd[None])
    result = points2dof(Measurement("footplate", ("1",), made.freq_hz, (body,), order))
    assert [finding.code for finding in result.diagnoses[0, 0].findings] == ["conjugated_laser"]


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("code", "spoil"), [(code, one) for code, many in SPOILED.items() for one in many])
def test_cause_is_found_beside_errors_of_positions(code, spoil, stated):
    assert found(3, spoil, stated=stated, position_um=20.0)[0] == {code}


@pytest.mark.parametrize("stated", [True, False])
def test_scatter_of_few_channels_is_said_beside_a_body_that_bends(stated):
    codes, _causes, result = found(1, gains, stated=stated, geometry="footplate, 5 points 3D")
    assert codes == {"flexible"}
    text = next(notice.text for notice in result.notices if notice.code == "flexible")
    assert "do not tell this from another cause: the gains of the channels scatter by about" in text


@pytest.mark.parametrize("factor", [0.1, 2.0**0.5, 5.0])
def test_points_in_another_range_are_named_with_their_factor_and_can_be_put_right(factor):
    made = scene(830_007, STAPES, "")
    value = measured(made, 7)
    other = np.isin(made.points, ["2", "5", "9"])
    value[other] *= factor
    sd = np.where(other[:, None], factor, 1.0) * made.sd
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value[None], sd[None])
    data = Measurement("footplate", ("1",), made.freq_hz, (body,), 0)
    result = points2dof(data)
    wrong = np.array([channel.verdict == "gain" for channel in result.channels])
    assert np.array_equal(wrong, other)
    text = next(notice.text for notice in result.notices if notice.code == "unit_slip")
    assert f"3 of 10 points read {factor:.4g} times what the others show (2, 5, 9)" in text
    put_right = points2dof(data, options=Options(correct=True))
    size = np.sqrt(np.mean(np.abs(made.q) ** 2, axis=0))
    assert np.max(np.abs(put_right.motion.q[0, 0] - made.q) / size) < 0.1


def test_half_of_the_points_in_another_range_are_named_but_not_put_right():
    """Which half is right the readings of one body do not show: to divide one would be to guess."""
    made = scene(830_008, STAPES, "")
    value = measured(made, 8)
    value[np.isin(made.points, ["1", "2", "5", "8", "9"])] *= 2.0
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value[None], made.sd[None])
    result = points2dof(
        Measurement("footplate", ("1",), made.freq_hz, (body,), 0), options=Options(correct=True)
    )
    text = next(notice.text for notice in result.notices if notice.code == "unit_slip")
    assert "5 of 10 points read 2 times what the others show (1, 2, 5 and 2 more)" in text
    assert "which half is right does not show" in text
    assert "corrected" not in {notice.code for notice in result.notices}


@pytest.mark.parametrize(("gaps", "dead"), [(0.2, None), (0.0, 4)])
def test_points_in_another_range_are_named_beside_gaps_and_a_dead_channel(gaps, dead):
    for seed in range(3):
        reading = draw(seed, "shell, 12 points, 3 heads", "range of points", lines=40, gaps=gaps)
        if dead is not None:
            reading.value[dead] = 0.0
        result = fitted(reading, correct=False)
        wrong = [c for c, channel in enumerate(result.channels) if channel.verdict == "gain"]
        assert {*wrong} - {dead} == {*reading.culprits} - {dead}
        assert dead is None or result.channels[dead].verdict in ("zeros", "gain")


@pytest.mark.parametrize("scaled", [True, False])
def test_the_sd_of_points_that_are_put_right_is_that_of_their_readings(scaled):
    """The stated sd was multiplied with the readings, or was not: the corrected motion is held either way."""
    within = []
    for seed in range(4):
        reading = draw(50 + seed, "shell, 12 points, 3 heads", "range of points", lines=40)
        if scaled:
            size = np.abs(reading.value) / np.abs(
                draw(50 + seed, "shell, 12 points, 3 heads", lines=40).value
            )
            reading.sd[reading.culprits] *= np.median(size[reading.culprits])
        result = fitted(reading, correct=True)
        assert not result.diagnoses[0, 0].findings
        within.append(np.mean(np.abs(errors(result, reading.twist.T)[1]) < 1.96))
    assert 0.9 < np.mean(within) < 0.98


@pytest.mark.parametrize("stated", [True, False])
def test_names_of_three_points_in_a_cycle_are_named_and_put_right(stated):
    for seed in range(3):
        reading = draw(seed, "shell, 12 points, 3 heads", "names of three points", lines=40, gaps=0.1 * seed)
        result = fitted(reading, correct=False, stated=stated)
        wrong = {c for c, channel in enumerate(result.channels) if channel.verdict == "label_swap"}
        assert wrong == set(reading.culprits)
        right = fitted(reading, correct=True, stated=stated)
        assert np.sqrt(np.mean(errors(right, reading.twist.T)[0] ** 2)) < 0.05


@pytest.mark.parametrize("steps", [(1.0, 3.0), (3.0, 1.0), (1.0, 8.0)])
def test_noise_that_steps_at_one_frequency_is_no_outlier(steps):
    for seed in range(4):
        made = scene(830_020 + seed, STAPES, "")
        half = len(made.freq_hz) // 2
        made = replace(made, sd=made.sd * np.repeat(steps, [half, len(made.freq_hz) - half]))
        result = judged(made, seed, False, 0.0, measured(made, seed))
        assert {channel.verdict for channel in result.channels} == {"ok"}


def test_outliers_are_counted():
    _codes, causes, _result = found(2, spikes)
    assert causes[0].size == pytest.approx(0.03, abs=0.01)


def test_scatter_of_the_gains_is_measured():
    sizes = [found(seed, gains)[1][0].size for seed in range(3)]
    assert np.mean(sizes) == pytest.approx(0.015, rel=0.35)


def test_frequencies_of_the_mains_are_named():
    text = found(3, hum)[1][0].text
    assert "50 Hz" in text
    assert "450, 550, 650" in text


@pytest.mark.parametrize("stated", [True, False])
def test_a_body_that_bends_keeps_its_name(stated):
    for seed in range(2):
        assert found(seed, fault="flexible 3 %", stated=stated)[0] == {"flexible"}


def test_clean_files_have_no_cause():
    for seed in range(10):
        assert found(seed, stated=False)[0] == set()


def test_faults_of_one_channel_are_not_taken_for_outliers():
    for fault in ("sign", "noise x4", "label swap"):
        assert found(5, fault=fault, stated=False)[:2] == (set(), [])

"""Noise of a reference apart from that of channels, and delays of single records, as they were put in."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.signals.frf_noise import (
    check_signals,
    common_notice,
    smoothed,
    split_noise,
    steady_common,
)
from legacy.kinematics.signals.record_delays import delay_notice

CHANNELS, LINES = 8, 120


def complex_noise(rng, *shape):
    return rng.normal(size=(*shape, 2)) @ np.array([1.0, 1j]) / np.sqrt(2.0)


def noisy_blocks(common, seed=0, count=24):
    """Residuals Y - H X of blocks: noise of the channels, and an error e of the reference, -H e."""
    rng = np.random.default_rng(seed)
    response = (2.0 + rng.uniform(size=(CHANNELS, 1))) * np.exp(1j * rng.uniform(0.0, 6.0, (CHANNELS, LINES)))
    own = 0.1 * (1.0 + 0.1 * np.arange(CHANNELS))[:, None]
    blocks = [
        own * complex_noise(rng, CHANNELS, LINES) - response * common * complex_noise(rng, LINES)
        for _ in range(count)
    ]
    spectrum = sum(np.abs(block) ** 2 for block in blocks) / (count - 1)
    return response, own, blocks, spectrum, count - 1.0


def test_noise_of_the_reference_is_separated_from_that_of_channels():
    response, own, blocks, spectrum, freedom = noisy_blocks(0.3)
    shown, common = split_noise(lambda: blocks, spectrum, response, freedom)
    assert np.mean(common) == pytest.approx(0.09, rel=0.08)
    assert np.allclose(np.mean(shown, axis=1), own[:, 0] ** 2, rtol=0.12)


def test_without_noise_of_the_reference_nothing_is_taken_from_the_channels():
    response, _, blocks, spectrum, freedom = noisy_blocks(0.0)
    shown, common = split_noise(lambda: blocks, spectrum, response, freedom)
    assert shown is spectrum
    assert np.all(common == 0.0)


def test_two_channels_cannot_show_noise_of_the_reference():
    response, _, blocks, spectrum, freedom = noisy_blocks(0.3)
    shown, _ = split_noise(lambda: [block[:2] for block in blocks], spectrum[:2], response[:2], freedom)
    assert np.all(shown == spectrum[:2])


def test_a_smoothed_spectrum_keeps_its_course_and_makes_chi2_unbiased():
    rng = np.random.default_rng(0)
    level = np.exp(np.linspace(0.0, 3.0, 400))
    freedom, width = 4.0, 15
    power = level * rng.gamma(freedom, 1.0 / freedom, (50, 400))
    shown = smoothed(power, width, freedom)
    inner = slice(20, -20)
    assert np.mean(level[inner] / shown[:, inner]) == pytest.approx(1.0, abs=0.01)
    assert np.std(np.log(shown[:, inner] / level[inner])) < 0.2
    assert np.array_equal(smoothed(power, 1), power)


def test_noise_of_a_reference_is_averaged_over_lines():
    common = np.random.default_rng(1).gamma(2.0, 0.5, 300)
    assert np.std(steady_common(common, 21)) < 0.5 * np.std(common)
    assert steady_common(common, 1) is common
    assert common_notice(np.zeros(5)) == []
    assert [notice.code for notice in common_notice(np.full(5, 0.02))] == ["reference_noise"]


def late_records(late_samples, count=6, seed=0):
    rng = np.random.default_rng(seed)
    rate, freq = 51_200.0, np.linspace(100.0, 8000.0, LINES)
    response = np.exp(1j * np.linspace(0.0, 3.0, LINES)) * (1.0 + np.arange(CHANNELS))[:, None]
    spectra = []
    for record in range(count):
        x = complex_noise(rng, LINES)
        late = np.exp(-2j * np.pi * freq * (late_samples if record == 2 else 0.0) / rate)
        spectra.append((x, response * x * late + 0.02 * complex_noise(rng, CHANNELS, LINES)))
    return spectra, freq, response, np.full(response.shape, 1e-3), np.ones(LINES), rate


def test_a_late_record_is_named():
    spectra, freq, response, variance, power, rate = late_records(3.0)
    (notice,) = delay_notice(spectra, freq, response, variance, power, rate)
    assert notice.code == "records_late"
    assert "record 3" in notice.text


def test_records_on_time_raise_no_alarm():
    told = [delay_notice(*late_records(0.0, seed=seed)) for seed in range(20)]
    assert not any(told)


def test_a_few_lines_say_nothing_about_delays():
    spectra, freq, response, variance, power, rate = late_records(3.0)
    few = [(x[:6], y[:, :6]) for x, y in spectra]
    assert delay_notice(few, freq[:6], response[:, :6], variance[:, :6], power[:6], rate) == []


@pytest.mark.parametrize(
    ("reference", "responses", "rate", "thing"),
    [
        (np.arange(8.0), np.ones((2, 8)), 0.0, "the sampling rate"),
        (np.arange(8.0), np.ones((2, 7)), 1.0, "reference and responses"),
        (np.arange(8.0), np.full((2, 8), np.nan), 1.0, "the samples"),
        (np.ones(8), np.ones((2, 8)), 1.0, "the reference"),
    ],
)
def test_signals_that_give_no_estimate_are_refused(reference, responses, rate, thing):
    with pytest.raises(KinematicsError) as refused:
        check_signals(reference, responses, rate, "record.mat")
    assert [fault.thing for fault in refused.value.faults] == [thing]

"""Frequency responses from samples: closed forms, and stated standard deviations against populations."""

import numpy as np
import pytest
from scipy.signal import stft

from kinematics.signals.frf import effective_averages, periodic_frf, smoothed, split_noise, welch_frf
from kinematics.signals.lock_in import Step, fit_sine, stepped_frf
from kinematics.signals.samples import is_clipped, sample_notices
from stapeskit.faults import StapeskitError

RATE = 8000.0


def test_overlap_of_half_a_hann_window_is_worth_what_welch_says():
    """The variance of a mean of spectra of white noise is that of so many independent ones."""
    rng = np.random.default_rng(3)
    for count in (2, 10):
        samples = rng.normal(size=(4000, 32 * (count + 1)))
        power = np.abs(stft(samples, nperseg=64, boundary=None, padded=False)[2][:, 2:-2]) ** 2
        relative = np.var(power.mean(axis=-1)) / np.mean(power) ** 2
        assert 1.0 / relative == pytest.approx(effective_averages(count), rel=0.03)


def random_record(rng, noise, samples=32_768):
    drive = rng.normal(size=samples)
    delayed = np.array([drive, 0.5 * np.roll(drive, 1)])
    return drive, delayed + noise * rng.normal(size=delayed.shape)


def test_h1_and_its_standard_deviation():
    """Of 40 records the errors of H1 have the stated sd within 5 % (1 600 lines, two channels)."""
    rng = np.random.default_rng(5)
    ratios = []
    for _ in range(40):
        frf = welch_frf([random_record(rng, 0.3)], RATE, 512)
        truth = np.array([np.ones(len(frf.freq_hz)), 0.5 * np.exp(-2j * np.pi * frf.freq_hz / RATE)])
        ratios.append(np.mean(np.abs(frf.value - truth) ** 2 / (2 * frf.sd**2), axis=1))
    assert np.allclose(np.mean(ratios, axis=0), 1.0, atol=0.08)


def test_periods_give_exact_responses_and_honest_noise():
    rng = np.random.default_rng(6)
    time = np.arange(int(2.0 * RATE)) / RATE
    lines = np.arange(100.0, 900.0, 50.0)
    turning = np.exp(1j * (2 * np.pi * lines[:, None] * time + rng.uniform(0, 6, (len(lines), 1))))
    truth = rng.normal(size=(2, len(lines))) + 1j * rng.normal(size=(2, len(lines)))
    clean = (truth @ turning).real
    drive = np.sum(turning.real, axis=0)
    exact = periodic_frf([(drive, clean)], RATE, 0.02)
    assert np.allclose(exact.value, truth, atol=1e-10)
    ratios = []
    for _ in range(60):
        frf = periodic_frf([(drive, clean + 0.5 * rng.normal(size=clean.shape))], RATE, 0.02)
        ratios.append(np.mean(np.abs(frf.value - truth) ** 2 / (2 * frf.sd**2)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.06)


def test_a_lock_in_is_exact_and_its_noise_is_that_near_the_line():
    rng = np.random.default_rng(7)
    time = np.arange(4000) / RATE
    wave = (0.3 - 0.4j) * np.exp(2j * np.pi * 440.0 * time)
    amplitude, _ = fit_sine(wave.real[None] + 0.7 + time, RATE, 440.0)
    assert amplitude[0] == pytest.approx(0.3 - 0.4j, abs=1e-12)
    signals = wave.real + 0.1 * rng.normal(size=(400, 4000))
    amplitude, sd = fit_sine(signals, RATE, 440.0)
    assert np.std(amplitude.real) == pytest.approx(np.mean(sd), rel=0.08)
    assert np.mean(sd) == pytest.approx(0.1 * np.sqrt(2 / 4000), rel=0.03)


def test_steps_are_sorted_and_checked_together():
    time = np.arange(2000) / RATE
    steps = [
        Step(f, np.cos(2 * np.pi * f * time), np.sin(2 * np.pi * f * time)[None]) for f in (500.0, 300.0)
    ]
    frf = stepped_frf(steps, RATE)
    assert np.allclose(frf.freq_hz, [300.0, 500.0])
    assert np.allclose(frf.value, -1j, atol=1e-9)
    bad = [*steps, Step(3990.0, steps[0].reference, steps[0].responses), Step(1.0, None, np.zeros((1, 2000)))]
    with pytest.raises(StapeskitError) as caught:
        stepped_frf(bad, RATE)
    assert len(caught.value.faults) == 2


def test_noise_of_each_channel_and_of_the_reference_are_separated():
    """Residuals -H e + n, var e = 0.04, var n from 0.25 to 9: both are found, nothing where e = 0."""
    rng = np.random.default_rng(8)

    def circular(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    response = 20.0 * np.exp(2j * np.pi * rng.uniform(size=(10, 50)))
    own_sd = np.resize([1.0, 2.0, 3.0, 0.5], 10)[:, None]
    noise = own_sd[:, :, None] * circular(10, 50, 400)
    own, common = split_noise(noise - response[:, :, None] * 0.2 * circular(1, 50, 400), response)
    assert np.mean(common) == pytest.approx(0.04, rel=0.05)
    assert np.allclose(np.mean(own, axis=1), own_sd[:, 0] ** 2, rtol=0.03)
    own, common = split_noise(noise, response)
    assert not np.any(common)
    assert np.allclose(np.mean(own, axis=1), own_sd[:, 0] ** 2, rtol=0.02)


def test_smoothing_keeps_a_level_and_corrects_for_few_degrees_of_freedom():
    assert np.allclose(smoothed(np.full((1, 40), 3.0), 9), 3.0)
    assert np.allclose(smoothed(np.full((1, 40), 3.0), 1, 4.0), 3.0 / (1 - 1 / 4))


def test_clipped_samples():
    row = np.random.default_rng(9).normal(size=4000)
    assert not is_clipped(row)
    assert is_clipped(np.clip(row, -1.0, 1.0))
    assert not is_clipped(np.where(np.arange(4000) == 500, 1.0, 0.0))  # a pulse
    (notice,) = sample_notices({"a": [row], "b": [np.clip(row, -1.0, 1.0)]}, "f.npz")
    assert (notice.code, notice.text[0]) == ("samples_stuck", "b")


def test_a_silent_reference_is_refused():
    with pytest.raises(StapeskitError):
        welch_frf([(np.zeros(4000), np.ones((1, 4000)))], RATE, 256)

"""Frequency responses from samples: closed forms, and stated standard deviations against populations."""

import numpy as np
import pytest
from scipy.signal import stft

from kinematics.signals.frf import effective_averages, periodic_frf, welch_frf
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
        frf = welch_frf(*random_record(rng, 0.3), RATE, 127)
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
    exact = periodic_frf(drive, clean, RATE, 0.02)
    assert np.allclose(exact.value, truth, atol=1e-10)
    ratios = []
    for _ in range(60):
        frf = periodic_frf(drive, clean + 0.5 * rng.normal(size=clean.shape), RATE, 0.02)
        ratios.append(np.mean(np.abs(frf.value - truth) ** 2 / (2 * frf.sd**2)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.06)


def test_a_silent_reference_is_refused():
    with pytest.raises(StapeskitError):
        welch_frf(np.zeros(4000), np.ones((1, 4000)), RATE, 30)

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


@pytest.mark.parametrize("kind", ["multisine", "one sine", "steps"])
def test_power_in_single_lines_is_refused_without_a_period(kind):
    """Lines between hold leakage: errors of a multisine were 14 of their stated sd."""
    rng = np.random.default_rng(6)
    time = np.arange(60_000) / RATE
    freq = np.arange(200.0, 2000.0, 50.0) if kind == "multisine" else np.linspace(300.0, 2000.0, 6)
    drive = np.sum(np.sin(2 * np.pi * freq[:, None] * time + rng.uniform(0, 6.0, (len(freq), 1))), axis=0)
    if kind != "multisine":
        steps = np.sin(2 * np.pi * freq[:, None] * time[:10_000]).ravel()
        drive = steps if kind == "steps" else np.sin(2 * np.pi * 437.0 * time)
    drive += 1e-4 * rng.normal(size=len(time))
    responses = 0.5 * np.roll(drive, 1)[None] + 0.01 * rng.normal(size=len(time))
    with pytest.raises(StapeskitError) as caught:
        welch_frf(drive, responses, RATE, 30)
    assert caught.value.faults[0].thing == "the reference"
    assert "--period" in caught.value.faults[0].next_step


@pytest.mark.parametrize("kind", ["white", "band", "hum", "chirp"])
def test_power_in_a_band_is_no_power_in_single_lines(kind):
    rng = np.random.default_rng(7)
    time = np.arange(60_000) / RATE
    drive = rng.normal(size=len(time))
    if kind == "band":
        drive = np.fft.irfft(np.fft.rfft(drive) * (np.abs(np.fft.rfftfreq(len(time)) - 0.1) < 0.02))
    drive += 0.5 * np.sin(2 * np.pi * 50.0 * time) if kind == "hum" else 0.0
    drive = np.sin(2 * np.pi * (200.0 + 100.0 * time) * time) if kind == "chirp" else drive
    for segments in (3, 30):
        assert len(welch_frf(drive, drive[None], RATE, segments).freq_hz)


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

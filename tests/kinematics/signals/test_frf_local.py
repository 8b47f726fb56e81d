"""Local polynomials against closed forms and Monte Carlo; what windows do to sharp resonances is told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import get_window, lfilter

from legacy.kinematics.signals.frf import Welch, welch_frf
from legacy.kinematics.signals.frf_local import Local, local_frf
from legacy.kinematics.signals.leakage import noise_of_differences
from legacy.stapeskit.faults import StapeskitError

RATE = 1000.0
GAINS = np.array([[1.0], [2.0], [-0.5], [3.0]])
SHARP = (0.05, 2.0 * 0.97 * np.cos(2.0 * np.pi * 0.2), 0.97**2)
SMOOTH = (0.5, 0.4, 0.0)


def plant(freq_hz: np.ndarray, of: tuple[float, float, float]) -> np.ndarray:
    """Return b / (1 - a1 z^-1 + a2 z^-2)."""
    back = np.exp(-2j * np.pi * freq_hz / RATE)
    return of[0] / (1.0 - of[1] * back + of[2] * back**2)


def record(
    rng: np.random.Generator,
    of: tuple[float, float, float],
    noise: float,
    into: float = 0.0,
    samples: int = 4096,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a piece out of a long random vibration, with noise of a share of the response."""
    drive = rng.standard_normal(samples + 1024)
    answer = lfilter([of[0]], [1.0, -of[1], of[2]], drive)[1024:]
    answer = GAINS * answer
    loud = noise * np.std(answer, axis=1, keepdims=True)
    drive = drive[1024:] + into * rng.standard_normal(samples)
    return drive, answer + loud * rng.standard_normal(answer.shape)


@pytest.mark.parametrize("records", [1, 3])
def test_no_leakage_at_a_sharp_resonance(records: int) -> None:
    rng = np.random.default_rng(1)
    made = [record(rng, SHARP, 0.0) for _ in range(records)]
    errors = {}
    for name, found in (
        ("h1", welch_frf(made, RATE, Welch(256))),
        ("lpm", local_frf(made, RATE, Local(RATE / 256))),
    ):
        near = np.abs(found.freq_hz - 200.0) < 15.0
        true = GAINS * plant(found.freq_hz, SHARP)
        errors[name] = np.max(np.abs(found.value / true - 1.0)[:, near])
    assert errors["h1"] > 0.1
    assert errors["lpm"] < 0.05 * errors["h1"]


@pytest.mark.parametrize("samples", [(4096,), (2048, 2300)])
def test_stated_noise_is_that_of_the_estimate(samples: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    made = [
        local_frf([record(rng, SMOOTH, 0.3, samples=n) for n in samples], RATE, Local(6.0))
        for _ in range(100)
    ]
    value = np.array([one.value for one in made])
    sd = np.array([one.sd for one in made])
    error = value - GAINS * plant(made[0].freq_hz, SMOOTH)
    assert np.mean(np.abs(error) ** 2) / 2.0 / np.mean(sd**2) == pytest.approx(1.0, abs=0.06)
    inside = np.mean([np.abs(error.real) < 1.96 * sd, np.abs(error.imag) < 1.96 * sd])
    assert 0.94 < inside < 0.96
    assert np.max(np.abs(np.mean(error, axis=0))) < 6.0 * np.mean(sd) * np.max(GAINS) / 10.0
    following = np.mean(error[:, :, 1:] * error[:, :, :-1].conj()).real / np.mean(np.abs(error) ** 2)
    assert abs(following) < 0.02
    assert all(one.common_sd.max() == 0.0 for one in made[:20])


def test_noise_of_the_reference_is_told_apart() -> None:
    rng = np.random.default_rng(3)
    made = [local_frf([record(rng, SMOOTH, 0.02, 0.2)], RATE, Local(8.0)) for _ in range(40)]
    value = np.array([one.value for one in made])
    moved = np.mean(value / np.mean(value, axis=0), axis=1)
    spread = np.sqrt(np.mean(np.abs(moved - 1.0) ** 2) / 2.0)
    assert np.mean([np.median(one.common_sd) for one in made]) == pytest.approx(spread, rel=0.15)
    assert "reference_noise" in {notice.code for notice in made[0].notices}


def test_a_resolution_too_fine_for_the_record_is_refused() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(
        StapeskitError, match=r"the resolution must be 2\.44 Hz at least for records of 4\.1 s"
    ):
        local_frf([record(rng, SMOOTH, 0.1)], RATE, Local(1.0))
    with pytest.raises(StapeskitError, match="the resolution must be positive"):
        Local(0.0)


def leaks(found) -> list[str]:
    """Return the texts of warnings of leakage."""
    return [notice.text for notice in found.notices if notice.code == "leakage"]


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_leakage_is_told_where_it_exceeds_the_noise(noise: float) -> None:
    rng = np.random.default_rng(5)
    (text,) = leaks(welch_frf([record(rng, SHARP, noise)], RATE, Welch(256)))
    place = float(text.split("most near ")[1].split(" Hz")[0])
    assert abs(place - 200.0) < 8.0
    assert not leaks(welch_frf([record(rng, SHARP, noise, samples=1 << 17)], RATE, Welch(8192)))
    quiet = [leaks(welch_frf([record(rng, SMOOTH, noise)], RATE, Welch(256))) for _ in range(30)]
    assert sum(map(bool, quiet)) <= 1


def test_segments_cut_out_of_a_vibration_without_a_window_are_told() -> None:
    rng = np.random.default_rng(6)
    how = Welch(256, "none", 0.0)
    assert "do not end at rest" in leaks(welch_frf([record(rng, SHARP, 0.0)], RATE, how))[0]
    drive = rng.standard_normal(4096) * (np.arange(4096) % 256 < 40)
    answer = GAINS * lfilter([0.5], [1.0, -0.4], drive)
    assert not leaks(welch_frf([(drive, answer + 0.002 * rng.standard_normal(answer.shape))], RATE, how))


@pytest.mark.parametrize("window", ["boxcar", "hann"])
def test_the_noise_of_second_differences_is_that_of_responses_by_segments(window: str) -> None:
    rng = np.random.default_rng(7)
    taper = get_window(window, 64)
    drive, noise = (np.fft.rfft(taper * rng.standard_normal((800, 100, 64))) for _ in range(2))
    value = np.sum(noise * drive.conj(), axis=1) / np.sum(np.abs(drive) ** 2, axis=1)
    value = value[:, 4:28]
    bent = value[:, 2:] - 2.0 * value[:, 1:-1] + value[:, :-2]
    measured = np.mean(np.abs(bent) ** 2) / np.mean(np.abs(value) ** 2)
    assert noise_of_differences(taper) == pytest.approx(measured, rel=0.04)


def test_lines_that_nothing_drives_do_not_count_the_averages() -> None:
    """A digital drive within a band leaves the other lines without power."""
    rng = np.random.default_rng(5)
    lines = np.zeros(2049, dtype=complex)
    lines[200:900] = rng.standard_normal((700, 2)) @ [1.0, 1j]
    drive = np.fft.irfft(lines)
    found = local_frf([(drive, GAINS * drive + 1e-4 * rng.standard_normal((4, 4096)))], RATE, Local(6.0))
    assert found.n_avg >= 1.0
    inside = (found.freq_hz > 60.0) & (found.freq_hz < 200.0)
    assert np.allclose(found.value[:, inside], GAINS, rtol=1e-2)

"""Stepped sine by lock-in: exact without noise, honest with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from legacy.kinematics.signals.lock_in import SteppedSine, fit_sine
from legacy.kinematics.signals.stepped_sine import Step, stepped_amplitudes, stepped_frf, steps_of
from legacy.stapeskit.faults import StapeskitError

RATE = 8192.0
COUNT = 1600
TIME = np.arange(COUNT) / RATE
FREQ = np.linspace(200.0, 2000.0, 9)
GAINS = np.array([[1.0 + 0.5j], [2.0 - 1.0j], [0.3j], [-1.5]])


def record(rng, freq, gains=GAINS, in_noise=0.0, out_noise=0.0, colour=0.0, clock=1.0, second=0.0, drift=0.0):
    wave = np.exp(1j * (2.0 * np.pi * freq * clock * TIME + rng.uniform(0.0, 2.0 * np.pi)))
    noise = lfilter([1.0], [1.0, -colour], rng.standard_normal((len(gains), COUNT)))
    response = np.real(gains * wave + second * np.abs(gains) * wave**2) + out_noise * noise + drift * TIME
    return Step(freq, wave.real + in_noise * rng.standard_normal(COUNT), response)


def test_a_pure_sine_is_exact_beside_drift_and_harmonics():
    signal = 2.0 * np.cos(2.0 * np.pi * 321.7 * TIME - 0.4) + 3.0 + 5.0 * TIME
    signal += 0.3 * np.cos(2.0 * np.pi * 643.4 * TIME + 1.0)
    fit = fit_sine(signal, RATE, 321.7, SteppedSine(refine=False))
    assert fit.amplitude[0] == pytest.approx(2.0 * np.exp(-0.4j), rel=1e-10)
    assert fit.harmonics[0, 0] == pytest.approx(0.3 * np.exp(1.0j), rel=1e-9)
    assert fit.sd[0] < 1e-9


@pytest.mark.parametrize("apart_hz", [0.0, 0.7, -3.0, 12.0])
def test_the_frequency_is_found_when_clocks_differ(apart_hz):
    true = 700.0 + apart_hz
    fit = fit_sine(np.cos(2.0 * np.pi * true * TIME + 0.3), RATE, 700.0)
    assert fit.freq_hz == pytest.approx(true, abs=1e-6)
    assert fit.amplitude[0] == pytest.approx(np.exp(0.3j), abs=1e-6)


@pytest.mark.parametrize(
    "how",
    [
        {"out_noise": 0.3},
        {"out_noise": 0.3, "colour": 0.97},
        {"out_noise": 0.3, "in_noise": 0.2},
        {"out_noise": 0.2, "clock": 1.0 + 2e-4},
        {"out_noise": 0.2, "second": 0.1, "drift": 5.0},
    ],
)
def test_the_stated_sd_is_that_of_the_estimate(how):
    rng = np.random.default_rng(1)
    gains = GAINS[:2]
    made = [
        stepped_frf([record(rng, f, gains, **how) for f in FREQ], RATE, SteppedSine(settle=0.0))
        for _ in range(30)
    ]
    error = np.array([one.value - gains for one in made])
    sd = np.array([one.sd for one in made])
    assert np.sqrt(np.mean(np.abs(error) ** 2) / 2.0 / np.mean(sd**2)) == pytest.approx(1.0, abs=0.08)
    codes = {notice.code for notice in made[0].notices}
    assert ("clock_differs" in codes) == ("clock" in how)
    assert ("distortion" in codes) == ("second" in how)
    assert "not_steady" not in codes


def test_noise_of_the_reference_is_common_and_told_apart():
    rng = np.random.default_rng(2)
    result = stepped_frf([record(rng, f, in_noise=0.2, out_noise=0.01) for f in FREQ], RATE)
    assert "reference_noise" in {notice.code for notice in result.notices}
    weight = np.abs(GAINS) ** 2 / np.sum(np.abs(GAINS) ** 2)
    common = np.sum(weight * result.value / GAINS, axis=0)
    own = np.abs(result.value - GAINS * common) ** 2 / (2.0 * result.sd**2) / (1.0 - weight)
    assert np.sqrt(np.mean(own)) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.mean(np.abs(common - 1.0) ** 2) / 2.0) == pytest.approx(
        np.median(result.common_sd), rel=0.5
    )


def test_amplitudes_without_a_reference_keep_phases_between_channels():
    rng = np.random.default_rng(3)
    result = stepped_amplitudes([record(rng, f, out_noise=1e-3) for f in FREQ], RATE)
    lead = GAINS[1] / np.abs(GAINS[1])
    np.testing.assert_allclose(result.value, np.broadcast_to(GAINS / lead, result.value.shape), atol=2e-3)
    assert np.all(result.sd < 1e-4)


def test_steps_at_one_frequency_are_averaged():
    rng = np.random.default_rng(4)
    gains = GAINS[:1]
    one = [stepped_frf([record(rng, 500.0, gains, out_noise=0.3)], RATE).sd[0, 0] for _ in range(20)]
    four = [
        stepped_frf([record(rng, 500.0, gains, out_noise=0.3) for _ in range(4)], RATE) for _ in range(20)
    ]
    assert np.mean([f.sd[0, 0] for f in four]) == pytest.approx(0.5 * np.mean(one), rel=0.15)
    error = np.array([f.value[0, 0] - gains[0, 0] for f in four])
    stated = np.sqrt(np.mean([f.sd[0, 0] ** 2 for f in four]))
    assert np.sqrt(np.mean(np.abs(error) ** 2) / 2.0) == pytest.approx(stated, rel=0.4)


def test_a_step_that_has_not_settled_is_told_and_skipped():
    rng = np.random.default_rng(5)
    step = record(rng, 600.0, GAINS[:1], out_noise=1e-3)
    ring = np.exp(-TIME / 0.01) * np.cos(2.0 * np.pi * 590.0 * TIME)
    late = Step(600.0, step.reference, step.responses + ring)
    assert "not_steady" in {n.code for n in stepped_frf([late], RATE, SteppedSine(settle=0.0)).notices}
    settled = stepped_frf([late], RATE, SteppedSine(settle=0.6))
    assert not settled.notices
    assert settled.value[0, 0] == pytest.approx(GAINS[0, 0], abs=1e-3)


def test_steps_are_cut_where_the_set_frequency_changes():
    column = np.array([0.0] * 3 + [100.0] * 5 + [np.nan] * 2 + [200.0] * 4)
    steps = steps_of(column, np.arange(14.0), np.arange(14.0)[None])
    assert [(one.freq_hz, one.reference[0], len(one.reference)) for one in steps] == [
        (100.0, 3.0, 5),
        (200.0, 10.0, 4),
    ]
    with pytest.raises(StapeskitError, match="the column freq_hz must be positive"):
        steps_of(np.zeros(14), np.arange(14.0), np.arange(14.0)[None])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fit_sine(np.cos(TIME), RATE, 5000.0), "below half the sampling rate"),
        (lambda: fit_sine(np.cos(TIME), RATE, 10.0), "four cycles and 16 samples long"),
        (lambda: stepped_frf([], RATE), "a stepped sine must be of at least one step"),
        (lambda: SteppedSine(settle=1.0), "the share that settles must be"),
        (lambda: SteppedSine(harmonics=0), "the highest harmonic must be"),
        (lambda: SteppedSine(drift=9), "the degree of the drift must be"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(make, message):
    with pytest.raises(StapeskitError, match=message):
        make()


def test_a_silent_reference_is_refused():
    rng = np.random.default_rng(6)
    step = Step(500.0, rng.standard_normal(COUNT), record(rng, 500.0).responses)
    with pytest.raises(StapeskitError, match=r"a sine well above its noise; got noise \(step 1 at 500 Hz\)"):
        stepped_frf([step], RATE, SteppedSine(refine=False))


def test_a_step_of_another_frequency_is_refused():
    rng = np.random.default_rng(7)
    step = record(rng, 900.0)
    moved = [Step(700.0, step.reference, step.responses)]
    with pytest.raises(StapeskitError, match=r"the sine of a step must be within .* of its nominal 700 Hz"):
        stepped_frf(moved, RATE)
    with pytest.raises(StapeskitError, match="the reference must be a sine well above its noise"):
        stepped_frf(moved, RATE, SteppedSine(refine=False))


@pytest.mark.parametrize("estimate", [stepped_frf, stepped_amplitudes])
def test_the_faults_of_all_steps_are_told_at_once(estimate):
    rng = np.random.default_rng(8)
    good = record(rng, 500.0)
    steps = [
        good,
        Step(RATE, good.reference, good.responses),
        Step(500.0, good.reference[:20], good.responses[:, :20]),
        Step(800.0, good.reference, good.responses),
    ]
    with pytest.raises(StapeskitError) as caught:
        estimate(steps, RATE)
    told = str(caught.value).splitlines()
    places = [f"step 2 at {RATE:g} Hz", "step 3 at 500 Hz", "step 4 at 800 Hz"]
    assert [place in line for place, line in zip(places, told, strict=True)] == [True] * 3


@pytest.mark.parametrize("run_hz", [2.0, -6.0])
def test_a_frequency_that_runs_within_a_step_is_followed(run_hz):
    """Amplitudes and phases at its mean are exact; a fit of one frequency would lose amplitude."""
    phase = 2.0 * np.pi * TIME * (700.0 + 0.5 * run_hz * (TIME * RATE / COUNT - 1.0))
    fit = fit_sine(np.vstack([np.cos(phase + 0.3), 2.0 * np.sin(phase)]), RATE, 700.0)
    assert fit.freq_hz == pytest.approx(700.0, abs=5e-3)
    assert fit.run_hz == pytest.approx(run_hz, rel=2e-3)
    np.testing.assert_allclose(np.abs(fit.amplitude), [1.0, 2.0], rtol=2e-4)
    assert fit.amplitude[0] / fit.amplitude[1] == pytest.approx(
        0.5 * np.exp(1j * (0.3 + np.pi / 2)), rel=1e-4
    )
    plain = fit_sine(np.cos(phase + 0.3), RATE, 700.0, SteppedSine(refine=False))
    assert abs(abs(plain.amplitude[0]) - 1.0) > 1e-3


def test_a_running_frequency_is_told_and_noise_is_none():
    rng = np.random.default_rng(6)
    steps = []
    for freq in FREQ:
        wave = np.exp(2j * np.pi * TIME * (freq + 0.5e-3 * freq * (TIME * RATE / COUNT - 1.0)))
        steps.append(Step(freq, wave.real, np.real(GAINS * wave) + 0.05 * rng.standard_normal((4, COUNT))))
    made = stepped_frf(steps, RATE, SteppedSine(settle=0.0))
    (text,) = [one.text for one in made.notices if one.code == "frequency_runs"]
    assert "1e+03 ppm" not in text
    assert np.mean(np.abs(made.value - GAINS) ** 2 / 2.0 / made.sd**2) < 1.6
    still = [record(rng, f, out_noise=0.3) for f in FREQ]
    assert not [one for one in stepped_frf(still, RATE).notices if one.code == "frequency_runs"]

"""Frequency responses from time series against closed forms and Monte Carlo."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from legacy.kinematics.signals.frf import Welch, effective_averages, segment_for, welch_frf
from legacy.kinematics.signals.frf_periodic import Periodic, periodic_frf
from legacy.stapeskit.faults import StapeskitError

RATE = 1000.0
GAINS = np.array([[1.0], [2.0], [-0.5], [3.0]])


def plant(freq_hz):
    """Return 0.5 / (1 - 0.4 z^-1), the response of the filter below."""
    return 0.5 / (1.0 - 0.4 * np.exp(-2j * np.pi * freq_hz / RATE))


def random_record(rng, in_noise, out_noise, samples=4096, gains=GAINS[:1]):
    drive = rng.standard_normal(samples)
    response = gains * lfilter([0.5], [1.0, -0.4], drive)
    return (
        drive + in_noise * rng.standard_normal(samples),
        response + out_noise * rng.standard_normal(response.shape),
    )


def replicas(how, in_noise, out_noise, count=120, seed=0, gains=GAINS[:1]):
    """Return H (replica, channel, line), stated sd and true H."""
    rng = np.random.default_rng(seed)
    made = [
        welch_frf([random_record(rng, in_noise, out_noise, gains=gains)], RATE, how) for _ in range(count)
    ]
    value = np.array([one.value for one in made])
    return made, value, np.array([one.sd for one in made]), gains * plant(made[0].freq_hz)


@pytest.mark.parametrize(
    ("how", "noise"),
    [
        (Welch(256), (0.0, 0.5)),
        (Welch(256, overlap=0.75), (0.0, 0.5)),
        (Welch(256, "none", 0.0), (0.0, 0.5)),
        (Welch(1024), (0.0, 1.0)),
        (Welch(256), (0.3, 0.2)),
        (Welch(256, estimator="h2"), (0.5, 0.0)),
        (Welch(256, estimator="h2"), (0.3, 0.3)),
        (Welch(256, estimator="hv"), (0.3, 0.3)),
        (Welch(256, estimator="hv", noise_ratio=1.0), (0.3, 0.3)),
    ],
)
def test_the_stated_sd_is_that_of_the_estimate(how, noise):
    _, value, sd, _ = replicas(how, *noise)
    spread = np.var(value, axis=0, ddof=1) / 2.0
    assert np.sqrt(np.mean(spread) / np.mean(sd**2)) == pytest.approx(1.0, abs=0.04)


def test_bias_is_where_the_noise_is():
    """H1 is low by the noise in the reference, H2 high by that in the response, Hv is right."""
    noise = 0.3
    low = 1.0 / (1.0 + noise**2)
    _, value, _, true = replicas(Welch(256), noise, 0.0)
    assert np.mean(value / true) == pytest.approx(low, abs=0.004)
    _, value, _, true = replicas(Welch(256), 0.0, noise)
    assert np.mean(value / true) == pytest.approx(1.0, abs=0.004)
    made, value, _, true = replicas(Welch(256, estimator="h2"), 0.0, noise)
    high = np.mean(1.0 + noise**2 / np.abs(true) ** 2)
    assert np.mean((value / true).real) == pytest.approx(high, rel=0.01)
    _, value, _, true = replicas(Welch(256, estimator="h2"), noise, 0.0)
    assert np.mean(value / true) == pytest.approx(1.0, abs=0.004)
    _, value, _, true = replicas(Welch(256, estimator="hv", noise_ratio=1.0), noise, noise)
    assert np.mean(value / true) == pytest.approx(1.0, abs=0.004)
    del made


def test_coherence_is_the_share_of_power_that_follows_the_reference():
    made, _, _, true = replicas(Welch(128), 0.0, 0.5)
    share = np.abs(true[0]) ** 2 / (np.abs(true[0]) ** 2 + 0.5**2)
    found = np.mean([one.coherence[0] for one in made], axis=0)
    np.testing.assert_allclose(found, share, atol=0.03)


def test_without_noise_and_leakage_the_response_is_exact():
    rng = np.random.default_rng(1)
    drive = rng.standard_normal(2048)
    result = welch_frf([(drive, np.array([3.0 * drive, -drive]))], RATE, Welch(256))
    np.testing.assert_allclose(result.value, np.full(result.value.shape, [[3.0], [-1.0]]), rtol=1e-12)
    assert np.max(result.sd) < 1e-6
    np.testing.assert_allclose(result.coherence, 1.0, rtol=1e-12)


def test_effective_averages_of_known_overlaps():
    """Hann at 50 %: rho = (1/6)^2; without overlap and for one segment the count itself."""
    hann = Welch(512).taper()
    assert effective_averages(hann, 512, 10) == pytest.approx(10.0)
    assert effective_averages(hann, 256, 1) == pytest.approx(1.0)
    assert 1000 / effective_averages(hann, 256, 1000) == pytest.approx(1.0 + 2.0 / 36.0, rel=2e-3)


def test_records_are_averaged_as_one_long_record_is():
    rng = np.random.default_rng(2)
    records = [random_record(rng, 0.0, 0.5, 2048) for _ in range(4)]
    whole = welch_frf(records, RATE, Welch(256, overlap=0.0))
    joined = (np.concatenate([x for x, _ in records]), np.concatenate([y for _, y in records], axis=1))
    one = welch_frf([joined], RATE, Welch(256, overlap=0.0))
    np.testing.assert_allclose(whole.value, one.value, rtol=1e-12)
    assert whole.n_avg == pytest.approx(32.0)


def test_units_scale_through():
    rng = np.random.default_rng(3)
    drive, response = random_record(rng, 0.0, 0.4)
    for estimator in ("h1", "h2", "hv"):
        how = Welch(256, estimator=estimator)
        one = welch_frf([(drive, response)], RATE, how)
        other = welch_frf([(7.0 * drive, 1e-6 * response)], RATE, how)
        np.testing.assert_allclose(other.value, one.value * 1e-6 / 7.0, rtol=1e-9)
        np.testing.assert_allclose(other.sd, one.sd * 1e-6 / 7.0, rtol=1e-6)
        np.testing.assert_allclose(other.reference, one.reference * 7.0, rtol=1e-9)


def test_noise_of_the_reference_is_common_to_channels_and_told_apart():
    made, value, sd, true = replicas(Welch(256), 0.3, 0.05, 80, gains=GAINS)
    assert all("reference_noise" in {notice.code for notice in one.notices} for one in made)
    assert re.search(r"H1 reads all of them [789](\.\d)? % low for it", made[0].notices[0].text)
    weight = np.abs(GAINS) ** 2 / np.sum(GAINS**2)
    common = np.sum(weight * value / true, axis=1, keepdims=True)
    own = np.mean(np.abs(value - true * common) ** 2, axis=0) / 2.0 / (1.0 - weight)
    assert np.sqrt(np.mean(own / np.mean(sd**2, axis=0))) == pytest.approx(1.0, abs=0.06)
    spread = np.std(common[:, 0].real)
    assert np.median([one.common_sd for one in made]) == pytest.approx(spread, rel=0.2)
    quiet, *_ = replicas(Welch(256), 0.0, 0.5, 30, gains=GAINS)
    assert not any(one.notices for one in quiet)
    assert all(np.all(one.common_sd == 0.0) for one in quiet)


def periodic_record(rng, in_noise, out_noise, periods, samples=512, gains=GAINS[:1], cubic=0.0, colour=0.0):
    lines = np.arange(10, 200, 3)
    phase = rng.uniform(0.0, 2.0 * np.pi, len(lines))
    period = np.cos(2.0 * np.pi * np.outer(np.arange(samples), lines) / samples + phase).sum(axis=1)
    drive = np.tile(period, periods)
    response = gains * lfilter([0.5], [1.0, -0.4], drive + cubic * drive**3)
    noise = lfilter([1.0], [1.0, -colour], rng.standard_normal(response.shape))
    return drive + in_noise * rng.standard_normal(len(drive)), response + out_noise * noise


@pytest.mark.parametrize(
    ("noise", "periods", "colour"), [((0.0, 1.0), 9, 0.0), ((0.5, 1.0), 9, 0.0), ((0.0, 1.0), 4, 0.9)]
)
def test_the_sd_over_periods_is_that_of_the_estimate(noise, periods, colour):
    rng = np.random.default_rng(4)
    made = [
        periodic_frf([periodic_record(rng, *noise, periods, colour=colour)], RATE, Periodic(512 / RATE))
        for _ in range(100)
    ]
    np.testing.assert_allclose(made[0].freq_hz, np.arange(10, 200, 3) * RATE / 512)
    error = np.array([one.value - plant(one.freq_hz) for one in made])
    sd = np.array([one.sd for one in made])
    assert np.sqrt(np.mean(np.abs(error) ** 2) / 2.0 / np.mean(sd**2)) == pytest.approx(1.0, abs=0.04)


def test_a_period_of_a_fraction_of_samples_is_joined_to_whole_ones():
    assert Periodic(0.1025).block(1000.0) == (205, 2)
    with pytest.raises(StapeskitError, match="the period must be whole samples"):
        Periodic(0.1 * np.sqrt(2.0)).block(1000.0)


def test_records_that_differ_widen_the_sd():
    rng = np.random.default_rng(5)
    records = [periodic_record(rng, 0.0, 0.2, 5, cubic=0.005) for _ in range(4)]
    result = periodic_frf(records, RATE, Periodic(512 / RATE))
    assert "records_differ" in {notice.code for notice in result.notices}
    same = [periodic_record(rng, 0.0, 0.2, 5) for _ in range(4)]
    straight = periodic_frf(same, RATE, Periodic(512 / RATE))
    assert "records_differ" not in {notice.code for notice in straight.notices}
    assert np.median(result.sd) > 2.0 * np.median(straight.sd)


def test_few_averages_are_told():
    rng = np.random.default_rng(6)
    result = welch_frf([random_record(rng, 0.0, 0.2)], RATE, Welch(2048))
    assert [notice.code for notice in result.notices] == ["few_averages"]
    result = periodic_frf([periodic_record(rng, 0.0, 0.2, 3)], RATE, Periodic(512 / RATE))
    assert [notice.code for notice in result.notices] == ["few_averages"]


def test_bad_signals_are_refused():
    rng = np.random.default_rng(7)
    drive, response = random_record(rng, 0.0, 0.1, 1024)
    how = Welch(256)
    with pytest.raises(StapeskitError, match="segments long; got 1 of 1024 samples"):
        welch_frf([(drive, response)], RATE, Welch(1024))
    with pytest.raises(StapeskitError, match="the samples must be finite numbers"):
        welch_frf([(np.where(np.arange(1024) == 3, np.nan, drive), response)], RATE, how)
    with pytest.raises(StapeskitError, match="the reference must be a signal; got one value"):
        welch_frf([(np.ones(1024), response)], RATE, how)
    with pytest.raises(StapeskitError, match="reference and responses must be of shapes"):
        welch_frf([(drive[:-1], response)], RATE, how)
    with pytest.raises(StapeskitError, match="the sampling rate must be positive"):
        welch_frf([(drive, response)], 0.0, how)
    with pytest.raises(StapeskitError, match="the records must be at least one"):
        welch_frf([], RATE, how)
    with pytest.raises(StapeskitError, match="the records must be of the same channels"):
        welch_frf([(drive, response), (drive, np.vstack([response, response]))], RATE, how)
    with pytest.raises(StapeskitError, match="at least two blocks of periods long; got 1 blocks"):
        periodic_frf([(drive, response)], RATE, Periodic(512 / RATE))
    with pytest.raises(StapeskitError, match="the reference must be periodic"):
        periodic_frf([(rng.standard_normal(4096), rng.standard_normal((1, 4096)))], RATE, Periodic(0.128))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Welch(256, estimator="h3"), "the estimator must be h1, h2, hv"),
        (lambda: Welch(256, window="kaiser"), "the window must be none, hann"),
        (lambda: Welch(256, overlap=1.0), "the overlap must be between 0 and 0.95"),
        (lambda: Welch(4), "a segment must be of at least 8 samples"),
        (lambda: Welch(256, noise_ratio=0.0), "the noise ratio must be positive"),
        (lambda: Periodic(-1.0), "the period must be positive"),
        (lambda: Periodic(1.0, -1), "the skipped periods must be 0 or more"),
        (lambda: Periodic(1.0, threshold=1.0), "the threshold of excited lines must be"),
    ],
)
def test_options_out_of_range(make, message):
    with pytest.raises(StapeskitError, match=message):
        make()


def test_segments_fill_a_record():
    length = segment_for(10000, 30, 0.5)
    assert 1 + (10000 - length) // Welch(length).hop == 30


@pytest.mark.parametrize("estimator", ["h1", "h2", "hv"])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_noise_of_channels_that_an_estimator_takes_for_signal_is_told(estimator, noise):
    rng = np.random.default_rng(12)
    drive = rng.standard_normal(30_000)
    answer = np.array([[1.0], [2.0], [3.0], [0.5]]) * drive
    answer = answer + noise * rng.standard_normal(answer.shape)
    drive = drive + 0.2 * rng.standard_normal(len(drive))
    made = welch_frf([(drive, answer)], 8192.0, Welch(512, estimator=estimator))
    told = [one.text for one in made.notices if one.code == "estimator_bias"]
    assert bool(told) == (estimator != "h1" and noise > 0.0)
    if told:
        high = 0.36 if estimator == "h2" else 0.18
        assert np.median(np.abs(made.value[3])) / np.median(np.abs(made.value[1])) * 4.0 > 1.0 + 0.6 * high


@pytest.mark.parametrize("window", ["hann", "flattop"])
def test_a_window_that_is_made_for_sines_is_told(window):
    rng = np.random.default_rng(13)
    made = welch_frf([random_record(rng, 0.0, 0.1)], RATE, Welch(256, window))
    assert bool([one for one in made.notices if one.code == "window_wide"]) == (window == "flattop")


@pytest.mark.parametrize("late", [0, 2])
@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_records_whose_reference_is_late_are_told(late, noise):
    rng = np.random.default_rng(14)
    records = []
    for number in range(8):
        drive, answer = random_record(rng, 0.0, 0.05, gains=np.array([[1.0], [2.0], [-1.5], [0.7]]))
        drive = np.roll(drive, late) if number == 4 else drive
        records.append((drive + noise * rng.standard_normal(len(drive)), answer))
    notices = welch_frf(records, RATE, Welch(512)).notices
    told = [one.text for one in notices if one.code == "records_late"]
    assert bool(told) == bool(late)
    if late:
        assert told[0].startswith("1 of 8 records")
        assert "(record 5)" in told[0]

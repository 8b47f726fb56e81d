"""Repeats: the pooled mean and its noise, and the tests of scatter and of one repeat."""

from __future__ import annotations

import numpy as np
import pytest

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.repeats import pool_repeats

LINES, CHANNELS = 80, 6


def repeated(seed, count=6, stated=True, gains=None, sd=0.02, extra=0.0, missing=0.0):
    """Return repeats of one run and the true values (c, L); ``extra`` is noise beyond the stated one."""
    rng = np.random.default_rng(seed)
    course = np.exp(1j * np.linspace(0.0, 3.0, LINES)) / (0.3 + np.linspace(0.0, 1.0, LINES))
    true = rng.uniform(0.5, 1.5, (CHANNELS, 1)) * course
    spread = sd * rng.uniform(0.7, 1.4, (1, CHANNELS, 1)) * np.ones((count, CHANNELS, LINES))
    noise = rng.normal(size=(*spread.shape, 2)).view(complex)[..., 0]
    factors = np.ones(count) if gains is None else np.asarray(gains)
    value = factors[:, None, None] * true + np.hypot(1.0, extra) * spread * noise
    value[rng.random(value.shape) < missing] = np.nan
    body = BodyChannels(
        "stapes",
        tuple(str(k) for k in range(CHANNELS)),
        rng.normal(size=(CHANNELS, 3)) * 1e-3,
        np.tile([0.0, 0.0, 1.0], (CHANNELS, 1)),
        value,
        spread if stated else None,
    )
    repeats = tuple(Repeat("a", str(k + 1)) for k in range(count))
    names = tuple(f"{repeat.run} repeat {repeat.repeat}" for repeat in repeats)
    return Measurement("footplate", names, np.linspace(100.0, 900.0, LINES), (body,), repeats=repeats), true


def codes(compared):
    return {notice.code for notice in compared[0].notices}


def differ(compared):
    """Return the one text that says how repeats differ."""
    (notice,) = compared[0].notices
    assert notice.code == "repeats_differ"
    return notice.text


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_the_pooled_mean_has_its_stated_noise(stated, missing):
    ratios = []
    for seed in range(8):
        measurement, true = repeated(seed, stated=stated, missing=missing)
        pooled, compared = pool_repeats(measurement)
        assert pooled.runs == ("a",)
        assert pooled.repeats == ()
        body = pooled.bodies[0]
        error = (body.value[0] - true) / body.sd[0]
        ratios.append(np.mean(np.abs(error) ** 2) / 2.0)
        assert codes(compared) == set()
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.08)


def test_repeats_that_scatter_more_than_stated_are_widened():
    measurement, true = repeated(1, extra=1.0)
    pooled, compared = pool_repeats(measurement)
    assert "1.4 times" in differ(compared)
    assert compared[0].scatter == pytest.approx(np.sqrt(2.0), rel=0.05)
    error = (pooled.bodies[0].value[0] - true) / pooled.bodies[0].sd[0]
    assert np.mean(np.abs(error) ** 2) / 2.0 == pytest.approx(1.0, abs=0.15)


def test_gains_are_removed_before_pooling_and_a_drift_is_reported():
    gains = 1.0 + 0.06 * np.arange(6)
    measurement, true = repeated(2, gains=gains)
    pooled, compared = pool_repeats(measurement)
    assert "--reference" in differ(compared)
    assert np.abs(compared[0].gains) == pytest.approx(gains / np.exp(np.mean(np.log(gains))), abs=3e-3)
    assert np.mean(np.abs(pooled.bodies[0].value[0] - np.exp(np.mean(np.log(gains))) * true)) < 0.02


def test_one_repeat_that_is_off_is_named():
    measurement, _ = repeated(3, stated=False)
    measurement.bodies[0].value[3, 2] *= 1.15
    assert "repeat 4" in differ(pool_repeats(measurement)[1])


@pytest.mark.parametrize(("count", "gain"), [(6, 1.15), (4, -1.0)])
def test_one_repeat_of_another_gain_or_sign_is_named(count, gain):
    gains = np.ones(count)
    gains[3] = gain
    assert "repeat 4" in differ(pool_repeats(repeated(3, count=count, gains=gains)[0])[1])


@pytest.mark.parametrize("gains", [(1.0, 2.0), (1.0, -1.0), (1.0, 1.0, 0.7)])
def test_few_repeats_that_differ_in_gain_or_sign_are_reported(gains):
    _, (compared,) = pool_repeats(repeated(3, count=len(gains), gains=gains)[0])
    assert f"of {len(gains)} repeats" in compared.notices[0].text


def test_a_repeat_of_the_other_sign_does_not_turn_the_mean():
    measurement, true = repeated(3, count=4, gains=[1.0, 1.0, 1.0, -1.0])
    pooled, _ = pool_repeats(measurement)
    assert np.mean(np.abs(pooled.bodies[0].value[0] - true)) < 0.02


def test_gains_that_scatter_without_order_raise_no_alarm():
    """The level of a shaker differs from repeat to repeat; the pooled mean is that of its mean."""
    rng = np.random.default_rng(5)
    found = [pool_repeats(repeated(k, gains=1.0 + 0.03 * rng.normal(size=6))[0])[1] for k in range(40)]
    assert sum(bool(codes(compared)) for compared in found) <= 1


def test_clean_repeats_raise_few_alarms():
    alarms = sum(bool(codes(pool_repeats(repeated(seed)[0])[1])) for seed in range(100, 160))
    assert alarms <= 2

"""Tests on repeats one by one: trends, levels, outliers, shifts and noise as they were put in."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.measurement import BodyChannels, Take
from legacy.kinematics.repeats.contrast_sums import ContrastSums, contrasts, energy_of
from legacy.kinematics.repeats.repeat_shapes import Stack, shapes_of
from legacy.kinematics.repeats.repeat_shift import frequency_shifts
from legacy.kinematics.repeats.repeat_tests import gain_tests, regressors, scatter_test, shape_tests
from legacy.kinematics.repeats.scatter_noise import scatter_noise

FREQ = np.linspace(400.0, 5000.0, 60)
CHANNELS = 12
NOISE = 0.01


def resonances(rng, freq_hz, factor=1.0):
    """Responses (channel, freq) with two resonances, whose frequencies are multiplied by a factor."""
    value = np.ones((CHANNELS, len(freq_hz)), dtype=complex)
    for f0, zeta in ((1753.0, 0.12), (2783.0, 0.14)):
        ratio = freq_hz / (f0 * factor)
        value += rng.normal(size=(CHANNELS, 1)) / (1.0 - ratio**2 + 2j * zeta * ratio)
    return value


def stack_of(values, *, noise=NOISE, seed=0, stated=True, louder=1.0):
    """Add noise to takes (take, channel, freq): stated sd ``noise``, true sd ``louder`` times it."""
    rng = np.random.default_rng([seed, 1])
    shape = (*np.shape(values), 2)
    read = values + louder * noise * (rng.normal(size=shape) @ np.array([1.0, 1j]))
    points = tuple(str(c // 3) for c in range(CHANNELS))
    beams = np.tile(np.eye(3), (CHANNELS // 3, 1))
    body = BodyChannels(
        "stapes",
        points,
        rng.normal(size=(CHANNELS, 3)),
        beams,
        read,
        np.full(np.shape(values), noise) if stated else None,
        not stated,
    )
    return Stack((body,), tuple(range(len(values))), np.ones(len(FREQ)))


def takes(gains, seed=0):
    value = resonances(np.random.default_rng(seed), FREQ)
    return np.asarray(gains, dtype=complex)[:, None, None] * value


def named(tests):
    return {test.name: test for test in tests}


@pytest.fixture(scope="module")
def clean():
    return [shapes_of(stack_of(takes(np.ones(6), seed), seed=seed)) for seed in range(40)]


def test_gains_that_drift_are_a_trend_of_that_size():
    gains = np.exp(0.02 * np.arange(6))
    tests = named(gain_tests(shapes_of(stack_of(takes(gains))), np.arange(6.0), None))
    assert tests["gain_trend"].p_value < 1e-6
    assert tests["gain_trend"].size == pytest.approx(np.expm1(0.1), rel=0.02)
    assert tests["phase_trend"].p_value > 1e-3


def test_phases_that_drift_are_a_trend_in_rad():
    gains = np.exp(0.01j * np.arange(6))
    tests = named(gain_tests(shapes_of(stack_of(takes(gains))), np.arange(6.0), None))
    assert tests["phase_trend"].p_value < 1e-6
    assert tests["phase_trend"].size == pytest.approx(0.05, rel=0.03)


def test_one_other_gain_is_an_outlier():
    gains = np.exp(1e-3 * np.random.default_rng(1).normal(size=8))
    gains[3] *= 1.2
    test = named(gain_tests(shapes_of(stack_of(takes(gains))), None, None))["gain_outlier"]
    assert test.take == 3
    assert test.p_value < 1e-6
    assert test.size == pytest.approx(0.2, rel=0.03)


@pytest.mark.parametrize("power", [1.0, 0.8])
def test_the_exponent_of_the_level_is_found(power):
    level = np.linspace(-1.0, 1.0, 7)
    test = named(gain_tests(shapes_of(stack_of(takes(np.exp(power * level)))), None, level))["gain_level"]
    assert test.size == pytest.approx(power - 1.0, abs=2e-3)
    assert (test.p_value < 1e-6) == (power != 1.0)


def test_a_shape_that_changes_in_time_is_a_trend():
    value = takes(np.ones(6))
    value[:, 4] *= np.exp(0.01 * np.arange(6))[:, None]
    tests = named(shape_tests(shapes_of(stack_of(value)), np.arange(6.0), None, stated=True))
    assert tests["shape_trend"].p_value < 1e-6
    assert tests["shape_trend"].share > 0.9


def test_a_shape_of_one_take_is_an_outlier():
    value = takes(np.ones(6))
    value[2, 7] *= 1.1
    tests = named(shape_tests(shapes_of(stack_of(value)), None, None, stated=True))
    assert tests["shape_outlier"].take == 2
    assert tests["shape_outlier"].p_value < 1e-6


def test_clean_repeats_alarm_as_rarely_as_their_p_values_say(clean):
    time = np.arange(6.0)
    p_values = [test.p_value for shapes in clean for test in shape_tests(shapes, time, None, stated=True)]
    p_values += [test.p_value for shapes in clean for test in gain_tests(shapes, time, None)]
    assert len(p_values) > 150
    assert np.mean(np.array(p_values) < 0.05) < 0.1
    assert np.min(p_values) > 1e-4


def test_scatter_over_the_stated_noise_is_the_factor_on_it(clean):
    quiet = [scatter_test(shapes, stated=True) for shapes in clean]
    assert np.mean([test.size for test in quiet]) == pytest.approx(1.0, abs=0.01)
    assert np.mean([test.p_value < 0.05 for test in quiet]) < 0.15
    loud = scatter_test(shapes_of(stack_of(takes(np.ones(6)), louder=1.2)), stated=True)
    assert loud.size == pytest.approx(1.2, rel=0.03)
    assert loud.p_value < 1e-6


def test_noise_that_is_not_stated_comes_from_the_scatter():
    ratio = []
    for seed in range(6):
        shapes = shapes_of(stack_of(takes(np.ones(6), seed), seed=seed, stated=False))
        noise = scatter_noise(shapes)
        ratio.append(np.mean(noise * shapes.noise_scale) / NOISE)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.03)


def test_two_takes_of_few_lines_show_no_noise():
    short = stack_of(takes(np.ones(2))[:, :, :2], stated=False)
    short = Stack(short.bodies, short.places, np.ones(2))
    assert scatter_noise(shapes_of(short)) is None


def test_a_shift_of_resonances_is_found_take_by_take():
    shift = np.array([-0.004, 0.0, 0.001, 0.003])
    value = np.stack([resonances(np.random.default_rng(4), FREQ, np.exp(s)) for s in shift])
    found, share = frequency_shifts(
        shapes_of(stack_of(value, noise=1e-4)), FREQ, np.zeros(CHANNELS, dtype=np.intp)
    )
    assert np.allclose(found, shift, atol=3e-4)
    assert share > 0.9


def test_too_few_lines_show_no_shift():
    stack = stack_of(takes(np.ones(3))[:, :, :5])
    stack = Stack(stack.bodies, stack.places, np.ones(5))
    found, share = frequency_shifts(shapes_of(stack), FREQ[:5], np.zeros(CHANNELS, dtype=np.intp))
    assert np.all(np.isnan(found))
    assert share == 0.0


def test_repeats_are_ordered_by_their_numbers():
    order = [Take("1", name, level) for name, level in (("10", 1.0), ("9", 2.0), ("2", 4.0))]
    time, level = regressors(order)
    assert time.tolist() == [2.0, 1.0, 0.0]
    assert np.allclose(level, np.log([1.0, 2.0, 4.0]))
    time, level = regressors([Take("1", "a", np.nan), Take("1", "a", np.nan)])
    assert time is None
    assert level is None


def test_contrasts_are_orthonormal_and_orthogonal_to_the_gains():
    rng = np.random.default_rng(0)
    gain = rng.normal(size=(5, 6, 2)) @ np.array([1.0, 1j])
    gain /= np.linalg.norm(gain, axis=1, keepdims=True)
    basis = contrasts(gain, [np.arange(6.0), rng.normal(size=6)])
    assert np.allclose(np.einsum("ftk,ftl->fkl", basis.conj(), basis), np.eye(2))
    assert np.allclose(np.einsum("ft,ftk->fk", gain.conj(), basis), 0.0)


@pytest.mark.parametrize("correlated", [False, True])
def test_p_values_of_energies_are_uniform(correlated):
    """Energies of complex noise, independent or the same at two neighbouring lines."""
    lines, count, channels = 40, 5, 4
    p_values = []
    for seed in range(300):
        rng = np.random.default_rng([seed, correlated])
        noise = rng.normal(size=(lines // 2 if correlated else lines, count, channels, 2)) @ [1.0, 1j]
        noise = np.repeat(noise, 2, axis=0) if correlated else noise
        sums = ContrastSums()
        sums.add(noise[:, 0], noise[:, 1:])
        p_values.append(sums.compared(lines * channels, lines * channels * (count - 1), False)[0])
    assert np.mean(np.array(p_values) < 0.1) == pytest.approx(0.1, abs=0.05)
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.06)


def test_energy_is_the_sum_of_squares():
    assert energy_of(np.array([[3.0 + 4.0j, 1.0]])) == pytest.approx(26.0)

"""Noise and numbers of recordings: what coherence and averages say, and what no recording may hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.readers.recording import Recording
from legacy.kinematics.readers.reported_noise import body_noise
from legacy.kinematics.readers.value_checks import in_mm, number_faults, value_faults
from legacy.stapeskit.faults import Place
from legacy.stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ

FREQ = np.linspace(500.0, 2500.0, 5)
VALUE = np.full(5, 3e-6 - 4e-6j)
RATE = 2.0 * np.pi * FREQ


def recording(**changes):
    return replace(Recording("7", FREQ, VALUE, 1, Place("scan.uff", "line", (3,))), **changes)


def noise_of(*recordings):
    value = np.stack([one.value / RATE for one in recordings])[None]
    entries = [((0, channel, np.arange(5)), one) for channel, one in enumerate(recordings)]
    return body_noise("stapes", entries, value, 1)


def test_coherence_and_averages_give_the_sd_of_one_part():
    sd, relative, _ = noise_of(recording(coherence=np.full(5, 0.9), n_avg=20.0))
    # Bendat and Piersol: |H| sqrt((1 - g2) / (2 n g2)) for the real part.
    assert np.allclose(sd[0, 0], 5e-6 * np.sqrt(0.1 / (2.0 * 20.0 * 0.9)) / RATE)
    assert not relative


def test_coherence_without_averages_is_known_up_to_a_factor():
    sd, relative, _ = noise_of(recording(coherence=np.full(5, 0.9)))
    assert relative
    assert np.allclose(sd[0, 0] * RATE, 5e-6 * np.sqrt(0.1 / 1.8))


def test_averages_alone_are_level_in_the_measured_quantity():
    sd, relative, _ = noise_of(recording(n_avg=4.0), recording(n_avg=16.0))
    assert relative
    assert np.allclose(sd[0, 0] * RATE, 0.5)
    assert np.allclose(sd[0, 1], 0.5 * sd[0, 0])


def test_a_channel_without_sd_beside_others_with_it_is_not_used():
    sd, _, notices = noise_of(recording(sd=np.full(5, 1e-8)), recording())
    assert np.allclose(sd[0, 0] * RATE, 1e-8)
    assert np.all(np.isnan(sd[0, 1]))
    assert [notice.code for notice in notices] == ["sd_missing"]


def test_no_word_on_noise_is_no_noise():
    assert noise_of(recording(), recording())[0] is None


@pytest.mark.parametrize(
    ("changes", "thing"),
    [
        ({"value": np.where(np.arange(5) == 2, np.inf, VALUE)}, "the values of point 7"),
        ({"value": np.where(np.arange(5) == 2, 2.0 * LARGEST, VALUE)}, "the values of point 7"),
        ({"sd": np.array([1.0, -1.0, 1.0, 1.0, 1.0])}, "the standard deviations of point 7"),
        ({"coherence": np.array([1.0, 1.2, 1.0, 1.0, 1.0])}, "the coherence of point 7"),
        ({"n_avg": 0.0}, "the number of averages"),
        ({"position_mm": np.array([1.0, np.nan, 0.0])}, "the position of point 7"),
        ({"position_mm": np.array([2.0 * FARTHEST_MM, 0.0, 0.0])}, "the position of point 7"),
        ({"freq_hz": FREQ * HIGHEST_HZ}, "the frequencies"),
        ({"freq_hz": FREQ * LOWEST_HZ * 1e-4}, "the frequencies"),
    ],
)
def test_numbers_that_no_recording_holds_are_named(changes, thing):
    faults = value_faults([recording(), recording(**changes)])
    assert [fault.thing for fault in faults] == [thing]


def test_missing_values_and_a_dc_line_are_no_faults():
    freq = np.concatenate([[0.0], FREQ[1:]])
    assert value_faults([recording(value=np.where(np.arange(5) == 2, np.nan, VALUE), freq_hz=freq)]) == []


def test_the_first_bad_number_is_named_with_its_place():
    numbers = np.arange(6.0).reshape(2, 3)
    (fault,) = number_faults("the matrix", numbers, numbers > 3.5, "below 3.5", "file.mat")
    assert "4 at place 2, 2 and 1 more" in str(fault)
    assert number_faults("the matrix", numbers, numbers > 9.0, "below 9", "file.mat") == []


def test_positions_are_in_mm():
    assert np.allclose(in_mm(np.array([[1e-3, 0.0, 2.0]]), 1.0), [[1.0, 0.0, 2000.0]])

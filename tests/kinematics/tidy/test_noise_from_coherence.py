"""Noise from coherence: against the scatter of simulated averages."""

import numpy as np
import pytest

from legacy.kinematics.tidy.noise_from_coherence import sd_from_coherence


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_the_sd_is_the_scatter_of_averaged_responses(noise):
    rng = np.random.default_rng(4)
    averages, trials = 40, 4000
    drive = np.sqrt(0.5) * (rng.standard_normal((trials, averages, 2)) @ [1.0, 1j])
    reading = (0.3 - 0.4j) * drive + noise * np.sqrt(0.5) * (
        rng.standard_normal((trials, averages, 2)) @ [1.0, 1j]
    )
    cross, power = np.sum(reading * drive.conj(), axis=1), np.sum(np.abs(drive) ** 2, axis=1)
    response = cross / power
    coherence = np.abs(cross) ** 2 / (power * np.sum(np.abs(reading) ** 2, axis=1))
    stated = np.sqrt(np.mean(sd_from_coherence(response, coherence, averages) ** 2))
    assert stated == pytest.approx(np.std(response.real), rel=0.05)


def test_a_coherence_that_says_nothing_gives_no_sd():
    sd = sd_from_coherence(np.ones(4, dtype=complex), np.array([0.0, 1.1, np.nan, 1.0]), 10.0)
    np.testing.assert_array_equal(sd, [np.nan, np.nan, np.nan, 0.0])

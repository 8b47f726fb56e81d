"""Noise that nobody stated, in proportion to each reading: no fault, and faults next to it are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corrections import errors
from benchmarks.fault_bodies import Reading, draw
from benchmarks.faults_gate import judged


def proportional(seed: int, body: str, lines: int, fault: str = "") -> Reading:
    """Draw readings with noise of 1 % of each of them, and a fault."""
    reading = draw(seed, body, fault, lines=lines, noise=1e-6)
    noise = np.random.default_rng([88, seed]).normal(size=(2, *reading.value.shape))
    return replace(reading, value=reading.value * (1.0 + 0.01 * (noise[0] + 1j * noise[1])))


@pytest.mark.parametrize("lines", [6, 16, 34])
def test_clean_files_raise_no_alarm(lines):
    """With noise that is alike in all channels at a line, 28 of 36 of these and like files did."""
    bodies = ("shell, 5 points, 3 heads", "rod, 8 points, 2-3 heads")
    found = [
        diagnosis.findings
        for body in bodies
        for seed in range(4)
        for diagnosis in judged(proportional(seed, body, lines), stated=False).diagnoses.values()
    ]
    assert sum(map(bool, found)) <= 1


@pytest.mark.parametrize("fault", ["sign", "gain 6 %", "position", "head sign", "names of points"])
def test_faults_are_found(fault):
    """Their errors depend on each other, whatever the size of the noise of each value."""
    reading = proportional(3, "shell, 12 points, 3 heads", 34, fault)
    result = judged(reading, stated=False)
    wrong = {c for c, channel in enumerate(result.channels) if channel.verdict != "ok"}
    assert {*reading.culprits} <= wrong


def test_the_motion_is_fitted_with_this_noise_and_the_file_is_told_so():
    reading = proportional(0, "rod, 8 points, 2-3 heads", 34)
    result = judged(reading, stated=False)
    texts = [notice.text for notice in result.notices if notice.code == "noise_estimated"]
    assert any("in proportion to each reading" in text for text in texts)
    assert 0.85 < np.mean(np.abs(errors(result, reading.twist.T)[1]) < 1.96) <= 1.0

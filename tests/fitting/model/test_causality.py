"""Causal laws need no check; the rise of a lossy one agrees with a fractional law of small exponent."""

from __future__ import annotations

import numpy as np
import pytest

from fitting.model.causality import causal_rise
from fitting.model.damping import DampingLaw
from fitting.model.laws import LAWS

BAND = (400.0, 5000.0)


@pytest.mark.parametrize("name", LAWS)
def test_real_and_imaginary_part_of_a_causal_law_are_hilbert_pairs(name: str) -> None:
    """s / (1 + s) is bounded and without poles in the lower half plane: its impulse response is causal."""
    law = DampingLaw(name, 0.6)
    count = 2**14
    omega = 2.0 * np.pi * np.fft.rfftfreq(count, 0.01)
    s = law.factor(np.maximum(omega, 1e-9))
    response = np.fft.irfft(s / (1.0 + s) * np.exp(-((omega / 60.0) ** 2)), count)
    before = np.sum(response[count // 2 : -60] ** 2) / np.sum(response**2)
    assert (before < 1e-6) == law.law.causal


def test_the_rise_is_that_of_a_power_law_with_the_same_loss() -> None:
    """(i w)^a has the loss factor tan(a pi / 2) and rises by the power a."""
    power = 0.02
    rise = causal_rise(DampingLaw("hysteretic"), np.tan(0.5 * np.pi * power), BAND)
    assert rise == pytest.approx((BAND[1] / BAND[0]) ** power - 1.0, rel=0.05)
    assert causal_rise(DampingLaw(), 0.3, BAND) is None

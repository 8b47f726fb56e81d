"""Which laws are causal; the rise of a lossy one agrees with a fractional law of small exponent."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.model.causality import causal_rise
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.laws import LAWS

BAND = (400.0, 5000.0)


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("exponent", [0.3, 0.9])
def test_a_causal_law_is_real_for_real_eigenvalues(name: str, exponent: float) -> None:
    """s(lambda) is the Laplace transform of a real response that begins at t = 0: real for lambda > 0."""
    law = DampingLaw(name, exponent)
    imaginary = [abs(law.at(place).imag) for place in (0.2, 1.0, 7.0)]
    assert (max(imaginary) < 1e-12) == law.law.causal


def test_the_rise_is_that_of_a_power_law_with_the_same_loss() -> None:
    """(i w)^a has the loss factor tan(a pi / 2) and rises by the power a."""
    power = 0.02
    rise = causal_rise(DampingLaw("hysteretic"), np.tan(0.5 * np.pi * power), BAND)
    assert rise == pytest.approx((BAND[1] / BAND[0]) ** power - 1.0, rel=0.05)
    assert causal_rise(DampingLaw(), 0.3, BAND) is None

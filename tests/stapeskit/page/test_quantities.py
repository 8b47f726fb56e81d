"""Units for people."""

import doctest

import numpy as np
import pytest

from legacy.stapeskit.page import quantities
from legacy.stapeskit.page.quantities import (
    FIRST_MOMENT,
    INERTIA,
    LENGTH,
    MASS,
    SMALL_LENGTH,
    VOLUME,
    diagonal_unit,
)


def test_examples():
    assert doctest.testmod(quantities).failed == 0


@pytest.mark.parametrize(
    ("unit", "si", "shown"),
    [(VOLUME, 1.5e-9, 1.5), (LENGTH, 0.0034, 3.4), (SMALL_LENGTH, 2e-6, 2.0)],
)
def test_factors_and_back(unit, si, shown):
    assert unit.of(si) == pytest.approx(shown)
    assert unit.si(unit.of(si)) == pytest.approx(si)
    assert unit.of(np.full(2, si)) == pytest.approx(np.full(2, shown))


def test_a_value_without_a_standard_deviation_says_so():
    assert LENGTH.with_sd(2e-3, None) == "2 ± unknown mm"


def test_moments_of_mass_follow_the_unit_of_mass():
    arm_m = 0.002
    assert FIRST_MOMENT.of(3e-6 * arm_m) == pytest.approx(MASS.of(3e-6) * LENGTH.of(arm_m))
    assert INERTIA.of(3e-6 * arm_m**2) == pytest.approx(MASS.of(3e-6) * LENGTH.of(arm_m) ** 2)
    assert (FIRST_MOMENT.symbol, INERTIA.symbol) == (f"{MASS.symbol} mm", f"{MASS.symbol} mm²")


@pytest.mark.parametrize(
    ("letter", "dof", "exponent", "symbol", "shown"),
    [("K", "y", 1.0, "N/m", 2.0), ("K", "alpha", 1.0, "N mm/rad", 2e3), ("D", "y", 1.0, "mN s/m", 2e3),
     ("D", "gamma", 1.0, "µN mm s/rad", 2e9), ("D", "y", 0.0, "N/m", 2.0), ("D", "x", 0.6, "N s^0.6/m", 2.0),
     ("D", "beta", 0.0, "N mm/rad", 2e3)],
)  # fmt: skip
def test_diagonal_entries_are_shown_in_the_unit_of_their_damping_law(letter, dof, exponent, symbol, shown):
    unit = diagonal_unit(letter, dof, exponent)
    assert unit.symbol == symbol
    assert unit.of(2.0) == pytest.approx(shown)

"""Numbers for people: what is written is read back within the rounding that its sd allows."""

import doctest
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stapeskit.report import quantities
from stapeskit.report.quantities import HALF_WIDTH_95, Quantity, matrix_units, plus_minus, si_unit

_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def read(text):
    """Return value and sd of a text that `plus_minus` wrote."""
    power = 0
    if text.startswith("("):
        text, _, raised = text[1:].partition(")·10")
        power = int(raised.translate(_RAISED))
    value, _, sd = text.partition(" ± ")
    return float(value) * 10.0**power, float(sd) * 10.0**power


def test_examples():
    found = doctest.testmod(quantities)
    assert found.attempted >= 8
    assert found.failed == 0


@given(st.floats(-1e12, 1e12), st.floats(1e-12, 1e12))
def test_a_value_is_written_to_the_second_digit_of_its_sd(value, sd):
    shown, spread = read(plus_minus(value, sd))
    digit = 10.0 ** (math.floor(math.log10(sd)) - 1)
    assert abs(spread - sd) <= 0.5001 * digit
    assert abs(shown - value) <= 0.5001 * 10.0 * digit + 1e-12 * abs(value)


@pytest.mark.parametrize("sd", [None, math.nan, math.inf, 0.0])
def test_an_unknown_sd_is_not_shown_as_a_number(sd):
    assert plus_minus(2.0, sd).rpartition(" ")[2] in ("unknown", "0")
    assert str(Quantity(2.0, sd)).rpartition(" ")[2] in ("2", "unknown", "0")


def test_an_interval_holds_95_percent_of_a_normal_distribution():
    assert math.erf(HALF_WIDTH_95 / math.sqrt(2.0)) == pytest.approx(0.95, abs=1e-7)
    lower, upper = Quantity(3.0e-3, 1.0e-5, quantities.LENGTH).limits
    np.testing.assert_allclose([lower, upper], 3.0 + 1e-2 * HALF_WIDTH_95 * np.array([-1.0, 1.0]))


# Factor of each prefix that a shown unit has, and the powers of mm among its factors.
_PREFIXES = {"m": 1e-3, "µ": 1e-6}


@pytest.mark.parametrize("letter", ["K", "D", "M"])
def test_the_factor_of_every_entry_is_that_of_its_symbol(letter):
    dof = ("x", "y", "z", "alpha", "beta", "gamma")
    for row in matrix_units(letter, dof):
        for unit in row:
            assert unit.per_si == pytest.approx(1.0 / factor(unit.symbol), rel=1e-12)


def factor(symbol):
    """Return how many SI units a symbol is: the product of its prefixes; kg counts as SI."""
    size = 1.0
    for part, sign in [(piece, 1) for piece in symbol.partition("/")[0].split()]:
        stem, power = (part[:-1], 2) if part.endswith("²") else (part, 1)
        if stem == "mg":
            size *= 1e-6
        elif len(stem) > 1 and stem[0] in _PREFIXES:
            size *= _PREFIXES[stem[0]] ** (sign * power)
    return size


def test_the_unit_of_damping_follows_its_law():
    assert si_unit("D", "y", "y", 1.0) == "N s/m"
    assert si_unit("D", "y", "y", 0.0) == si_unit("K", "y", "y") == "N/m"
    hysteretic = matrix_units("D", ("y", "gamma"), 0.0)
    assert hysteretic == matrix_units("K", ("y", "gamma"))

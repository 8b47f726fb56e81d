"""The units in which SI quantities are shown to people: one place for commands, reports and the study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.page.numbers import plus_minus

Value = TypeVar("Value", float, NDArray[np.float64])


@dataclass(frozen=True)
class ShownUnit:
    """A unit for people.

    Attributes
    ----------
    symbol : str
        As written behind a number.
    per_si : float
        How many of it make one SI unit.
    """

    symbol: str
    per_si: float

    def of(self, value: Value) -> Value:
        """Return SI values in this unit."""
        return value * self.per_si

    def si(self, shown: Value) -> Value:
        """Return values in this unit as SI values."""
        return shown / self.per_si

    def text(self, value: float, form: str = "g") -> str:
        """Return an SI value with the symbol.

        Examples
        --------
        >>> LENGTH.text(2.71828e-3, ".3f"), LENGTH.text(0.0031), SMALL_LENGTH.text(4.2e-6)
        ('2.718 mm', '3.1 mm', '4.2 µm')
        """
        return f"{self.of(value):{form}} {self.symbol}"

    def with_sd(self, value: float, sd: float | None) -> str:
        """Return an SI value with its standard deviation and the symbol.

        Examples
        --------
        >>> LENGTH.with_sd(2.71828e-3, 3e-5)
        '2.718 ± 0.030 mm'
        """
        return f"{plus_minus(self.of(value), None if sd is None else self.of(sd))} {self.symbol}"

    def times(self, other: ShownUnit) -> ShownUnit:
        """Return the product of two units.

        Examples
        --------
        >>> STIFFNESS.times(LENGTH)
        ShownUnit(symbol='N/m mm', per_si=1000.0)
        """
        return ShownUnit(f"{self.symbol} {other.symbol}", self.per_si * other.per_si)


# Unit of masses that are parameters of a fit, which are of order one in it, and in kd.json: it stays where
# people are shown another one.
MILLIGRAM = ShownUnit("mg", 1e6)
MASS = ShownUnit("mg", 1e6)
VOLUME = ShownUnit("mm³", 1e9)
LENGTH = ShownUnit("mm", 1e3)
AREA = ShownUnit("mm²", 1e6)
SMALL_LENGTH = ShownUnit("µm", 1e6)
STIFFNESS = ShownUnit("N/m", 1.0)
ROTATION_STIFFNESS = ShownUnit("N mm/rad", 1e3)
DAMPING = ShownUnit("mN s/m", 1e3)
ROTATION_DAMPING = ShownUnit("µN mm s/rad", 1e9)
COUPLING_STIFFNESS = ShownUnit("N", 1.0)
COUPLING_DAMPING = ShownUnit("µN s", 1e6)
FIRST_MOMENT = MASS.times(LENGTH)
INERTIA = MASS.times(AREA)


def time_unit(exponent: float | None) -> str:
    """Return the power of time in the unit of D as text: viscous damping has 1, hysteretic 0, None any."""
    if exponent is None:
        return " s^a"
    return {0.0: "", 1.0: " s"}.get(exponent, f" s^{exponent:.3g}")


def si_unit(letter: str, first: str, second: str, exponent: float | None = 1.0) -> str:
    """Return the SI unit of an entry of K or D between two degrees of freedom, as text.

    Examples
    --------
    >>> si_unit("K", "y", "y"), si_unit("D", "y", "alpha"), si_unit("D", "alpha", "alpha", 0.0)
    ('N/m', 'N s', 'N m/rad')
    """
    time = time_unit(exponent) if letter == "D" else ""
    return (f"N{time}/m", f"N{time}", f"N{time} m/rad")[(first not in "xyz") + (second not in "xyz")]


def diagonal_unit(letter: str, dof: str, exponent: float | None = 1.0) -> ShownUnit:
    """Return the unit in which a diagonal entry of K or D is shown.

    Parameters
    ----------
    letter : {"K", "D"}
    dof : str
        Degree of freedom: ``x``, ``y``, ``z``, or a rotation.
    exponent : float or None
        Power of time in the unit of D, of the damping law; None where it differs between ears.

    Examples
    --------
    >>> [diagonal_unit(*entry).symbol for entry in (("K", "y"), ("D", "gamma"), ("D", "y", 0.5))]
    ['N/m', 'µN mm s/rad', 'N s^0.5/m']
    """
    return _entry_unit(letter, 2 * (dof not in "xyz"), exponent)


def matrix_units(letter: str, dof: Sequence[str], exponent: float | None = 1.0) -> list[list[ShownUnit]]:
    """Return the unit in which each entry of K, D or M is shown, (n, n).

    Examples
    --------
    >>> [unit.symbol for unit in matrix_units("D", ("y", "alpha"))[1]]
    ['µN s', 'µN mm s/rad']
    """
    turns = [name not in "xyz" for name in dof]
    return [[_entry_unit(letter, row + column, exponent) for column in turns] for row in turns]


_BY_TURNS = {
    "K": (STIFFNESS, COUPLING_STIFFNESS, ROTATION_STIFFNESS),
    "D": (DAMPING, COUPLING_DAMPING, ROTATION_DAMPING),
    "M": (MASS, FIRST_MOMENT, INERTIA),
}


def _entry_unit(letter: str, turns: int, exponent: float | None) -> ShownUnit:
    if letter != "D" or exponent == 1.0:
        return _BY_TURNS[letter][turns]
    unit = _BY_TURNS["K"][turns]
    numerator, slash, denominator = unit.symbol.partition("/")
    return ShownUnit(numerator + time_unit(exponent) + slash + denominator, unit.per_si)

"""Show SI quantities to people: units, values with their standard deviation and 95 % interval.

Every message and page takes its numbers from here, as they are printed; nothing is replaced afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float64])

HALF_WIDTH_95 = 1.959964  # standard deviations of the normal distribution
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plus_minus(value: float, sd: float | None) -> str:
    """Write a value with its standard deviation, both to its second digit; one that is not finite is unknown.

    >>> plus_minus(1736.4, 17.2), plus_minus(13379, 2762), plus_minus(3.0531e-08, 7.2e-10)
    ('1736 ± 17', '13400 ± 2800', '(3.053 ± 0.072)·10⁻⁸')
    >>> plus_minus(-1e-5, 0.014), plus_minus(float("nan"), 1.0)
    ('0.000 ± 0.014', 'undetermined')
    """
    if not math.isfinite(value):
        return "undetermined"
    if sd is None or not 0.0 < sd < math.inf:
        return f"{value:.4g} ± {'0' if sd == 0.0 else 'unknown'}"
    power = math.floor(math.log10(max(abs(value), sd)))
    power = 0 if -3 < power < 6 else power
    value, sd = value * 10.0**-power, sd * 10.0**-power
    digits = _digits(sd)
    text = f"{_fixed(value, digits)} ± {_fixed(sd, digits)}"
    return text if power == 0 else f"({text})·10{str(power).translate(_RAISED)}"


def interval_text(lower: float, upper: float) -> str:
    """Write the limits of a 95 % interval to the second digit of the standard deviation it comes from.

    >>> interval_text(1702.7, 1770.1), interval_text(-2.1e-7, 3.3e-7)
    ('1703 to 1770', '-2.1e-07 to 3.3e-07')
    """
    width = (upper - lower) / (2.0 * HALF_WIDTH_95)
    largest = max(abs(lower), abs(upper))
    if not (math.isfinite(width) and width > 0.0 and 1e-3 <= largest < 1e6):
        return f"{lower:.4g} to {upper:.4g}"
    digits = _digits(width)
    return f"{_fixed(lower, digits)} to {_fixed(upper, digits)}"


def _digits(sd: float) -> int:
    """Return the decimals at which a standard deviation has two digits."""
    return 1 - math.floor(math.log10(float(f"{sd:.1e}")))


def _fixed(value: float, digits: int) -> str:
    """Write a rounded number; a zero has no sign."""
    return f"{round(value, digits) + 0.0:.{max(0, digits)}f}"


@dataclass(frozen=True)
class ShownUnit:
    """A unit for people: its symbol as written behind a number, and how many of it make one SI unit."""

    symbol: str
    per_si: float

    def of(self, value: Value) -> Value:
        """Return SI values in this unit."""
        return value * self.per_si

    def si(self, shown: Value) -> Value:
        """Return values in this unit as SI values."""
        return shown / self.per_si

    def text(self, value: float, form: str = "g") -> str:
        """Return an SI value with the symbol."""
        return f"{self.of(value):{form}} {self.symbol}".rstrip()

    def with_sd(self, value: float, sd: float | None) -> str:
        """Return an SI value with its standard deviation and the symbol.

        >>> LENGTH.with_sd(2.71828e-3, 3e-5), LENGTH.text(2.71828e-3, ".3f"), SMALL_LENGTH.text(4.2e-6)
        ('2.718 ± 0.030 mm', '2.718 mm', '4.2 µm')
        """
        return f"{plus_minus(self.of(value), None if sd is None else self.of(sd))} {self.symbol}".rstrip()


MASS = ShownUnit("mg", 1e6)
VOLUME = ShownUnit("mm³", 1e9)
LENGTH = ShownUnit("mm", 1e3)
AREA = ShownUnit("mm²", 1e6)
SMALL_LENGTH = ShownUnit("µm", 1e6)
PLAIN = ShownUnit("", 1.0)
HERTZ = ShownUnit("Hz", 1.0)
PERCENT = ShownUnit("%", 100.0)
STIFFNESS = ShownUnit("N/m", 1.0)
ROTATION_STIFFNESS = ShownUnit("N mm/rad", 1e3)
FIRST_MOMENT = ShownUnit("mg mm", 1e9)
INERTIA = ShownUnit("mg mm²", 1e12)

# Units of an entry by the number of rotations (0, 1, 2) among its two degrees of freedom; those of K in SI.
_SI_STIFFNESS = ("N/m", "N", "N m/rad")
_SHOWN = {
    "K": (STIFFNESS, ShownUnit("N", 1.0), ROTATION_STIFFNESS),
    "D": (ShownUnit("mN s/m", 1e3), ShownUnit("µN s", 1e6), ShownUnit("µN mm s/rad", 1e9)),
    "M": (MASS, FIRST_MOMENT, INERTIA),
}


@dataclass(frozen=True)
class Quantity:
    """A cell of a table: an SI value, its sd where it is known, and the unit in which people see it.

    The limits of a value that cannot be negative (``positive``) are those of its logarithm; below its sd it
    is undetermined.
    """

    value: float
    sd: float | None = None
    unit: ShownUnit = PLAIN
    positive: bool = False

    def __str__(self) -> str:
        """Return value, sd and unit.

        >>> str(Quantity(900.0, 950.0, HERTZ, positive=True)), str(Quantity(2.5e-3, None, LENGTH))
        ('undetermined (900 ± 950 Hz)', '2.5 mm')
        """
        if self.sd is None:
            return self.unit.text(self.value, ".4g")
        text = self.unit.with_sd(self.value, self.sd)
        return f"undetermined ({text})" if self.undetermined else text

    @property
    def undetermined(self) -> bool:
        """Whether a value that cannot be negative is below its standard deviation."""
        return self.positive and self.sd is not None and not self.sd <= abs(self.value)

    @property
    def known_sd(self) -> bool:
        """Whether the standard deviation is a finite number."""
        return self.sd is not None and math.isfinite(self.sd)

    @property
    def limits(self) -> tuple[float, float] | None:
        """Limits of the 95 % interval in the shown unit; None without one, and where it is undetermined."""
        if self.sd is None or not self.known_sd or self.undetermined:
            return None
        value, half = self.unit.of(self.value), HALF_WIDTH_95 * self.unit.of(self.sd)
        if self.positive and value > 0.0:
            ratio = math.exp(half / value)
            return value / ratio, value * ratio
        return value - half, value + half

    @property
    def interval(self) -> str:
        """The 95 % interval as text, empty without a standard deviation.

        >>> Quantity(1736.4, 17.2, STIFFNESS).interval
        '1703 to 1770'
        """
        return "" if self.limits is None else interval_text(*self.limits)


def si_unit(letter: str, first: str, second: str, exponent: float | None = 1.0) -> str:
    """Return the SI unit of an entry of K or D between two degrees of freedom, as text.

    >>> si_unit("K", "y", "y"), si_unit("D", "y", "alpha"), si_unit("D", "alpha", "alpha")
    ('N/m', 'N s', 'N s m/rad')
    """
    symbol = _SI_STIFFNESS[_is_rotation(first) + _is_rotation(second)]
    return _with_time(symbol, exponent) if letter == "D" else symbol


def diagonal_unit(letter: str, dof: str, exponent: float | None = 1.0) -> ShownUnit:
    """Return the unit in which a diagonal entry of K, D or M is shown, as `matrix_units`."""
    return matrix_units(letter, (dof,), exponent)[0][0]


def matrix_units(letter: str, dof: Sequence[str], exponent: float | None = 1.0) -> list[list[ShownUnit]]:
    """Return the unit in which each entry of K, D or M is shown, (n, n).

    ``exponent`` is the power of time in the unit of D, of the damping law; None where it differs between
    ears.

    >>> [unit.symbol for unit in matrix_units("D", ("y", "alpha"))[1]]
    ['µN s', 'µN mm s/rad']
    >>> [diagonal_unit(*entry).symbol for entry in (("K", "y"), ("D", "gamma"), ("D", "y", 0.5))]
    ['N/m', 'µN mm s/rad', 'N s^0.5/m']
    """
    units: tuple[ShownUnit, ...] = _SHOWN[letter]
    if letter == "D" and exponent != 1.0:
        units = tuple(ShownUnit(_with_time(one.symbol, exponent), one.per_si) for one in _SHOWN["K"])
    rotations = [_is_rotation(name) for name in dof]
    return [[units[row + column] for column in rotations] for row in rotations]


def _is_rotation(dof: str) -> bool:
    return dof not in ("x", "y", "z")


def _with_time(symbol: str, exponent: float | None) -> str:
    """Multiply a unit by a power of time: viscous damping has 1, hysteretic 0, None any."""
    power = " s^a" if exponent is None else {0.0: "", 1.0: " s"}.get(exponent, f" s^{exponent:.3g}")
    return symbol.replace("N", f"N{power}", 1)

"""A damping law of the table with its exponent: the factor s(w) in Z(w) = K + s(w) D."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fitting.errors import FittingError
from fitting.model.laws import LAWS, law_of
from fitting.model.laws.law import Law
from stapeskit.arrays import ComplexArray
from stapeskit.page.quantities import time_unit


@dataclass(frozen=True)
class DampingLaw:
    """A damping law by name, with its exponent.

    Attributes
    ----------
    name : str
        Of the table fitting.model.laws.
    exponent : float
        That of the law where it is fixed; otherwise the unknown: the power of time in the unit of D, between
        0 and 2, or a relaxation time (s).
    ratio : float
        The second time over the first, where the law has two; 0: the usual one.

    Raises
    ------
    FittingError
        The name is unknown, or the exponent is not what the law allows.
    """

    name: str = "viscous"
    exponent: float = 1.0
    ratio: float = 0.0

    def __post_init__(self) -> None:
        if self.name not in LAWS:
            raise FittingError.of("the damping law", f"one of {', '.join(LAWS)}", self.name)
        if self.ratio == 0.0 and self.law.ratios:
            object.__setattr__(self, "ratio", self.law.ratios[-1])
        if not self.estimated:
            object.__setattr__(self, "exponent", self.law.exponent)
        elif not self.law.valid[0] < self.exponent < self.law.valid[1]:
            low, high = self.law.valid
            raise FittingError.of("the damping exponent", f"between {low:g} and {high:g}", self.exponent)

    @property
    def law(self) -> Law:
        """The entry of the table."""
        law = law_of(self.name)
        return law if law.at_ratio is None or self.ratio == 0.0 else law.at_ratio(self.ratio)

    @property
    def estimated(self) -> bool:
        """Whether the exponent is an unknown of a fit."""
        return self.law.search is not None

    def with_exponent(self, exponent: float) -> DampingLaw:
        """Return the law with another exponent, within what it allows."""
        low, high = self.law.valid
        return replace(self, exponent=float(np.clip(exponent, low + 1e-3, high - 1e-3)))

    @property
    def time_power(self) -> float:
        """Power of time in the unit of D."""
        return self.exponent if self.law.time_power is None else self.law.time_power

    @property
    def physical(self) -> bool:
        """Whether a ligament can have it: a relaxation time below zero is noise."""
        return not self.estimated or self.exponent > 0.0

    def unit_of_exponent(self, omega: float) -> float:
        """Return the exponent of this law over that of frequencies divided by ``omega`` (rad/s)."""
        return 1.0 if self.law.time_power is None else 1.0 / omega

    def scaled(self, omega: float) -> DampingLaw:
        """Return the law of frequencies divided by ``omega`` (rad/s)."""
        return replace(self, exponent=self.exponent / self.unit_of_exponent(omega))

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a fit that the law adds."""
        return int(self.estimated)

    def factor(self, omega: ArrayLike) -> ComplexArray:
        """Return s(w) for angular frequencies (rad/s, or any unit that D goes with)."""
        return np.asarray(self.law.factor(np.asarray(omega, dtype=float), self.exponent), dtype=complex)

    def slope(self, omega: ArrayLike) -> ComplexArray:
        """Return the derivative of s(w) by an estimated exponent; zero where it is fixed."""
        w = np.asarray(omega, dtype=float)
        if self.law.slope is None:
            return np.zeros(w.shape, dtype=complex)
        return np.asarray(self.law.slope(w, self.exponent), dtype=complex)

    def at(self, eigenvalue: complex) -> complex:
        """Return s continued to a complex eigenvalue in the upper half plane, in place of i w."""
        return complex(self.law.continued(eigenvalue, self.exponent))

    @property
    def formula(self) -> str:
        """The dynamic stiffness as text."""
        return self.law.formula(self.exponent)

    def unit(self, stiffness_unit: str) -> str:
        """Return the unit of an entry of D from that of the same entry of K."""
        numerator, slash, denominator = stiffness_unit.partition("/")
        return numerator + time_unit(self.time_power) + slash + denominator


VISCOUS = DampingLaw()

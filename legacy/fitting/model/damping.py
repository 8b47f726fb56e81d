"""A damping law of the table with its exponent: the factor s(w) in Z(w) = K + s(w) D."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from legacy.fitting.errors import FittingError
from legacy.fitting.model.laws import LAWS, law_of
from legacy.fitting.model.laws.law import Law
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.page.quantities import time_unit

# Of the logarithm of a ratio of times: a thousand, where one of them is out of every band.
_WIDEST = float(np.log(1e3))


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
        The second time over the first, where the law has two, an unknown as well; 0: the usual one.

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
        return law_of(self.name)

    @property
    def _values(self) -> tuple[float, ...]:
        return (self.exponent, self.ratio) if self.law.ratios else (self.exponent,)

    @property
    def estimated(self) -> bool:
        """Whether the exponent is an unknown of a fit."""
        return self.law.search is not None

    @property
    def unknowns(self) -> Array:
        """What a fit estimates: the exponent, and the logarithm of the ratio of two times."""
        if not self.estimated:
            return np.zeros(0)
        return np.array([self.exponent, np.log(self.ratio)] if self.law.ratios else [self.exponent])

    @property
    def prior_sd(self) -> Array:
        """Standard deviation of the unknowns about those of a usual form; infinite where nothing is known."""
        return np.array([np.inf, self.law.ratio_sd])[: len(self.unknowns)]

    @property
    def free(self) -> int:
        """Number of unknowns of which nothing is known beforehand."""
        return int(np.isinf(self.prior_sd).sum())

    @property
    def known(self) -> int:
        """Number of unknowns that have a prior."""
        return len(self.unknowns) - self.free

    def with_unknowns(self, values: Array) -> DampingLaw:
        """Return the law with other unknowns, within what it allows."""
        if not len(values):
            return self
        low, high = self.law.valid
        margin = 1e-3 if self.law.time_power is None else 0.0
        ratio = float(np.exp(np.clip(values[1], -_WIDEST, _WIDEST))) if len(values) > 1 else self.ratio
        return replace(self, exponent=float(np.clip(values[0], low + margin, high - margin)), ratio=ratio)

    @property
    def time_power(self) -> float:
        """Power of time in the unit of D."""
        return self.exponent if self.law.time_power is None else self.law.time_power

    @property
    def physical(self) -> bool:
        """Whether a ligament can have it: a relaxation time below zero is noise."""
        return not self.estimated or self.exponent > 0.0

    def units(self, omega: float) -> Array:
        """Return the unknowns of this law over those of frequencies divided by ``omega`` (rad/s)."""
        units = np.ones(len(self.unknowns))
        if self.law.time_power is not None:
            units[:1] = 1.0 / omega
        return units

    def scaled(self, omega: float) -> DampingLaw:
        """Return the law of frequencies divided by ``omega`` (rad/s)."""
        return (
            self
            if self.law.time_power is None or not self.estimated
            else replace(self, exponent=self.exponent * omega)
        )

    def factor(self, omega: ArrayLike) -> ComplexArray:
        """Return s(w) for angular frequencies (rad/s, or any unit that D goes with)."""
        return np.asarray(self.law.factor(np.asarray(omega, dtype=float), *self._values), dtype=complex)

    def slopes(self, omega: ArrayLike) -> ComplexArray:
        """Return the derivatives of s(w) by the unknowns, (unknowns, lines)."""
        w = np.asarray(omega, dtype=float)
        slopes = [slope(w, *self._values) for slope in (self.law.slope, self.law.ratio_slope) if slope]
        return np.asarray(slopes, dtype=complex).reshape(len(slopes), *w.shape)

    def at(self, eigenvalue: complex) -> complex:
        """Return s continued to a complex eigenvalue in the upper half plane, in place of i w."""
        return complex(self.law.continued(eigenvalue, *self._values))

    @property
    def formula(self) -> str:
        """The dynamic stiffness as text."""
        return self.law.formula(*self._values)

    def unit(self, stiffness_unit: str) -> str:
        """Return the unit of an entry of D from that of the same entry of K."""
        numerator, slash, denominator = stiffness_unit.partition("/")
        return numerator + time_unit(self.time_power) + slash + denominator


VISCOUS = DampingLaw()

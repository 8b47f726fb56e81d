"""Damping laws: the factor s(w) in the dynamic stiffness Z(w) = K + s(w) D, a table of a few lines each.

A law has at most one unknown, an exponent or a relaxation time. A new law is one entry of `LAWS`, its words
one of `options.DAMPING`; help, comparison, modes and reports follow from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fitting.options import DAMPING
from stapeskit.arrays import ComplexArray


@dataclass(frozen=True)
class LawKind:
    """One kind of damping."""

    # s of the angular frequency (lines,), or of -i lambda for an eigenvalue, and the unknown if there is one
    factor: Callable[..., ComplexArray]
    usual: float = 0.0  # expected unknown of scaled frequencies (mean 1)
    usual_sd: float = 0.0  # its standard deviation; 0 where there is no unknown
    time_power: float | None = 1.0  # power of time in the unit of D; None: the unknown itself
    is_time: bool = False  # whether the unknown is a time
    includes: tuple[str, ...] = ()  # simpler laws that it becomes at a value of its unknown


LAWS: dict[str, LawKind] = {
    "viscous": LawKind(lambda w: 1j * w),
    "hysteretic": LawKind(lambda w: np.full(np.shape(w), 1j), time_power=0.0),
    "fractional": LawKind(
        lambda w, a: (1j * w) ** a, 0.8, 0.5, time_power=None, includes=("viscous", "hysteretic")
    ),
    "relaxation": LawKind(
        lambda w, a: 1j * w / (1.0 + 1j * w * a), 0.3, 1.0, is_time=True, includes=("viscous",)
    ),
}
"""By name; formulas are in `options.DAMPING`."""


@dataclass(frozen=True)
class DampingLaw:
    """A damping law with its unknown, SI."""

    name: str = "viscous"  # of `LAWS`
    value: float = 0.0  # the exponent, or the relaxation time (s); not used where the law has no unknown

    @property
    def kind(self) -> LawKind:
        """The entry of the table."""
        return LAWS[self.name]

    @property
    def free(self) -> int:
        """Number of unknowns."""
        return int(self.kind.usual_sd > 0.0)

    @property
    def physical(self) -> bool:
        """Whether a ligament can have it: an exponent or a time below zero is noise."""
        return not self.free or self.value > 0.0

    @property
    def time_power(self) -> float:
        """Power of time in the unit of D."""
        return self.value if self.kind.time_power is None else self.kind.time_power

    @property
    def formula(self) -> str:
        """The dynamic stiffness as text."""
        return DAMPING[self.name].format(a=self.value)

    def factor(self, omega: ArrayLike) -> ComplexArray:
        """Return s of angular frequencies, rad/s; complex ones continue it to eigenvalues i w."""
        values = (self.value,) if self.free else ()
        return np.asarray(self.kind.factor(np.asarray(omega), *values), dtype=complex)

    def scaled(self, reference: float) -> DampingLaw:
        """Return the law of frequencies divided by ``reference``, rad/s."""
        return replace(self, value=self.value * reference) if self.kind.is_time else self


VISCOUS = DampingLaw()

"""Damping laws: the complex factor s(w) in the dynamic stiffness Z(w) = K + s(w) D.

viscous: s = i w; hysteretic: s = i (structural, w > 0); fractional: s = (i w)^a with one exponent for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FittingError
from stapeskit.faults import sentence

ComplexArray = NDArray[np.complex128]
LAWS: tuple[str, ...] = ("viscous", "hysteretic", "fractional")


@dataclass(frozen=True)
class DampingLaw:
    """A damping law by name, with its exponent.

    Attributes
    ----------
    name : str
        ``viscous``, ``hysteretic`` or ``fractional``.
    exponent : float
        1 for viscous, 0 for hysteretic, between 0 and 2 for fractional.

    Raises
    ------
    FittingError
        The name is unknown, or the exponent is not between 0 and 2.
    """

    name: str = "viscous"
    exponent: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in LAWS:
            raise FittingError(sentence("the damping law", f"one of {', '.join(LAWS)}", self.name))
        if self.name != "fractional":
            object.__setattr__(self, "exponent", 1.0 if self.name == "viscous" else 0.0)
        elif not 0.0 < self.exponent < 2.0:
            raise FittingError(sentence("the damping exponent", "between 0 and 2", self.exponent))

    def factor(self, omega: ArrayLike) -> ComplexArray:
        """Return s(w) for angular frequencies (rad/s, or any unit that D goes with)."""
        w = np.asarray(omega, dtype=float)
        if self.name == "hysteretic":
            return np.full(w.shape, 1j)
        if self.name == "viscous":
            return 1j * w
        return np.asarray((1j * w) ** self.exponent)

    def at(self, eigenvalue: complex) -> complex:
        """Return s continued to a complex eigenvalue in the upper half plane, in place of i w."""
        if self.name == "hysteretic":
            return 1j
        return complex(eigenvalue**self.exponent)

    @property
    def formula(self) -> str:
        """The dynamic stiffness in words."""
        return {
            "viscous": "K + i w D",
            "hysteretic": "K + i D",
            "fractional": f"K + (i w)^{self.exponent:.4g} D",
        }[self.name]

    def unit(self, stiffness_unit: str) -> str:
        """Return the unit of an entry of D beside that of K."""
        seconds = {"viscous": " s", "hysteretic": "", "fractional": f" s^{self.exponent:.3g}"}[self.name]
        numerator, slash, denominator = stiffness_unit.partition("/")
        return numerator + seconds + slash + denominator


VISCOUS = DampingLaw()

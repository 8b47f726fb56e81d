"""The interface of a damping law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class Law:
    """A damping law s(w; a); unless ``time_power`` says otherwise a is the power of time in the unit of D.

    Attributes
    ----------
    factor : callable
        s of angular frequencies (lines,) and exponent, (lines,), complex.
    continued : callable
        s of a complex eigenvalue in the upper half plane (in place of i w) and exponent.
    formula : callable
        The dynamic stiffness as text, of the exponent.
    exponent : float
        Fixed value, or the initial value of an estimated one.
    search : (float, float), optional
        Range in which the exponent is estimated, of scaled frequencies; None: it is fixed.
    slope : callable, optional
        Derivative of s by an estimated exponent.
    time_power : float, optional
        Power of time in the unit of D where a is a time instead.
    valid : (float, float)
        What a may be.
    causal : bool
        Whether real and imaginary part obey the relations of Kramers and Kronig, so that nothing moves before
        it is pushed.
    polynomial : bool
        Whether s(lambda) = lambda, so that the eigenvalues are those of a state matrix.
    fixed : int
        Numbers that were chosen for the law where nature has them free; they count in a comparison as if they
        had been estimated, so that the data must speak for the law.
    includes : tuple of str
        Simpler laws that it becomes at a value of its exponent or in a limit.
    ratios : tuple of float
        What the second time over the first may be, where the law has two; the last is the usual one.
    at_ratio : callable, optional
        The law of a ratio.
    """

    factor: Callable[[Array, float], ComplexArray]
    continued: Callable[[complex, float], complex]
    formula: Callable[[float], str]
    exponent: float
    search: tuple[float, float] | None = None
    slope: Callable[[Array, float], ComplexArray] | None = None
    time_power: float | None = None
    valid: tuple[float, float] = (0.0, 2.0)
    causal: bool = True
    polynomial: bool = False
    fixed: int = 0
    includes: tuple[str, ...] = ()
    ratios: tuple[float, ...] = ()
    at_ratio: Callable[[float], Law] | None = None

"""The interface of a damping law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from legacy.stapeskit.arrays import ComplexArray


@dataclass(frozen=True)
class Law:
    """A damping law s(w; a) with at most two unknowns: a, called the exponent, and a ratio of two times.

    Unless ``time_power`` says otherwise a is the power of time in the unit of D.

    Attributes
    ----------
    factor : callable
        s of angular frequencies (lines,) and exponent, (lines,), complex.
    continued : callable
        s of a complex eigenvalue in the upper half plane (in place of i w) and exponent.
    formula : callable
        The dynamic stiffness as text, of the exponent.
    exponent : float
        Its value where it is fixed; not used where ``search`` is given.
    search : (float, float), optional
        Range in which the exponent is estimated, of scaled frequencies; None: it is fixed.
    slope : callable, optional
        Derivative of s by an estimated exponent.
    time_power : float, optional
        Power of time in the unit of D where a is a time instead.
    valid : (float, float)
        What a may be; an exponent stays a thousandth within it. An estimated a of zero or below is noise, and
        never chosen (`DampingLaw.physical`): a time that may scatter below zero has infinite ends.
    causal : bool
        Whether real and imaginary part obey the relations of Kramers and Kronig, so that nothing moves before
        it is pushed. The words about a law that does not are those of a constant loss factor
        (fitting/report/sections.py, model/causality.py).
    polynomial : bool
        Whether s(lambda) = lambda, so that the eigenvalues are those of a state matrix.
    includes : tuple of str
        Simpler laws that it becomes at a value of its exponent or in a limit. A new simpler law also stands
        in those of the laws that become it: beside them it is no law that the data could not tell apart.
    ratios : tuple of float
        Usual ratios of a second time to the first; a fit starts at each. ``factor``, ``continued``,
        ``formula`` and ``slope`` then take the ratio after the exponent.
    ratio_sd : float
        Standard deviation of the logarithm of the ratio about a usual one, before the data are seen.
    ratio_slope : callable, optional
        Derivative of s by the logarithm of the ratio.
    """

    factor: Callable[..., ComplexArray]
    continued: Callable[..., complex]
    formula: Callable[..., str]
    exponent: float
    search: tuple[float, float] | None = None
    slope: Callable[..., ComplexArray] | None = None
    time_power: float | None = None
    valid: tuple[float, float] = (0.0, 2.0)
    causal: bool = True
    polynomial: bool = False
    includes: tuple[str, ...] = ()
    ratios: tuple[float, ...] = ()
    ratio_sd: float = np.inf
    ratio_slope: Callable[..., ComplexArray] | None = None

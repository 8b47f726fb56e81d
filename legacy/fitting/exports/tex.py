"""K, D and M as LaTeX matrices with standard deviations."""

from __future__ import annotations

import math

from legacy.fitting.kd_fit import KDFit
from legacy.stapeskit.arrays import Array

_LETTERS = {"alpha": r"\alpha", "beta": r"\beta", "gamma": r"\gamma"}


def number(value: float, sd: float | None = None) -> str:
    """Return a number as LaTeX, with its standard deviation to the second digit where there is one.

    Examples
    --------
    >>> number(1736.4, 17.2), number(0.00137, 1.1e-05)
    ('1736 \\\\pm 17', '(1.370 \\\\pm 0.011)\\\\cdot 10^{-3}')
    """
    if sd is None or not 0.0 < sd < math.inf:
        mantissa, _, power = f"{value:.4e}".partition("e")
        return mantissa if int(power) == 0 else rf"{mantissa}\cdot 10^{{{int(power)}}}"
    power_of_ten = math.floor(math.log10(max(abs(value), sd)))
    power_of_ten = 0 if -3 < power_of_ten < 5 else power_of_ten
    value, sd = value * 10.0**-power_of_ten, sd * 10.0**-power_of_ten
    digits = max(0, 1 - math.floor(math.log10(sd)))
    text = rf"{value:.{digits}f} \pm {sd:.{digits}f}"
    return text if power_of_ten == 0 else rf"({text})\cdot 10^{{{power_of_ten}}}"


def _matrix(name: str, values: Array, sd: Array | None = None) -> str:
    rows = [
        " & ".join(
            number(value, None if sd is None else float(sd[row, column])) for column, value in enumerate(line)
        )
        for row, line in enumerate(values)
    ]
    return rf"\[{name} = \begin{{pmatrix}}" + "\n  " + " \\\\\n  ".join(rows) + "\n" + r"\end{pmatrix}\]"


def content(fit: KDFit) -> bytes:
    """Return the matrices, SI, with what they refer to as a comment."""
    stiffness_sd, damping_sd = fit.standard_deviation
    order = ", ".join(_LETTERS.get(name, name) for name in fit.dof)
    lines = [
        f"% SI (N, m, rad, s, kg); order ${order}$; about the footplate centre in footplate axes; +- one sd.",
        f"% Dynamic stiffness {fit.law.formula}.",
        _matrix("K", fit.stiffness, stiffness_sd),
        _matrix("D", fit.damping, damping_sd),
        _matrix("M", fit.mass),
    ]
    return ("\n".join(lines) + "\n").encode()

"""What a written coherence says about noise: a file rounds it, and 1.000 is not free of noise."""

from __future__ import annotations

import numpy as np

from stapeskit.arrays import Array

_MOST_DECIMALS = 6  # single precision holds no more
_FLOAT32 = 6e-8  # rounding of a coherence that was stored in single precision
_MOST_ROUNDED = 0.9  # share of values that show the decimals: single ones may have been written otherwise
_COARSE = 1.5  # last digits of 1 - g2 below which it is known to no better than a third


def last_digit(coherence: Array) -> float:
    """Return the step of the decimals that coherences are written with; 0 where they are not rounded.

    A coherence of 0 or 1 has any number of decimals.
    """
    known = coherence[(coherence > 0.0) & (coherence < 1.0)]
    for decimals in range(1, _MOST_DECIMALS) if known.size else ():
        scaled = known * 10.0**decimals
        rounded = np.abs(scaled - np.round(scaled)) <= _FLOAT32 * 10.0**decimals
        if np.mean(rounded) >= _MOST_ROUNDED:
            return float(10.0**-decimals)
    return 0.0


def unexplained_power(coherence: Array) -> Array:
    """Return 1 - g2: at least a quarter of the last digit, the mean of what rounds to 1.

    Where the coherence is not rounded but 1, half of the least of the others is taken; where all are 1
    (or 0), as by a program that does not compute them, NaN.
    """
    left = 1.0 - coherence
    some = left[(left > 0.0) & (left < 1.0)]
    if not some.size:
        return np.full(coherence.shape, np.nan)
    step = last_digit(coherence)
    least = 0.25 * step if step else 0.5 * float(np.min(some))
    return np.asarray(np.fmax(left, np.where(np.isfinite(left), least, np.nan)))


def share_hidden(coherence: Array, digit: float) -> float:
    """Return the share of the values of which a last digit ``digit`` hides the size of the noise."""
    left = 1.0 - coherence[np.isfinite(coherence)]
    return float(np.mean(left < _COARSE * digit)) if left.size else 0.0

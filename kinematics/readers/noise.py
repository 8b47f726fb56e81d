"""The noise that follows from coherence and averages; a file rounds coherence, and 1.000 has noise, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinematics.readers.recording import Row, matrix_of
from stapeskit.arrays import Array

_MOST_DECIMALS = 6  # single precision holds no more
_FLOAT32 = 6e-8  # rounding of a coherence that was stored in single precision
_MOST_ROUNDED = 0.9  # share of values that show the decimals: single ones may have been written otherwise
_COARSE = 1.5  # last digits of 1 - g2 below which it is known to no better than a third


def with_noise(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of a file with the sd that follows from what they state.

    Coherence without a number of averages and averages alone give an sd up to one factor (``relative``). The
    coherence of a single average is 1 by construction and says nothing, as one that is 1 throughout.

    Source: Bendat and Piersol 2010, Random Data, section 9.2: the sd of the real (= imaginary) part.
    """
    coherence, counts = matrix_of(rows, "coherence"), matrix_of(rows, "n_avg")
    single = coherence is not None and counts is not None and not np.any(counts > 1.0)
    nothing = coherence is None and counts is None
    if nothing or single or any(row.sd is not None for row in rows):
        return list(rows)
    averages = np.ones((len(rows), len(rows[0].freq_hz))) if counts is None else counts
    if coherence is None:
        sd = 1.0 / np.sqrt(averages)
        return [replace(row, sd=own, relative=True) for row, own in zip(rows, sd, strict=True)]
    digit = last_digit(coherence)
    left = 1.0 - coherence
    some = left[(left > 0.0) & (left < 1.0)]
    if not some.size:
        return list(rows)
    # what rounds to 1: the mean of the noise that does; unrounded, half of the least of the others
    least = 0.25 * digit if digit else 0.5 * float(np.min(some))
    value = np.array([row.value for row in rows])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sd = np.abs(value) * np.sqrt(np.maximum(left, least) / (2.0 * averages * coherence))
    sd = np.where(np.isfinite(sd), sd, np.nan)
    hidden = np.sum(left < _COARSE * digit, axis=1) / np.maximum(np.sum(np.isfinite(left), axis=1), 1)
    behind = np.zeros(len(rows)) if counts is None else np.nanmedian(counts, axis=1)
    return [
        replace(row, sd=own, relative=counts is None, averages=float(number), hidden=float(share))
        for row, own, number, share in zip(rows, sd, behind, hidden, strict=True)
    ]


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

"""The noise of an averaged frequency response from its coherence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array


def sd_from_coherence(value: NDArray[np.complex128], coherence: Array, n_avg: Array | float) -> Array:
    """Return the standard deviation of the real (= imaginary) part, in the unit of the values.

    Parameters
    ----------
    value, coherence : ndarray
        Of one shape.
    n_avg : ndarray, broadcastable to that, or float
        Number of averages.

    Returns
    -------
    ndarray
        NaN where the coherence says nothing: at 0, beyond 1, or missing.

    Notes
    -----
    |v| sqrt((1 - g2) / (2 n g2)) with coherence g2 and n averages (Bendat and Piersol 2010, Random Data,
    section 9.2).
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sd = np.abs(value) * np.sqrt((1.0 - coherence) / (2.0 * n_avg * coherence))
    return np.where(np.isfinite(sd), sd, np.nan)

"""Many laws tested at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def false_discovery(p_values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return q-values: the least false discovery rate at which each p-value counts.

    Benjamini and Hochberg (1995, doi:10.1111/j.2517-6161.1995.tb02031.x). NaN stays NaN.
    """
    q_values = np.full(len(p_values), np.nan)
    good = np.flatnonzero(np.isfinite(p_values))
    order = good[np.argsort(p_values[good])]
    scaled = p_values[order] * len(order) / np.arange(1, len(order) + 1)
    q_values[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return q_values

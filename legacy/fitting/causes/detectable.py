"""From which size on a cause is found in four of five measurements.

The minimal detectable bias of Baarda (1968), A testing procedure for use in geodetic networks. A cause that
brings nuisance parameters, such as the place of a mass at the head, is seen by as much as they leave of it:
the larger it is, the more an error of its place can hide.
"""

from __future__ import annotations

import numpy as np

from legacy.stapeskit.arrays import Array

# Standard deviations between a threshold and the mean of what passes it in 80 %: a quantile of the normal.
POWER_80 = 0.8416
# Computation: largest size that is tried, over that without nuisances, and steps of the search.
_LARGEST, _STEPS = 1e4, 60


def detectable_size(sd: float, least: float, information: Array | None = None) -> float:
    """Return the size of a cause whose score passes a threshold in four of five; infinite where none does.

    Parameters
    ----------
    sd : float
        Of its size, to first order, in its unit.
    least : float
        Threshold of the score over its standard deviation.
    information : ndarray, (1 + k, 1 + k), optional
        Of the cause and of its nuisances, each by one standard deviation beside one unit of the cause.

    Notes
    -----
    A cause of size s with nuisances u of unit variance raises chi2 by the least of s^2 (1, u)^T I (1, u) +
    u^T u: s^2 (I_00 - I_0u (I_uu + 1 / s^2)^-1 I_u0).
    """
    needed = least + POWER_80
    if information is None:
        return float(needed * sd)
    scaled = information / max(information[0, 0], 1e-300)
    values, vectors = np.linalg.eigh(scaled[1:, 1:])
    across, values = (vectors.T @ scaled[1:, 0]) ** 2, np.maximum(values, 0.0)

    def rise(size: float) -> float:
        hidden = np.sum(across / np.maximum(values + (sd / size) ** 2, 1e-300))
        return float(size / sd * np.sqrt(max(1.0 - float(hidden), 0.0)))

    low, high = needed * sd, needed * sd * _LARGEST
    if rise(high) < needed:
        return float("inf")
    for _ in range(_STEPS):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if rise(middle) < needed else (low, middle)
    return float(high)

"""Means over cells of voxels, robust means, and how far noise is shared by neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ct_inertia.voxels.fields import Grey
from ct_inertia.voxels.masks import Mask
from stapeskit.arrays import Array

_NEAR_LAGS, _FAR_LAGS = range(1, 9), range(12, 97, 8)  # voxels: kernels of scanners; rings and streaks
_LEAST_PAIRS = 400  # of voxels that a correlation follows from: known to 5 %
_LEAST_CORRELATION = 0.2  # variance of sums over that of white noise: less is a sharpening filter's


def robust_mean(values: Grey) -> tuple[float, float]:
    """Return mean and standard deviation of what lies within four deviations of the median."""
    some = values[:: max(1, values.size // 100_000)]
    middle = float(np.median(some))
    spread = 1.4826 * float(np.median(np.abs(some - np.float32(middle)))) + 1e-12
    kept = values[np.abs(values - np.float32(middle)) < 4.0 * spread].astype(float)
    return (float(kept.mean()), float(kept.std())) if kept.size else (middle, spread)


def cell_numbers(where: Mask, edge: int) -> NDArray[np.int32]:
    """Return the number (n,) of the cube of so many voxels that holds each voxel of a mask [z, y, x]."""
    z, y, x = (np.arange(n, dtype=np.int32) // edge for n in where.shape)
    return ((z[:, None, None] * (y[-1] + 1) + y[:, None]) * (x[-1] + 1) + x)[where]


def by_cells(values: NDArray[np.floating], where: Mask, edge: int) -> tuple[Array, Array]:
    """Return number and sum of the values (n,) of a mask's voxels in each cube of so many, (cells,)."""
    key = cell_numbers(where, edge)
    return np.bincount(key).astype(float), np.bincount(key, values).astype(float)


def mean_by_cells(values: NDArray[np.floating], where: Mask, edge: int) -> tuple[float, float]:
    """Return the mean of the values (n,) of a mask's voxels, and its standard error by the scatter of cells.

    Cells are cubes of so many voxels: noise that neighbours share and unevenness both count.
    """
    weight, total = by_cells(values, where, edge)
    used = weight >= 4
    if np.count_nonzero(used) < 4:
        return float(np.mean(values)), float(np.std(values))
    weight, means = weight[used], total[used] / weight[used]
    mean = float(np.average(means, weights=weight))
    scatter = float(np.average((means - mean) ** 2, weights=weight))
    return mean, float(np.sqrt(scatter / (len(weight) - 1)))


def noise_correlation(rest: Grey, inside: Mask) -> float:
    """Return the variance of sums of noise over that of white noise.

    Notes
    -----
    Correlations at one, two, ... voxels along each axis are added up as long as they stand out of their own
    scatter, and the axes multiplied: exact for noise that was smoothed axis by axis, as reconstruction does.
    """
    total = 1.0
    variance = float(np.mean(np.square(rest[inside], dtype=float))) if inside.any() else 0.0
    if variance <= 0.0:
        return total
    for axis in range(3):
        along, before = 1.0, 0
        values, good = np.moveaxis(rest, axis, 0), np.moveaxis(inside, axis, 0)
        for lag in (*_NEAR_LAGS, *_FAR_LAGS):
            both = good[lag:] & good[:-lag]
            count = int(np.count_nonzero(both))
            if count < _LEAST_PAIRS:
                break
            r = float(np.mean(values[lag:][both] * values[:-lag][both], dtype=float)) / variance
            if abs(r) < 3.5 / np.sqrt(count):
                break
            along += 2.0 * r * (lag - before)
            before = lag
        total *= max(along, _LEAST_CORRELATION)
    return total

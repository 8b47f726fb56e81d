"""The normal distribution, by compiled kernels where there are any."""

from __future__ import annotations

from typing import Any

import numpy as np

from legacy.ct_inertia.native import compiled
from legacy.stapeskit.arrays import Array


def normal_cdf(z: Any) -> Array:
    """Return the share of the standard normal distribution below z; any shape."""
    kernels = compiled()
    if kernels is None:
        from scipy.special import ndtr

        return np.asarray(ndtr(np.asarray(z, dtype=float)))
    return _apply(kernels.normal_cdf, z)


def normal_density(z: Any) -> Array:
    """Return the density of the standard normal distribution at z; any shape."""
    return np.asarray(np.exp(-0.5 * np.square(z)) / np.sqrt(2.0 * np.pi))


def normal_quantile(share: Any) -> Array:
    """Return where the standard normal distribution has a share (0 to 1) below; any shape."""
    kernels = compiled()
    if kernels is None:
        from scipy.special import ndtri

        return np.asarray(ndtri(np.asarray(share, dtype=float)))
    return _apply(kernels.normal_quantile, share)


def _apply(kernel: Any, values: Any) -> Array:
    given = np.asarray(values, dtype=float)
    flat = np.ascontiguousarray(given.ravel())
    out = np.empty_like(flat)
    kernel(flat.ctypes.data, flat.size, out.ctypes.data)
    return out.reshape(given.shape)

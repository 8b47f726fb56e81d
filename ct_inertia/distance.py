"""Exact distances from a mask up to a cap: cheap when only a rim of a few voxels matters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def capped_distance(mask: NDArray[np.bool_], spacing_mm: Array, cap_mm: float) -> NDArray[np.float32]:
    """Return the distance of each voxel to the nearest voxel of the mask, at most ``cap_mm``.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
        Along x, y, z.
    cap_mm : float

    Returns
    -------
    ndarray of float32, [z, y, x]
        Between voxel centres, mm; 0 in the mask.

    Notes
    -----
    Squared distances are separable: a minimum over shifted parabolas along each axis in turn
    (Felzenszwalb and Huttenlocher 2012, doi:10.4086/toc.2012.v008a019), here only over the few shifts that
    stay below the cap.
    """
    far = np.float32((cap_mm * 1.001) ** 2)
    square = np.where(mask, np.float32(0.0), far)
    for axis in range(3):
        step = float(spacing_mm[2 - axis])
        source = square
        square = source.copy()
        n = source.shape[axis]
        for k in range(1, min(n - 1, int(cap_mm / step)) + 1):
            add = np.float32((k * step) ** 2)
            ahead = _along(axis, slice(k, None))
            back = _along(axis, slice(None, n - k))
            np.minimum(square[ahead], source[back] + add, out=square[ahead])
            np.minimum(square[back], source[ahead] + add, out=square[back])
    return np.asarray(np.minimum(np.sqrt(square), np.float32(cap_mm)))


def _along(axis: int, part: slice) -> tuple[slice, ...]:
    return tuple(part if k == axis else slice(None) for k in range(3))

"""Distances from a mask up to a cap: cheap where only a rim of a few voxels matters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.voxels.masks import Mask, used_box
from stapeskit.arrays import Array

_PIECE_VOXELS = 200_000  # of an array that fits the processor's cache
_SAME = 1e-9  # relative difference up to which spacings are equal


def capped_distance(mask: Mask, spacing_mm: Array, cap_mm: float) -> NDArray[np.float32]:
    """Return the distance of each voxel centre to the nearest one of the mask, at most ``cap_mm``.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
        Along x, y, z.

    Returns
    -------
    ndarray of float32, [z, y, x]
        mm; 0 in the mask.

    Notes
    -----
    Squared distances are separable: minima over shifted parabolas along x, y and z (Felzenszwalb and
    Huttenlocher 2012, doi:10.4086/toc.2012.v008a019), here only over the shifts below the cap. Cubic voxels
    are counted in whole numbers.
    """
    result = np.full(mask.shape, cap_mm, dtype=np.float32)
    used = used_box(mask)
    if used is None:
        return result
    spacing = np.asarray(spacing_mm, dtype=float)[::-1]
    reach = (cap_mm / spacing).astype(int)
    box = tuple(slice(max(0, part.start - n), part.stop + n) for part, n in zip(used, reach, strict=True))
    cubic = float(np.ptp(spacing)) <= _SAME * float(spacing[0])
    edge = float(spacing[0]) if cubic else 1.0
    unit, dtype = (np.ones(3), np.uint16) if cubic else (spacing**2, np.float32)
    far = dtype(np.ceil((cap_mm / edge) ** 2 * 1.002) + 1)
    squares = np.where(mask[box], dtype(0), far)
    for axis in (2, 1, 0):
        parabola = (np.arange(reach[axis] + 1) ** 2 * unit[axis]).astype(dtype)
        across = np.moveaxis(squares, 1 if axis == 0 else 0, 0)
        count = max(1, _PIECE_VOXELS // max(1, across[0].size))
        for start in range(0, len(across), count):
            _lower(np.moveaxis(across[start : start + count], max(axis, 1), 0), parabola)
    np.minimum(np.sqrt(squares, dtype=np.float32) * np.float32(edge), np.float32(cap_mm), out=result[box])
    return result


def closed(mask: Mask, spacing_mm: Array, radius_mm: float) -> Mask:
    """Close a mask [z, y, x] by a ball: fill gaps and holes that are narrower than the ball."""
    cap = radius_mm + float(np.max(spacing_mm))
    wide = capped_distance(mask, spacing_mm, cap) <= radius_mm
    return np.asarray(mask | (capped_distance(~wide, spacing_mm, cap) > radius_mm))


def _lower(squares: NDArray[Any], parabola: NDArray[Any]) -> None:
    """Replace squared distances by their minimum over shifted parabolas along the first axis, in place."""
    source = squares.copy()
    for k in range(1, min(len(squares), len(parabola))):
        raised = source + parabola[k]
        np.minimum(squares[k:], raised[:-k], out=squares[k:])
        np.minimum(squares[:-k], raised[k:], out=squares[:-k])

"""Distances from a mask up to a cap: cheap where only a rim of a few voxels matters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

_SLAB_VOXELS = 200_000  # of a piece that fits the processor's cache
_SAME = 1e-9  # relative difference up to which spacings are equal


def capped_distance(mask: NDArray[np.bool_], spacing_mm: Array, cap_mm: float) -> NDArray[np.float32]:
    """Return the distance of each voxel centre to the nearest one of the mask, at most ``cap_mm``.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
        Along x, y, z.
    cap_mm : float

    Returns
    -------
    ndarray of float32, [z, y, x]
        mm; 0 in the mask.

    Notes
    -----
    Squared distances are separable: minima over shifted parabolas along x, y and z (Felzenszwalb and
    Huttenlocher 2012, doi:10.4086/toc.2012.v008a019), here only over the shifts below the cap. Cubic voxels
    are counted in whole numbers of 8 or 16 bits.
    """
    result = np.full(mask.shape, cap_mm, dtype=np.float32)
    used = used_box(mask)
    if used is None:
        return result
    steps = [int(cap_mm / float(h)) for h in spacing_mm[::-1]]
    box = tuple(
        slice(max(0, part.start - n), min(size, part.stop + n))
        for part, n, size in zip(used, steps, mask.shape, strict=True)
    )
    unit, far, edge = _units(np.asarray(spacing_mm, dtype=float)[::-1], steps, cap_mm)
    squares = np.where(mask[box], far.dtype.type(0), far)
    layers = max(1, _SLAB_VOXELS // max(1, squares.shape[1] * squares.shape[2]))
    for start in range(0, len(squares), layers):
        slab = squares[start : start + layers]
        for axis in (2, 1):
            _lower(slab, axis, (np.arange(steps[axis] + 1) ** 2 * unit[axis]).astype(far.dtype))
    rows = max(1, _SLAB_VOXELS // max(1, squares.shape[0] * squares.shape[2]))
    for start in range(0, squares.shape[1], rows):
        _lower(
            squares[:, start : start + rows], 0, (np.arange(steps[0] + 1) ** 2 * unit[0]).astype(far.dtype)
        )
    roots = np.sqrt(squares, dtype=np.float32)
    np.minimum(roots * np.float32(edge), np.float32(cap_mm), out=result[box])
    return result


def closed(mask: NDArray[np.bool_], spacing_mm: Array, radius_mm: float) -> NDArray[np.bool_]:
    """Return a mask [z, y, x] with the gaps and holes narrower than a ball filled: a closing by the ball."""
    cap = radius_mm + float(np.max(spacing_mm))
    wide = capped_distance(mask, spacing_mm, cap) <= radius_mm
    return np.asarray(mask | (capped_distance(~wide, spacing_mm, cap) > radius_mm))


def used_box(mask: NDArray[Any]) -> tuple[slice, slice, slice] | None:
    """Return the slices z, y, x of the smallest box that holds a mask; None for an empty one."""
    flat = np.any(mask, axis=0)
    uses = (np.any(mask, axis=(1, 2)), np.any(flat, axis=1), np.any(flat, axis=0))
    if not uses[1].any():
        return None
    ends = [np.flatnonzero(use)[[0, -1]] for use in uses]
    z, y, x = (slice(int(first), int(last) + 1) for first, last in ends)
    return z, y, x


def _units(spacing: Array, steps: list[int], cap_mm: float) -> tuple[Array, NDArray[Any], float]:
    """Return the squared voxel edges as counted, a value beyond the cap in that type, and the edge."""
    if float(np.ptp(spacing)) <= _SAME * float(spacing[0]):
        far = int(np.ceil((cap_mm / float(spacing[0])) ** 2 * 1.002)) + 1
        for dtype in (np.uint8, np.uint16):
            if far + max(steps) ** 2 <= np.iinfo(dtype).max:
                return np.ones(3), np.array(far, dtype=dtype), float(spacing[0])
    return np.square(spacing), np.array(cap_mm**2 * 1.002, dtype=np.float32), 1.0


def _lower(square: NDArray[Any], axis: int, parabola: NDArray[Any]) -> None:
    """Replace squared distances by their minimum over shifted parabolas along an axis, in place."""
    moved = np.moveaxis(square, axis, 0)
    source = moved.copy()
    for k in range(1, min(len(moved), len(parabola))):
        raised = source + parabola[k]
        np.minimum(moved[k:], raised[:-k], out=moved[k:])
        np.minimum(moved[:-k], raised[k:], out=moved[:-k])

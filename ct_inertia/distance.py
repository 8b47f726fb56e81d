"""Exact distances from a mask up to a cap: cheap when only a rim of a few voxels matters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_PIECE = 200_000
_SAME = 1e-9
# Twice its square is a 16-bit number.
_MOST_STEPS = 180


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
    Squared distances are separable: along x the nearest voxel of the mask is found by running maxima, then
    a minimum over shifted parabolas is taken along y and z (Felzenszwalb and Huttenlocher 2012,
    doi:10.4086/toc.2012.v008a019), only over the few shifts that stay below the cap, and in pieces that fit
    the processor's cache. Cubic voxels are counted in whole numbers.
    """
    steps = [int(cap_mm / float(h)) for h in spacing_mm]
    cubic = float(np.ptp(spacing_mm)) <= _SAME * float(spacing_mm[0]) and steps[0] < _MOST_STEPS
    unit = np.ones(3) if cubic else np.square(np.asarray(spacing_mm, dtype=float))
    dtype = np.dtype(np.uint16 if cubic else np.float32)
    square_cap = (cap_mm / float(spacing_mm[0])) ** 2 if cubic else cap_mm**2
    far = dtype.type(np.ceil(square_cap * 1.002) + 1 if cubic else square_cap * 1.002)
    squares = [_squares(steps[k], unit[k], dtype) for k in range(3)]

    # Pieces of some layers: small enough for the cache, large enough that other threads seldom interrupt.
    result = np.full(mask.shape, far, dtype=dtype)
    deep = max(1, _PIECE // (mask.shape[1] * mask.shape[2]))
    for start in range(0, mask.shape[0], deep):
        inside, layers = mask[start : start + deep], result[start : start + deep]
        rows = np.flatnonzero(inside.any(axis=(0, 2)))
        if rows.size:
            part = slice(int(rows[0]), int(rows[-1]) + 1)
            layers[:, part] = _along_rows(inside[:, part], squares[0], far)
            _along(layers, 1, squares[1])
    high = max(1, _PIECE // (mask.shape[0] * mask.shape[2]))
    for start in range(0, mask.shape[1], high):
        beside = result[:, start : start + high]
        if np.any(beside < far):
            piece = np.ascontiguousarray(beside)
            _along(piece, 0, squares[2])
            beside[...] = piece
    if cubic:
        roots = np.sqrt(np.arange(int(far) + 1)) * float(spacing_mm[0])
        return np.asarray(np.minimum(roots, cap_mm).astype(np.float32)[result])
    np.sqrt(result, out=result)
    return np.asarray(np.minimum(result, np.float32(cap_mm), out=result))


def _squares(steps: int, unit: float, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the squared distances of 0, 1, ... voxels up to the cap."""
    return (np.arange(steps + 1) ** 2 * unit).astype(dtype)


def _along_rows(inside: NDArray[np.bool_], squares: NDArray[Any], far: Any) -> NDArray[Any]:
    """Return the squared distance to the nearest voxel of the mask in the same row."""
    steps = len(squares)
    place = np.arange(inside.shape[2], dtype=np.int32)
    before = np.maximum.accumulate(np.where(inside, place, np.int32(-steps)), axis=2)
    behind = np.where(inside, place, np.int32(len(place) + steps))
    behind = np.minimum.accumulate(behind[:, :, ::-1], axis=2)[:, :, ::-1]
    away = np.minimum(np.minimum(place - before, behind - place), steps)
    return np.append(squares, far)[away]


def _along(square: NDArray[Any], axis: int, squares: NDArray[Any]) -> None:
    """Replace squared distances by their minimum over shifted parabolas along an axis, in place."""
    source, raised = square.copy(), np.empty_like(square)
    ahead: list[slice] = [slice(None)] * square.ndim
    back: list[slice] = [slice(None)] * square.ndim
    for k in range(1, min(square.shape[axis], len(squares))):
        np.add(source, squares[k], out=raised)
        ahead[axis], back[axis] = slice(k, None), slice(None, -k)
        np.minimum(square[tuple(ahead)], raised[tuple(back)], out=square[tuple(ahead)])
        np.minimum(square[tuple(back)], raised[tuple(ahead)], out=square[tuple(back)])

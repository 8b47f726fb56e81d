"""Operations on fields of a scene: Gaussian blur, the share of voxels above a level, smooth local means."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ct_inertia.voxels.masks import Slices, hull, widened
from stapeskit.arrays import Array

Grey = NDArray[np.float32]

_TRUNCATE = 4.3  # widths of the blur beyond which 2e-5 of it lies
_ROWS = 16  # of a band matrix that are multiplied at a time: narrow bands, and BLAS starts no threads
_HALO = 16  # voxels around boxes beyond which a blur does not reach into them: four of its widths
_STEEP = 1e-3  # least slope of a field per voxel: below, a voxel is wholly above or below a level


def smooth(field: Grey, width: Array, boxes: list[Slices] | None = None) -> Grey:
    """Return a field [z, y, x] smoothed by a Gaussian; ``width`` (3,) along z, y, x in voxels.

    Beyond the border the outermost voxels are repeated. One product with a band matrix along each axis, which
    is three times as fast as a convolution voxel by voxel. With ``boxes`` only in these: 0 elsewhere.
    """
    bands = _bands(field.shape, width)
    if boxes is None:
        return _apply(field, bands, _whole(field.shape))
    result = np.zeros(field.shape, dtype=np.float32)  # zeros_like would touch all of the memory
    for box in boxes:
        result[box] = _apply(field, bands, box)
    return result


def blur(share: Grey, spread_mm2: Array, spacing: Array, boxes: list[Slices] | None = None) -> Grey:
    """Return the blurred image of a body that is given as the share of each voxel that it fills.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
    spread_mm2 : ndarray, (3, 3)
        Covariance of a Gaussian point spread along z, y, x, the voxel included, whose own variance h^2 / 12
        is in the share already.
    spacing : ndarray, (3,)
        Along z, y, x, mm.
    boxes : list of tuple of 3 slice, optional
        Where the image is asked for; 0 elsewhere.

    Notes
    -----
    A covariance between two axes is a spread along the diagonal of their voxels of its absolute size; what
    that adds along the two axes is taken off there.
    """
    square = spread_mm2 / np.outer(spacing, spacing)
    along = np.diag(square) - 1.0 / 12.0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        cross = float(np.clip(square[a, b], -along[[a, b]].min(), along[[a, b]].min()))
        if cross:
            along[[a, b]] -= abs(cross)
            share = _along_diagonal(share, (a, b), cross, boxes)
    return smooth(share, np.sqrt(np.maximum(along, 0.0)), boxes)


def _along_diagonal(
    field: Grey, axes: tuple[int, int], cross: float, boxes: list[Slices] | None = None
) -> Grey:
    """Smooth along a diagonal of the voxels of two axes, up or down by the sign of ``cross``.

    With boxes only where the field, smoothed once more, reaches them.

    Notes
    -----
    The discrete analogue of the Gaussian, exp(-t) I_k(t), has exactly the variance t (Lindeberg 1990,
    doi:10.1109/34.49051).
    """
    from scipy.special import ive

    variance = abs(cross)
    reach = int(np.ceil(_TRUNCATE * np.sqrt(variance))) + 1
    weights = ive(np.arange(reach + 1), variance)
    weights /= 2.0 * weights.sum() - weights[0]
    if boxes:
        result, window = field.copy(), widened(hull(boxes), _HALO)
        result[window] = _along_diagonal(field[window], axes, cross)
        return result
    padded = np.pad(field, [(reach, reach) if axis in axes else (0, 0) for axis in range(3)], mode="edge")
    result = np.zeros_like(field)
    for k in range(-reach, reach + 1):
        part: list[slice] = [slice(None)] * 3
        for axis, step in zip(axes, (k, int(np.copysign(k, k * cross))), strict=True):
            part[axis] = slice(reach + step, reach + step + field.shape[axis])
        result += np.float32(weights[abs(k)]) * padded[tuple(part)]
    return result


def local_ratio(
    top: Grey, bottom: Grey, width: Array, least: float, boxes: list[Slices] | None = None
) -> Grey:
    """Return the local mean of ``top`` over that of ``bottom`` [z, y, x], 0 where the latter is too small.

    ``width`` (3,): standard deviation of the weights along z, y, x, voxels; ``least`` local mean of
    ``bottom``; ``boxes``: where the ratio is asked for, 0 elsewhere.
    """
    result = np.zeros(top.shape, dtype=np.float32)
    bands = _bands(top.shape, width)
    for box in boxes or [_whole(top.shape)]:
        over, under = _apply(top, bands, box), _apply(bottom, bands, box)
        np.divide(over, under, out=result[box], where=under > least)
    return result


def share_above(field: Grey, where: NDArray[np.bool_]) -> Grey:
    """Return the part of each voxel in which a field is positive, 0 outside of a mask.

    Notes
    -----
    A cube's projection on any direction has the variance h^2 / 12, so that the share of a voxel above a plane
    at the distance d is nearly d / h + 1/2 whatever the direction, with the exact mean and variance. The
    slope along each axis is the steeper one of its two sides, so that ridges thinner than a voxel stay thin.
    """
    share = ((field > 0.0) & where).astype(np.float32)
    inner = np.zeros(field.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = where[1:-1, 1:-1, 1:-1]
    place, flat = np.flatnonzero(inner), field.ravel()
    place = place[np.abs(flat[place]) < 1.0]
    middle = flat[place]
    square = np.full(place.size, np.float32(_STEEP**2))
    for stride in (field.shape[1] * field.shape[2], field.shape[2], 1):
        square += (
            np.maximum(np.abs(flat[place + stride] - middle), np.abs(flat[place - stride] - middle)) ** 2
        )
    share.ravel()[place] = np.clip(middle / np.sqrt(square) + np.float32(0.5), 0.0, 1.0)
    return share


Band = tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]
"""A matrix (rows, size); of each row the first and one past the last column that is not 0; its transpose."""


def _whole(shape: tuple[int, ...]) -> Slices:
    z, y, x = (slice(0, n) for n in shape)
    return z, y, x


def _bands(shape: tuple[int, ...], width: Array) -> list[Band]:
    # To four digits, so that matrices are made once.
    return [_gaussian(size, float(f"{w:.4g}")) for size, w in zip(shape, width, strict=True)]


def _apply(field: Grey, bands: list[Band], box: Slices) -> Grey:
    """Multiply a field by one band matrix along each axis, for a box of the result."""
    taken = tuple(
        slice(int(first[rows.start]), int(last[rows.stop - 1]))
        for (_, first, last, _), rows in zip(bands, box, strict=True)
    )
    field = field[taken]
    for axis, (matrix, first, last, transposed) in enumerate(bands):
        shape, rows, begins = list(field.shape), box[axis], taken[axis].start
        shape[axis] = rows.stop - rows.start
        result = np.empty(shape, dtype=np.float32)
        # Products of single planes: they fit the processor's cache.
        source, out = (field, result) if axis else (field.transpose(1, 0, 2), result.transpose(1, 0, 2))
        for start in range(rows.start, rows.stop, _ROWS):
            some = slice(start, min(start + _ROWS, rows.stop))
            low, high = int(first[some.start]), int(last[some.stop - 1])
            near, to = slice(low - begins, high - begins), slice(start - rows.start, some.stop - rows.start)
            if axis < 2:
                np.matmul(matrix[some, low:high], source[:, near], out=out[:, to])
            else:
                np.matmul(source[..., near], transposed[low:high, some], out=out[..., to])
        field = result
    return field


@lru_cache(maxsize=16)
def _gaussian(size: int, width: float) -> Band:
    """Return normalised Gaussian weights about each voxel, the outermost ones repeated beyond."""
    reach = int(np.ceil(_TRUNCATE * width)) + 1
    away = np.arange(-reach, size + reach)[None, :] - np.arange(size)[:, None]
    bell = np.exp(-0.5 * (away / max(width, 1e-3)) ** 2) * (np.abs(away) <= max(_TRUNCATE * width, 0.75))
    bell /= bell.sum(axis=1, keepdims=True)
    matrix = bell[:, reach : reach + size].copy()
    matrix[:, 0] += bell[:, :reach].sum(axis=1)
    matrix[:, -1] += bell[:, reach + size :].sum(axis=1)
    used = matrix != 0.0
    single = matrix.astype(np.float32)
    last = size - np.argmax(used[:, ::-1], axis=1)
    return single, np.argmax(used, axis=1), last, np.ascontiguousarray(single.T)

"""Statistics and places of the voxels in a mask, by compiled kernels where they were built, else by numpy."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import compiled, shape_of
from legacy.stapeskit.arrays import Array

Mask = NDArray[np.bool_]
Grey = NDArray[np.float32]
_LOWEST = ("uint8", "int16", "uint16", "float32")


@dataclass(frozen=True)
class Sums:
    """Numbers and sums of the grey values in a mask.

    Attributes
    ----------
    count, total : tuple of 3 ndarray
        By layer (z), row (y) and column (x).
    eighth_count, eighth_total : ndarray, (8,)
        By eighth of the box, z, y, x halves in order.
    """

    count: tuple[Array, Array, Array]
    total: tuple[Array, Array, Array]
    eighth_count: Array
    eighth_total: Array

    @property
    def mean(self) -> float:
        """Mean grey value."""
        return float(self.total[0].sum() / self.count[0].sum())


def sums(grey: Grey, mask: Mask) -> Sums:
    """Add up the grey values [z, y, x] in a mask; halves of the box end behind n // 2 + 1 voxels."""
    kernels = compiled()
    if kernels is None or not _is_plain(grey, mask):
        axes = ((1, 2), (0, 2), (0, 1))
        count = [np.count_nonzero(mask, axis=others).astype(float) for others in axes]
        total = [np.sum(grey, axis=others, where=mask, dtype=float) for others in axes]
        halves = [(slice(0, n // 2 + 1), slice(n // 2 + 1, n)) for n in grey.shape]
        parts = [grey[eighth][mask[eighth]] for eighth in product(*halves)]
        sizes = np.array([float(part.size) for part in parts])
        means = np.array([float(part.sum(dtype=float)) for part in parts])
        return Sums((count[0], count[1], count[2]), (total[0], total[1], total[2]), sizes, means)
    length = sum(grey.shape) + 8
    number, value = np.empty(length, dtype=np.int64), np.empty(length)
    kernels.masked_sums(
        grey.ctypes.data, mask.ctypes.data, shape_of(grey), number.ctypes.data, value.ctypes.data
    )
    ends = np.cumsum(grey.shape)
    z, y, x, c = np.split(number.astype(float), ends)
    sz, sy, sx, s = np.split(value, ends)
    return Sums((z, y, x), (sz, sy, sx), c, s)


def deviation(grey: Grey, mask: Mask, level: float) -> float:
    """Return the root mean square difference of the grey values in a mask from a level."""
    kernels = compiled()
    if kernels is None or not _is_plain(grey, mask):
        return float(np.sqrt(np.mean((grey[mask].astype(float) - level) ** 2)))
    total = np.empty(1)
    kernels.masked_squares(grey.ctypes.data, mask.ctypes.data, grey.size, level, total.ctypes.data)
    return float(np.sqrt(total[0] / np.count_nonzero(mask)))


def every_nth(mask: Mask, step: int) -> NDArray[np.int64]:
    """Return the flat places (n,) of every ``step``-th voxel of a mask, from the first on."""
    kernels = compiled()
    if kernels is None or not mask.flags.c_contiguous:
        return np.flatnonzero(mask)[::step]
    room = -(-np.count_nonzero(mask) // step)
    place = np.empty(room, dtype=np.int64)
    kernels.every_nth(mask.ctypes.data, mask.size, step, room, place.ctypes.data)
    return place


def lowest(values: NDArray[Any], mask: Mask) -> tuple[float, int]:
    """Return the lowest value in a mask, and how many voxels have it."""
    kernels = compiled()
    if kernels is None or values.dtype.name not in _LOWEST or not _is_plain(values, mask):
        inside = values[mask]
        return float(inside.min()), int(np.count_nonzero(inside == inside.min()))
    low, count = np.empty(1), np.empty(1, dtype=np.int64)
    kernel = getattr(kernels, f"lowest_{values.dtype.name}")
    kernel(values.ctypes.data, mask.ctypes.data, values.size, low.ctypes.data, count.ctypes.data)
    return float(low[0]), int(count[0])


def places_between(
    grey: Grey, mask: Mask, low: float, high: float, reach: NDArray[np.int_]
) -> NDArray[np.int64]:
    """Return the places z, y, x (n, 3) of a mask with grey values between two, ``reach`` off the border."""
    kernels = compiled()
    if kernels is None or not _is_plain(grey, mask):
        inner = tuple(slice(int(r), -int(r)) for r in reach)
        part = grey[inner]
        return np.argwhere(mask[inner] & (part > low) & (part < high)) + reach
    off = np.ascontiguousarray(reach, dtype=np.int64)
    place = np.empty((0, 3), dtype=np.int64)
    for _ in range(2):
        given = (grey.ctypes.data, mask.ctypes.data, shape_of(grey), off.ctypes.data)
        count = kernels.between(*given, low, high, len(place), place.ctypes.data)
        if count == len(place):
            break
        place = np.empty((count, 3), dtype=np.int64)
    return place


def gather_voxels(
    grey: Grey, mask: Mask, inner: Mask, noise: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Return index x, y, z (n, 3), grey value and noise (n,) of a mask: the second noise in ``inner``."""
    kernels = compiled()
    if kernels is None or not (_is_plain(grey, mask) and inner.flags.c_contiguous):
        index = np.stack(np.nonzero(mask)[::-1], axis=1).astype(float)
        return index, grey[mask].astype(float), np.where(inner[mask], noise[1], noise[0])
    count = np.count_nonzero(mask)
    index, value, own = np.empty((count, 3)), np.empty(count), np.empty(count)
    both = np.array(noise, dtype=float)
    kernels.gathered(
        *(grey.ctypes.data, mask.ctypes.data, inner.ctypes.data, shape_of(grey), both.ctypes.data),
        *(index.ctypes.data, value.ctypes.data, own.ctypes.data),
    )
    return index, value, own


def look_up(number: NDArray[np.int32], table: Mask) -> Mask:
    """Return the flag of every number in a table (n,)."""
    kernels = compiled()
    if kernels is None or not number.flags.c_contiguous or table[0]:
        return np.asarray(table[number])
    out = np.empty(number.shape, dtype=bool)
    flags = np.ascontiguousarray(table)
    kernels.looked_up(number.ctypes.data, number.size, flags.ctypes.data, len(flags), out.ctypes.data)
    return out


def _is_plain(values: NDArray[Any], mask: Mask) -> bool:
    """Return whether both are contiguous and of native byte order, as the kernels need them."""
    native = values.dtype.isnative and values.flags.c_contiguous
    return bool(native and mask.flags.c_contiguous and values.shape == mask.shape)

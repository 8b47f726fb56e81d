"""Voxels inside a material: a histogram of their means over a cross of seven, computed slab by slab."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import checked, compiled, shape_of
from legacy.stapeskit.arrays import Array

Part = TypeVar("Part")
# A slab of this size stays in the cache of a core.
_SLAB_VOXELS = 100_000
_THREADS = 2


@dataclass(frozen=True)
class Interior:
    """Means over a voxel and its six neighbours, in bins, for all but the outermost voxels.

    Attributes
    ----------
    bins : ndarray of uint16, [z, y, x]
        Bin of each mean.
    histogram : ndarray of int, (n,)
        How many voxels agree with their neighbours, by bin.
    low, width : float
        Where the first bin begins, and how wide each is.
    """

    bins: NDArray[np.uint16]
    histogram: NDArray[np.int64]
    low: float
    width: float

    @property
    def centres(self) -> Array:
        """Grey values in the middle of the bins, (n,)."""
        return np.asarray(self.low + (np.arange(len(self.histogram), dtype=float) + 0.5) * self.width)

    def near(self, level: float, reach: float) -> NDArray[np.bool_]:
        """Return the voxels whose mean lies within ``reach`` of a level, to the bin."""
        first, last = self._limits(level, reach)
        return np.asarray((self.bins >= first) & (self.bins < last))

    def filled(self, level: float, reach: float) -> tuple[int, int]:
        """Return how many means lie within ``reach`` of a level, and how many cubes of three they fill."""
        kernels = compiled()
        if kernels is None:
            mask = self.near(level, reach)
            return int(np.count_nonzero(mask)), _cubes(mask)
        cubes, bins = np.zeros(1, dtype=np.int64), np.ascontiguousarray(self.bins)
        given = (bins.ctypes.data, shape_of(bins), *self._limits(level, reach), cubes.ctypes.data)
        return checked(kernels.cubes_near(*given)), int(cubes[0])

    def _limits(self, level: float, reach: float) -> tuple[int, int]:
        first, last = ((level + side - self.low) / self.width for side in (-reach, reach))
        return max(0, round(first)), max(0, round(last))


def interior(grey: NDArray[np.float32], scatter: float, width: float) -> Interior:
    """Find the voxels whose cross of seven lies in one material.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    scatter : float
        Most that the seven may scatter (standard deviation).
    width : float
        Of a bin; at most 65535 fit between the lowest and the highest grey value.

    Notes
    -----
    With d the six differences to the middle voxel, the sum of squares about the mean of seven is
    sum(d^2) - sum(d)^2 / 7: small numbers, whatever the grey level.
    """
    low = float(grey.min()) - width
    count = int((float(grey.max()) - low) / width) + 2
    bins = np.empty(tuple(n - 2 for n in grey.shape), dtype=np.uint16)
    layers = max(1, _SLAB_VOXELS // max(1, grey.shape[1] * grey.shape[2]))
    limit = np.float32(6.0 * scatter**2)
    kernels = compiled()
    if kernels is not None:
        grey, layers = np.ascontiguousarray(grey), max(1, -(-len(bins) // (4 * _THREADS)))

    def slab(start: int) -> NDArray[np.int64]:
        out = bins[start : start + layers]
        source = grey[start : start + len(out) + 2]
        if kernels is not None:
            counts = np.zeros(count, dtype=np.int64)
            scale = (limit, np.float32(low), np.float32(1.0 / width))
            given = (source.ctypes.data, len(out), *source.shape[1:], *map(float, scale))
            kernels.interior(*given, out.ctypes.data, counts.ctypes.data)
            return counts
        mean, flat = _cross(source, limit)
        mean -= np.float32(low)
        mean *= np.float32(1.0 / width)
        np.copyto(out, mean, casting="unsafe")
        key = (out + np.uint16(1)) * flat
        return np.bincount(key.ravel(), minlength=count + 1)[1:]

    histogram = sum(in_threads(slab, range(0, len(bins), layers)), np.zeros(count, dtype=np.int64))
    return Interior(bins, histogram, low, width)


def _cross(source: NDArray[np.float32], limit: np.float32) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean over each voxel's cross of seven, and where its scatter is small.

    Layers are taken as one long row, in which a neighbour is so many places on; what that makes of the first
    and last row and column is left out.
    """
    _, rows, columns = source.shape
    layer = rows * columns
    flat = source.reshape(-1)
    first, last = layer, flat.size - layer
    total = square = np.zeros(0, dtype=np.float32)
    for stride in (layer, columns, 1):
        steps = flat[first : last + stride] - flat[first - stride : last]
        back, ahead = steps[:-stride], steps[stride:]
        if stride == layer:
            total = ahead - back
        else:
            total -= back
            total += ahead
        steps *= steps
        if stride == layer:
            square = back + ahead
        else:
            square += back
            square += ahead
    spare = total * total
    spare *= np.float32(1.0 / 7.0)
    square -= spare
    total *= np.float32(1.0 / 7.0)
    total += flat[first:last]
    inner = (slice(None), slice(1, -1), slice(1, -1))
    calm = (square < limit).reshape(-1, rows, columns)
    return total.reshape(-1, rows, columns)[inner], calm[inner]


def _cubes(mask: NDArray[np.bool_]) -> int:
    """Return how many cubes of three voxels a mask holds."""
    inner = mask[2:] & mask[1:-1] & mask[:-2]
    inner = inner[:, 2:] & inner[:, 1:-1] & inner[:, :-2]
    return int(np.count_nonzero(inner[:, :, 2:] & inner[:, :, 1:-1] & inner[:, :, :-2]))


def in_threads(work: Callable[[int], Part], places: Iterable[int]) -> list[Part]:
    """Do the same work at several places on two threads; the results come in order."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(work, places))

"""Measure how much of every voxel a closed surface fills: exact along z, sampled on sub-columns across.

A column meets the surface at crossings. Each crossing at height z fills the voxels above it when the column
enters the body and empties them when it leaves; a voxel cut by the crossing counts by its part. So the sum
over a body is its volume up to the sampling across, and no level or threshold enters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulate.solids import Solid
from stapeskit.arrays import Array

_OFFSET = 1.234567e-7  # voxels: no sub-column runs along the edges of a mesh with round coordinates
_MOST_AT_ONCE = 1 << 23  # voxels of a slab in double precision: 64 MB
_TRIED_AT_ONCE = 1 << 15  # sub-columns whose numbers, some 3 MB, stay in the cache


@dataclass(frozen=True)
class Crossings:
    """Where the sub-columns of a grid meet a closed surface."""

    layer: NDArray[np.int16]  # slice of the voxel that is crossed, ascending
    column: NDArray[np.int32]  # flat index y * nx + x of the voxel column
    height: Array  # in voxels, voxel k spanning k - 0.5 to k + 0.5
    weight: Array  # +1/s^2 where the column enters the body going up z, -1/s^2 where it leaves it
    shape: tuple[int, int]  # (nx, ny) of the grid

    def slab(self, first: int, count: int) -> NDArray[np.float32]:
        """Return the filled fraction of ``count`` slices from slice ``first`` on, (z, y, x), 0 to 1."""
        nx, ny = self.shape
        filled = np.empty((count, ny, nx), dtype=np.float32)
        step = max(1, _MOST_AT_ONCE // (nx * ny))
        for start in range(0, count, step):
            part = filled[start : start + step]
            part[...] = self._fill(first + start, len(part)).reshape(part.shape)
        return filled

    def _fill(self, first: int, count: int) -> Array:
        """Return the fractions as (z, y * nx + x)."""
        size = self.shape[0] * self.shape[1]
        low, high = np.searchsorted(self.layer, [first, first + count])
        height = self.height[low:high] - first
        weight = self.weight[low:high]
        bottom = self.layer[low:high].astype(np.int64) - first
        part = bottom + 0.5 - height
        flat = bottom * size + self.column[low:high]
        above = bottom + 1 < count
        filled = np.zeros((count, size))
        steps = filled.reshape(-1)
        steps += np.bincount(flat, weight * part, minlength=count * size)
        steps += np.bincount(flat[above] + size, (weight * (1.0 - part))[above], minlength=count * size)
        filled[0] += np.bincount(self.column[:low], self.weight[:low], minlength=size)
        np.cumsum(filled, axis=0, out=filled)
        return filled


def crossings(vertices: Array, faces: NDArray[np.int64], shape: tuple[int, int], samples: int) -> Crossings:
    """Find where the sub-columns of a grid (nx, ny), ``samples`` along each side of a voxel, cross a surface.

    Its vertices (n, 3) are in voxels, the centre of voxel 0 at 0; what lies outside the grid is cut off.
    """
    nx, ny = shape
    corners = np.array(vertices, dtype=float)
    corners[:, :2] = (corners[:, :2] + 0.5) * samples - 0.5 - _OFFSET * np.array([1.0, 2.0])
    corners = corners[faces]  # sub-column k along x or y is at k
    area = _twice_area(corners)
    corners, sign = corners[area != 0.0], np.where(area[area != 0.0] > 0.0, -1.0, 1.0) / samples**2
    most = np.array([nx, ny]) * samples
    first = np.clip(np.ceil(corners.min(axis=1)[:, :2]), 0, most).astype(np.int64)
    last = np.clip(np.floor(corners.max(axis=1)[:, :2]), -1, most - 1).astype(np.int64)
    size, planes = np.maximum(last - first + 1, 0), _planes(corners)
    stop = np.cumsum(size.prod(axis=1))  # of all sub-columns below the boxes around triangles
    start = stop - size.prod(axis=1)
    parts = [(np.zeros(0, dtype=np.int32), np.zeros(0), np.zeros(0))]
    for begin in range(0, int(stop[-1]) if len(stop) else 0, _TRIED_AT_ONCE):
        tried = np.arange(begin, min(begin + _TRIED_AT_ONCE, int(stop[-1])))
        own = np.searchsorted(stop, tried, side="right")
        y, x = np.divmod(tried - start[own], size[own, 0])
        x, y = x + first[own, 0], y + first[own, 1]
        v, w = (at[own] + by_x[own] * x + by_y[own] * y for at, by_x, by_y in planes[:2])
        inside = np.flatnonzero((v >= 0.0) & (w >= 0.0) & (v + w < 1.0))
        own, x, y = own[inside], x[inside], y[inside]
        at, by_x, by_y = (plane[own] for plane in planes[2])
        column = (y // samples * nx + x // samples).astype(np.int32)
        parts.append((column, at + by_x * x + by_y * y, sign[own]))
    column, height, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    ends = np.iinfo(np.int16)
    layer = np.clip(np.floor(height + 0.5), ends.min, ends.max).astype(np.int16)
    order = np.argsort(layer, kind="stable")  # by radix: a tenth of what sorting the heights takes
    return Crossings(layer[order], column[order], height[order], weight[order], shape)


def _twice_area(corners: Array) -> Array:
    """Return twice the signed area (n,) of triangles (n, 3, 3) seen along z."""
    (ax, ay, _), (bx, by, _), (cx, cy, _) = corners.transpose(1, 2, 0)
    return np.asarray((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))


def _planes(corners: Array) -> Array:
    """Return v, w and the height over x and y: value at 0 and derivatives, (3, 3, n).

    A place is within a triangle a, b, c, at a + v (b - a) + w (c - a), where v, w and 1 - v - w are positive.
    """
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners.transpose(1, 2, 0)
    area = _twice_area(corners)
    v = np.array([np.zeros_like(area), cy - ay, ax - cx]) / area
    w = np.array([np.zeros_like(area), ay - by, bx - ax]) / area
    height = v * (bz - az) + w * (cz - az)
    planes = np.array([v, w, height])
    planes[:, 0] = -planes[:, 1] * ax - planes[:, 2] * ay
    planes[2, 0] += az
    return planes


def coverage_of(solid: Solid, shape: tuple[int, int, int], voxel_mm: ArrayLike, samples: int = 8) -> Array:
    """Return how much of each voxel (z, y, x) a solid fills, 0 to 1; the centre of voxel 0 is the origin.

    Shape and voxels are along x, y, z; ``samples`` are sub-columns along x and y of a voxel; along z
    the share is exact.
    """
    nx, ny, nz = shape
    grid = crossings(solid.vertices_mm / np.asarray(voxel_mm, dtype=float), solid.faces, (nx, ny), samples)
    return grid.slab(0, nz).astype(float)

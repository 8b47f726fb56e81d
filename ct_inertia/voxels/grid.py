"""Grids of blocks of voxels of one scan, and values carried from one to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

if TYPE_CHECKING:
    from ct_inertia.scan.scan import Scan

Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """Blocks of voxels of a scan.

    Attributes
    ----------
    shape : tuple of 3 int
        Number of blocks along z, y, x.
    first, block : ndarray of int, (3,)
        Index x, y, z in the scan of the first voxel of the first block, and voxels per block.
    spacing_mm : ndarray, (3,)
        Edges of a block along x, y, z.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of a block to scan coordinates of the place where its grey value is taken, mm.
    begins, ends : ndarray of bool, (3,)
        Whether the grid begins, and whether it ends, where the scan does, along x, y, z.
    """

    shape: tuple[int, ...]
    first: Index
    block: Index
    spacing_mm: Array
    scan_from_index: Array
    begins: NDArray[np.bool_]
    ends: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        scan: Scan,
        shape: tuple[int, ...],
        first: Index,
        block: Index,
        taken_at: NDArray[Any] | None = None,
    ) -> Grid:
        """Lay blocks on a scan; ``taken_at``: voxel x, y, z of the first block, its middle if not given."""
        block = np.asarray(block, dtype=np.int64)
        transform = scan.scan_from_index.copy()
        transform[:3, :3] = transform[:3, :3] * block
        transform[:3, 3] = scan.scan_points(first + (block - 1) / 2.0 if taken_at is None else taken_at)
        return Grid(
            shape=shape,
            first=np.asarray(first, dtype=np.int64),
            block=block,
            spacing_mm=scan.spacing_mm * block,
            scan_from_index=transform,
            begins=np.asarray(first == 0),
            ends=np.asarray(first + block * np.array(shape[::-1]) > scan.size - block),
        )

    @property
    def voxel_mm3(self) -> float:
        """Volume of one block, mm3."""
        return float(np.prod(self.spacing_mm))

    @property
    def size(self) -> Index:
        """Number of blocks along x, y, z."""
        return np.array(self.shape[::-1], dtype=np.int64)

    def scan_points(self, index_xyz: NDArray[Any]) -> Array:
        """Return scan coordinates (n, 3), mm, of indices x, y, z (n, 3)."""
        return np.asarray(index_xyz @ self.scan_from_index[:3, :3].T + self.scan_from_index[:3, 3])

    def part(self, box: tuple[slice, ...]) -> Grid:
        """Return the grid of a part, slices z, y, x."""
        low = np.array([along.start for along in box[::-1]], dtype=np.int64)
        high = np.minimum([along.stop for along in box[::-1]], self.size)
        transform = self.scan_from_index.copy()
        transform[:3, 3] += transform[:3, :3] @ low
        return Grid(
            shape=tuple(int(n) for n in (high - low)[::-1]),
            first=self.first + low * self.block,
            block=self.block,
            spacing_mm=self.spacing_mm,
            scan_from_index=transform,
            begins=np.asarray(self.begins & (low == 0)),
            ends=np.asarray(self.ends & (high == self.size)),
        )

    def taken(
        self, values: NDArray[Any], source: Grid, repeat: bool = False, into: NDArray[Any] | None = None
    ) -> NDArray[Any]:
        """Return values [z, y, x] of another grid of the same scan in the middles of the blocks.

        Beyond that grid they are 0, or its outermost ones with ``repeat``, or what ``into`` holds there.
        """
        result = np.zeros(self.shape, dtype=values.dtype) if into is None else into
        to, places = [], []
        for axis, (count, available) in enumerate(zip(self.shape, source.shape, strict=True)):
            k = 2 - axis
            middle = self.first[k] + self.block[k] // 2 + np.arange(count) * self.block[k]
            index = (middle - source.first[k]) // source.block[k]
            index = np.clip(index, 0, available - 1) if repeat else index
            inside = np.flatnonzero((index >= 0) & (index < available))
            to.append(slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0))
            places.append(index[inside])
        result[tuple(to)] = values[np.ix_(*places)]
        return result

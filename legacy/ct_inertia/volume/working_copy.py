"""A working copy of the part of a scan that matters: block means on a grid just fine enough to measure on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.native import checked, compiled
from legacy.ct_inertia.volume.coarse_view import noise_of, replace_non_finite
from legacy.ct_inertia.volume.interior_histogram import in_threads
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

Index = NDArray[np.int64]

WORKING_MM: float = calibrated("working.largest_block_mm")
PARTING_MM: float = calibrated("working.largest_block_in_situ_mm")
# Layers of block means that a thread makes at a time: large enough that threads seldom wait for each other.
_LAYERS = 16


@dataclass(frozen=True)
class Working:
    """A box of the scan, averaged onto a coarser grid.

    Attributes
    ----------
    volume : Volume
        Means over blocks of voxels, float32, with the exact place and spacing of the blocks.
    first : ndarray of int, (3,)
        Index x, y, z in the scan of the box's first voxel.
    block : ndarray of int, (3,)
        Voxels of the scan per block along x, y, z.
    single : ndarray, [z, y, x], or None
        One voxel of the scan out of the middle of every block, in the type of the file; None when every
        block is one voxel.
    noise : float or None
        Standard deviation of the means within a material; None when every block is one voxel.
    """

    volume: Volume
    first: Index
    block: Index
    single: NDArray[Any] | None = None
    noise: float | None = None

    @property
    def grey(self) -> NDArray[np.float32]:
        """The means, [z, y, x]."""
        return self.volume.array

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of blocks along z, y, x."""
        return self.volume.array.shape

    def blocks_of(self, index_xyz: NDArray[np.integer]) -> Index:
        """Return the block (x, y, z) that holds each voxel (n, 3) of the scan; may lie outside."""
        return np.asarray((index_xyz - self.first) // self.block, dtype=np.int64)

    def from_coarse(self, mask: NDArray[np.bool_], step: Index) -> NDArray[np.bool_]:
        """Return a coarse mask [z, y, x] on this grid: each block takes its nearest coarse voxel.

        Parameters
        ----------
        mask : ndarray of bool, [z, y, x]
        step : ndarray of int, (3,)
            Voxels of the scan per coarse voxel; a coarse voxel is the one in the middle of its step.
        """
        places = []
        for axis in range(3):
            k = 2 - axis
            centre = self.first[k] + (self.block[k] - 1) / 2.0 + np.arange(self.shape[axis]) * self.block[k]
            nearest = np.round((centre - step[k] // 2) / step[k]).astype(np.int64)
            places.append(np.clip(nearest, 0, mask.shape[axis] - 1))
        return np.asarray(mask[np.ix_(*places)])

    def at_border(self, scan: Volume) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return along x, y, z whether the box begins, and whether it ends, at the border of the scan."""
        end = self.first + self.block * np.array(self.shape[::-1])
        return np.asarray(self.first == 0), np.asarray(end > scan.size - self.block)


def block_for(spacing_mm: Array, most_mm: float) -> Index:
    """Return the voxels per block along x, y, z: as many as stay within ``most_mm``, at least one."""
    return np.maximum(np.floor(most_mm / np.asarray(spacing_mm)), 1.0).astype(np.int64)


def working_box(
    volume: Volume, low: Index, high: Index, margin_mm: float, margin_blocks: int, most_mm: float = WORKING_MM
) -> Working:
    """Read a box of the scan once, averaged over blocks.

    Parameters
    ----------
    volume : Volume
    low, high : ndarray of int, (3,)
        First voxel x, y, z of what shall be in the box, and one past its last.
    margin_mm, margin_blocks : float, int
        Around it, whichever is more, as far as the scan reaches.
    most_mm : float
        Largest edge of a block.

    Notes
    -----
    Sums over the means times the block's volume are the sums over the voxels: the grey integral and its
    first moments do not change. A block counts as one larger voxel in the point spread. Where the box ends
    at the border of the scan, its blocks end there too.

    Raises
    ------
    CtInertiaError
        Voxels that are not finite where they are not allowed.
    """
    block = block_for(volume.spacing_mm, most_mm)
    margin = np.maximum(margin_blocks * block, np.ceil(margin_mm / volume.spacing_mm)).astype(np.int64)
    first = np.maximum(low.astype(np.int64) - margin, 0)
    last = np.minimum(high.astype(np.int64) + margin, volume.size)
    ends = last == volume.size
    rest = (last - first) % block
    whole = ends & (first == 0) & (rest > 0)
    block = np.where(whole, 1, block)
    rest = np.where(whole, 0, rest)
    # Blocks end with the scan where the box does; elsewhere the last one may begin anew inside the margin.
    first = np.where(ends & (first > 0), first + rest, first)
    count = (last - first) // block
    grid = replace(
        volume,
        array=_means(volume, first, count, block),
        spacing_mm=volume.spacing_mm * block,
        origin_mm=volume.scan_points(first + (block - 1) / 2.0),
    )
    if np.all(block == 1):
        return Working(grid, first, block)
    return Working(grid, first, block, _singles(volume, first, count, block), noise_of(grid.array))


def _means(volume: Volume, first: Index, count: Index, block: Index) -> NDArray[np.float32]:
    x, y, z = (int(v) for v in first)
    nx, ny, nz = (int(v) for v in count)
    bx, by, bz = (int(v) for v in block)
    if bx == by == bz == 1:
        return replace_non_finite(volume.array[z : z + nz, y : y + ny, x : x + nx], volume)
    means = np.empty((nz, ny, nx), dtype=np.float32)
    share = np.float32(1.0 / (bx * by * bz))
    array = volume.array
    kernel = _kernel(array)
    if kernel is not None:
        width = array.itemsize
        step = np.array(array.strides[:2], dtype=np.int64) // width
        block = np.array((bz, by, bx), dtype=np.int64)

        def some(start: int) -> None:
            out = means[start : start + _LAYERS]
            size = np.array(out.shape, dtype=np.int64)
            place = array[z + start * bz :, y:, x:].ctypes.data
            given = (place, step.ctypes.data, size.ctypes.data, block.ctypes.data, float(share))
            checked(kernel(*given, out.ctypes.data))

        in_threads(some, range(0, nz, _LAYERS))
        return means

    def layers(start: int) -> None:
        for k in range(start, min(start + _LAYERS, nz)):
            part = volume.array[z + k * bz : z + (k + 1) * bz, y : y + ny * by, x : x + nx * bx]
            slab = replace_non_finite(part, volume)
            layer = slab[0]
            for other in slab[1:]:
                layer += other
            rows = layer[::by].copy()
            for j in range(1, by):
                rows += layer[j::by]
            rows *= share
            np.copyto(means[k], rows[:, ::bx])
            for i in range(1, bx):
                means[k] += rows[:, i::bx]

    in_threads(layers, range(0, nz, _LAYERS))
    return means


def _kernel(array: Any) -> Any:
    """Return the kernel that takes means of an array; None where it has whole rows of no kernel's type."""
    kernels = compiled()
    if kernels is None or not isinstance(array, np.ndarray) or not array.dtype.isnative:
        return None
    whole = array.strides[2] == array.itemsize and all(
        s > 0 and s % array.itemsize == 0 for s in array.strides
    )
    return getattr(kernels, f"means_{array.dtype.name}", None) if whole and array.dtype.kind in "ui" else None


def _singles(volume: Volume, first: Index, count: Index, block: Index) -> NDArray[Any]:
    start = first + block // 2
    stop = first + count * block
    part = tuple(slice(int(a), int(b), int(s)) for a, b, s in zip(start, stop, block, strict=True))[::-1]
    return np.array(volume.array[part])

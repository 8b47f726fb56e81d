"""Arrays that read and unpack blocks of a file when they are indexed."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from threading import Lock
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

Key = tuple[slice, slice, slice]
_Touch = tuple[int, slice, slice]
ReadBlock = Callable[[int, int, int], NDArray[Any]]
# Bound the memory of layers read together and of blocks kept for the next index.
_LAYER_BYTES = 64 << 20
_KEPT_BYTES = 64 << 20
# Layers of fewer bytes are read together: a damaged shape claims a million of them.
_SMALL_BYTES = 1 << 20


class _Kept:
    """The blocks unpacked last, up to a number of bytes."""

    def __init__(self, read: ReadBlock) -> None:
        self.read, self._lock, self._bytes = read, Lock(), 0
        self._blocks: OrderedDict[tuple[int, int, int], NDArray[Any]] = OrderedDict()

    def __call__(self, z: int, y: int, x: int) -> NDArray[Any]:
        with self._lock:
            kept = self._blocks.get((z, y, x))
        if kept is not None:
            return kept
        block = self.read(z, y, x)
        if block.nbytes > _KEPT_BYTES or isinstance(block, np.memmap):
            return block
        with self._lock:
            if (z, y, x) not in self._blocks:
                self._blocks[z, y, x] = block
                self._bytes += block.nbytes
            while self._bytes > _KEPT_BYTES:
                self._bytes -= self._blocks.popitem(last=False)[1].nbytes
        return block


@dataclass(frozen=True)
class Gaps:
    """Blocks that are not stored and whose voxels have one value.

    Attributes
    ----------
    present : ndarray of bool, [z, y, x]
        Which blocks are stored.
    fill : ndarray, ()
        Value of the other voxels.
    """

    present: NDArray[np.bool_]
    fill: NDArray[Any]

    def stored(self, touched: Sequence[Sequence[_Touch]]) -> list[tuple[_Touch, ...]]:
        """Return those of the touched blocks that are stored."""
        numbers = [np.array([touch[0] for touch in axis], dtype=np.int64) for axis in touched]
        places = np.argwhere(self.present[np.ix_(*numbers)]).tolist()
        return [tuple(axis[n] for axis, n in zip(touched, at, strict=True)) for at in places]


@dataclass(frozen=True)
class Level:
    """The picture at a coarser resolution: voxels of the fine one per voxel along z, y, x, and the array."""

    factors: tuple[int, int, int]
    array: BlockArray


class BlockArray:
    """An array [z, y, x] in blocks; indexing reads, unpacks and returns the voxels asked for.

    Parameters
    ----------
    shape : sequence of 3 int
        z, y, x.
    dtype : dtype
    block : sequence of 3 int
        Voxels of a block along z, y, x; blocks at the far ends may be smaller.
    read : callable
        Takes the number of a block along z, y, x and returns its voxels [z, y, x]; called by several
        threads at once.
    ranges : tuple of 3 ranges, optional
        Which planes, rows and columns this array shows, in order; all of them by default.
    gaps : Gaps, optional
        Blocks that are not stored: they are not read and take no time.

    Notes
    -----
    ``levels`` holds the same picture at coarser resolutions, finest first, where the file has them. Only
    the blocks that an index touches are read; those of a slab thinner than its blocks are kept, up to
    64 MiB.
    """

    ndim = 3

    def __init__(
        self,
        shape: Sequence[int],
        dtype: np.dtype,
        block: Sequence[int],
        read: ReadBlock,
        ranges: tuple[range, ...] | None = None,
        gaps: Gaps | None = None,
    ) -> None:
        self.dtype = np.dtype(dtype)
        self._stored = tuple(int(n) for n in shape)
        self._block = tuple(int(n) for n in block)
        self._read = read if isinstance(read, _Kept) else _Kept(read)
        self._ranges = ranges or tuple(range(n) for n in self._stored)
        self._gaps = gaps
        self.levels: tuple[Level, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along z, y, x."""
        return tuple(len(r) for r in self._ranges)

    @property
    def size(self) -> int:
        """Number of voxels."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def nbytes(self) -> int:
        """Bytes of all voxels once unpacked."""
        return self.size * self.dtype.itemsize

    def as_array(self) -> NDArray[Any]:
        """Return the block array itself, typed as the ndarray that it behaves like."""
        return cast(NDArray[Any], self)

    def view(self, key: Key) -> BlockArray:
        """Return the part in three slices z, y, x without reading it."""
        ranges = tuple(r[s] for r, s in zip(self._ranges, key, strict=True))
        return BlockArray(self._stored, self.dtype, self._block, self._read, ranges, self._gaps)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        keys = key if isinstance(key, tuple) else (key,)
        if any(k is Ellipsis for k in keys):
            at = next(i for i, k in enumerate(keys) if k is Ellipsis)
            keys = (*keys[:at], *(slice(None),) * (4 - len(keys)), *keys[at + 1 :])
        if len(keys) > 3 or not all(isinstance(k, (int, np.integer, slice)) for k in keys):
            return np.asarray(self)[key]
        keys = (*keys, *(slice(None),) * (3 - len(keys)))
        slices, dropped = [], []
        for axis, k in enumerate(keys):
            if isinstance(k, slice):
                slices.append(k)
                continue
            at = range(len(self._ranges[axis]))[int(k)]
            slices.append(slice(at, at + 1))
            dropped.append(axis)
        part = self.view((slices[0], slices[1], slices[2]))._gather()
        return part.reshape([n for axis, n in enumerate(part.shape) if axis not in dropped])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        array = self._gather()
        return array if dtype is None else array.astype(dtype, copy=False)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give plane after plane, reading each block once."""
        plane = max(1, self.shape[1] * self.shape[2] * self.dtype.itemsize)
        depth = self._block[0] if plane * self._block[0] <= 4 * _LAYER_BYTES else 1
        depth *= max(1, _SMALL_BYTES // (plane * depth))
        for first in range(0, len(self), depth):
            yield from self[first : first + depth]

    def _gather(self) -> NDArray[Any]:
        out = np.empty(self.shape, dtype=self.dtype.newbyteorder("="))
        # Only a slab thinner than its blocks is likely to be followed by the next one in the same blocks.
        planes = self._ranges[0]
        thin = len(planes) > 0 and abs(planes[-1] - planes[0]) + 1 < self._block[0]
        read = self._read if thin else self._read.read
        touched = [_find_touched(r, n) for r, n in zip(self._ranges, self._block, strict=True)]
        tasks = list(product(*touched)) if self._gaps is None else self._gaps.stored(touched)
        if self._gaps is not None:
            out.fill(self._gaps.fill)

        def fill(task: tuple[_Touch, ...]) -> None:
            (bz, oz, iz), (by, oy, iy), (bx, ox, ix) = task
            out[oz, oy, ox] = read(bz, by, bx)[iz, iy, ix]

        workers = min(len(tasks), os.cpu_count() or 1)
        if workers > 1:
            from concurrent.futures import ThreadPoolExecutor

            with ThreadPoolExecutor(workers) as pool:
                for _ in pool.map(fill, tasks):
                    pass
        else:
            for task in tasks:
                fill(task)
        return out


def _find_touched(wanted: range, block: int) -> list[_Touch]:
    """Return for each block that a range touches: its number, the places in the result, those inside it."""
    if not wanted:
        return []
    where = np.asarray(wanted)
    numbers = where // block
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    ends = np.append(starts[1:], where.size)
    touches = []
    for a, b in zip(starts.tolist(), ends.tolist(), strict=True):
        inside = where[a:b] - numbers[a] * block
        low, high = int(inside[0]), int(inside[-1])
        stop = high + (1 if wanted.step > 0 else -1)
        chosen = slice(low, None if stop < 0 else stop, wanted.step)
        touches.append((int(numbers[a]), slice(a, b), chosen))
    return touches


def sampled(array: NDArray[Any], steps: tuple[int, int, int]) -> tuple[NDArray[Any], bool]:
    """Return every n-th voxel along z, y, x, and whether they come from a coarser level of the picture.

    The first is the one in the middle of its step. From a coarser level the voxel around it is taken.
    """
    fit = [
        level
        for level in getattr(array, "levels", ())
        if all(f <= s for f, s in zip(level.factors, steps, strict=True))
    ]
    if not fit:
        z, y, x = (slice(s // 2, None, s) for s in steps)
        return np.asarray(array[z, y, x]), False
    level = max(fit, key=lambda entry: int(np.prod(entry.factors)))
    places = [
        np.minimum(np.arange(s // 2, n, s) // f, m - 1)
        for s, n, f, m in zip(steps, array.shape, level.factors, level.array.shape, strict=True)
    ]
    return np.asarray(level.array)[np.ix_(*places)], True


def part_of(array: NDArray[Any], key: Key) -> NDArray[Any]:
    """Return a part of an array as a view; of a block array too, unread."""
    if isinstance(array, BlockArray):
        return array.view(key).as_array()
    return array[key]


def scaled(array: NDArray[Any], slope: float, intercept: float) -> NDArray[Any]:
    """Return the array under ``slope * value + intercept`` as float32, plane by plane when asked for."""
    if slope == 1.0 and intercept == 0.0:
        return array
    nz, ny, nx = array.shape

    def plane(z: int, _y: int, _x: int) -> NDArray[Any]:
        return (array[z : z + 1].astype(np.float64) * slope + intercept).astype(np.float32)

    return BlockArray((nz, ny, nx), np.dtype(np.float32), (1, ny, nx), plane).as_array()


def invert_grey_values(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array with bright and dark exchanged, in its own type, plane by plane when asked for.

    Notes
    -----
    Whole numbers are counted from the other end of their type's range, floats change their sign: done twice,
    nothing has changed.
    """
    nz, ny, nx = array.shape
    dtype = array.dtype.newbyteorder("=")

    def plane(z: int, _y: int, _x: int) -> NDArray[Any]:
        values = np.asarray(array[z : z + 1]).astype(dtype, copy=False)
        # Inverted bits are the lowest plus the highest number less the value.
        return -values if dtype.kind == "f" else np.invert(values)

    return BlockArray((nz, ny, nx), dtype, (1, ny, nx), plane).as_array()

"""Voxels of a file as an array: mapped into memory under a guard, otherwise read in pieces."""

from __future__ import annotations

import mmap
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.native import compiled
from legacy.ct_inertia.readers.checks import check_size
from legacy.ct_inertia.readers.refusals import ends_too_early, unreadable
from legacy.ct_inertia.volume.lazy_arrays import BlockArray

# Read at once: large enough that the calls cost little, small enough for a part of a plane.
_PIECE_BYTES = 1 << 18


def mapped(
    file: Path, dtype: np.dtype, offset: int, shape: Sequence[int], name: str, plane_step: int = 0
) -> NDArray[Any]:
    """Return voxels of a file without reading them.

    Parameters
    ----------
    offset : int
        Of the first voxel; -1 counts back from the end of the file.
    shape : sequence of int
        z, y, x, and layers where there are several.
    name : str
        File name for messages.
    plane_step : int
        Bytes from plane to plane, where other things lie between them.

    Returns
    -------
    ndarray or BlockArray
        A map, where the compiled kernels can guard it against a file that shrinks or a disk that fails
        (`lost_pages`); otherwise an array that reads pieces when it is indexed.

    Raises
    ------
    CtInertiaError
        The file is shorter than the voxels.
    """
    dtype = np.dtype(dtype)
    try:
        stored = file.stat().st_size
    except (OSError, ValueError) as fault:
        raise unreadable(file, fault) from fault
    plane = dtype.itemsize
    for n in shape[1:]:
        plane *= int(n)
    step = plane_step or plane
    needed = step * (int(shape[0]) - 1) + plane
    if offset < 0:
        offset = max(0, stored - needed)
    check_size(shape, dtype, max(0, stored - offset), name)
    if offset + needed > stored:
        raise ends_too_early(file)
    start = offset % mmap.ALLOCATIONGRANULARITY
    length = needed + start
    if length <= 2 * _PIECE_BYTES:  # not worth a map
        data = _read(file, offset, needed)
        return np.ndarray(tuple(shape), dtype, data, 0, _strides(shape, dtype, step))
    pages = _guard_map(file, length, offset - start) if len(shape) == 3 or compiled() is not None else None
    if pages is None:
        return _pieces(file, dtype, offset, shape, step)
    return np.ndarray(tuple(shape), dtype, pages, start, _strides(shape, dtype, step))


def lost_pages() -> int:
    """Return how often mapped pages were gone when they were read: the numbers are then worthless."""
    kernels = compiled()
    return 0 if kernels is None else int(kernels.lost_pages())


def read_at(file: Path, offset: int, count: int) -> bytes:
    """Return bytes of a file.

    Raises
    ------
    CtInertiaError
        It ends before, or cannot be read.
    """
    return bytes(_read(file, offset, count))


def _guard_map(file: Path, length: int, offset: int) -> mmap.mmap | None:
    kernels = compiled()
    if kernels is None:
        return None
    try:
        with file.open("rb") as stream:
            pages = mmap.mmap(stream.fileno(), length, access=mmap.ACCESS_READ, offset=offset)
    except (OSError, ValueError) as fault:
        raise unreadable(file, fault) from fault
    slot = kernels.guarded(np.frombuffer(pages, np.uint8).ctypes.data, length)
    if slot < 0:
        return None
    weakref.finalize(pages, kernels.unguarded, slot).atexit = False
    return pages


def _pieces(file: Path, dtype: np.dtype, offset: int, shape: Sequence[int], step: int) -> NDArray[Any]:
    """Return an array whose blocks, some rows of a plane, are read when they are asked for."""
    if len(shape) != 3:  # layers of a segmentation, which is held in memory anyway
        data = _read(file, offset, step * int(shape[0]))
        return np.ndarray(tuple(shape), dtype, data, 0)
    nz, ny, nx = (int(n) for n in shape)
    row = nx * dtype.itemsize
    rows = min(ny, max(1, _PIECE_BYTES // row))

    def part(z: int, number: int, _x: int) -> NDArray[Any]:
        first = number * rows
        count = min(rows, ny - first)
        data = _read(file, offset + z * step + first * row, count * row)
        return np.ndarray((1, count, nx), dtype, data)

    return BlockArray((nz, ny, nx), dtype, (1, rows, nx), part).as_array()


def _strides(shape: Sequence[int], dtype: np.dtype, step: int) -> tuple[int, ...]:
    strides = [dtype.itemsize]
    for n in reversed(shape[2:]):
        strides.insert(0, strides[0] * int(n))
    return (step, *strides)


def _read(file: Path, offset: int, count: int) -> bytearray:
    data = bytearray(count)
    view, filled = memoryview(data), 0
    try:
        with file.open("rb", buffering=0) as stream:
            stream.seek(offset)
            while filled < count:
                got = stream.readinto(view[filled:])
                if not got:
                    raise ends_too_early(file)
                filled += got
    except (OSError, ValueError) as fault:
        if isinstance(fault, CtInertiaError):
            raise
        raise unreadable(file, fault) from fault
    return data

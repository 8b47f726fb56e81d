"""Operations on masks of voxels: the box that holds one, a layer more or less."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Slices = tuple[slice, slice, slice]
EVERYWHERE: Slices = (slice(None), slice(None), slice(None))


def used_box(mask: NDArray[Any]) -> Slices | None:
    """Return the slices z, y, x of the smallest box that holds a mask; None for an empty one."""
    flat = np.any(mask, axis=0)
    uses = (np.any(mask, axis=(1, 2)), np.any(flat, axis=1), np.any(flat, axis=0))
    if not uses[1].any():
        return None
    ends = [np.flatnonzero(use)[[0, -1]] for use in uses]
    z, y, x = (slice(int(first), int(last) + 1) for first, last in ends)
    return z, y, x


def widened(box: Slices | None, margin: Any) -> Slices:
    """Return a box with so many voxels more on each side (one number, or three along z, y, x)."""
    z, y, x = (
        slice(max(0, part.start - int(n)), part.stop + int(n))
        for part, n in zip(box or (slice(0, 1),) * 3, np.broadcast_to(margin, 3), strict=True)
    )
    return z, y, x


def hull(boxes: list[Slices]) -> Slices:
    """Return the smallest box that holds some."""
    z, y, x = (
        slice(min(part.start for part in along), max(part.stop for part in along))
        for along in zip(*boxes, strict=True)
    )
    return z, y, x


def starts(box: Slices) -> NDArray[np.int64]:
    """Return the first index x, y, z of a box of slices z, y, x."""
    return np.array([part.start for part in box[::-1]], dtype=np.int64)


def grown(mask: Mask) -> Mask:
    """Return a mask with the voxels that touch it in a face, an edge or a corner."""
    result = np.ascontiguousarray(mask)
    for axis in range(3):
        before, result = result, result.copy()
        to, source = np.moveaxis(result, axis, 0), np.moveaxis(before, axis, 0)
        to[1:] |= source[:-1]
        to[:-1] |= source[1:]
    return result


def eroded(mask: Mask, rounds: int = 1) -> Mask:
    """Return a mask less what is within so many voxels of its outside; the border counts as outside."""
    result = np.ascontiguousarray(mask)
    for axis in (0, 1, 2) * rounds:
        before, result = result, result.copy()
        to, source = np.moveaxis(result, axis, 0), np.moveaxis(before, axis, 0)
        to[1:] &= source[:-1]
        to[:-1] &= source[1:]
        to[[0, -1]] = False
    return result


def boxes_around(mask: Mask, planes: int = 16) -> list[Slices]:
    """Return boxes of a few planes each that hold a mask [z, y, x], apart where it leaves lines empty."""
    boxes = []
    for first in range(0, len(mask), planes):
        last = min(first + planes, len(mask))
        boxes += [(slice(first, last), y, x) for y, x in _rectangles(np.any(mask[first:last], axis=0), 0, 0)]
    return boxes


def _rectangles(mask: NDArray[np.bool_], y: int, x: int) -> Iterator[tuple[slice, slice]]:
    """Yield rectangles that hold a mask whose first element is y, x."""
    down, along = _runs(np.any(mask, axis=1)), _runs(np.any(mask, axis=0))
    if len(down) * len(along) == 1:
        yield (
            slice(y + int(down[0][0]), y + int(down[0][1])),
            slice(x + int(along[0][0]), x + int(along[0][1])),
        )
        return
    for top, bottom in down:
        for left, right in along:
            yield from _rectangles(mask[top:bottom, left:right], y + int(top), x + int(left))


def _runs(used: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the first and one past the last (n, 2) of each run of True."""
    return np.flatnonzero(np.diff(np.pad(used, 1))).reshape(-1, 2)

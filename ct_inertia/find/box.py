"""A box of the scan as block means on a grid fine enough to measure on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Box, Index, Mask
from ct_inertia.calibrated import calibrated
from ct_inertia.find.overview import Overview
from ct_inertia.scan.reduced import block_means
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array

ALONE_MM: float = calibrated("box.largest_block_mm")
IN_SITU_MM: float = calibrated("box.largest_block_in_situ_mm")
MARGIN_MM, MARGIN_BLOCKS = (
    0.25,
    16,
)  # around the stapes, the larger of both: room for its blur and for air beyond it


def block_for(spacing_mm: Array, most_mm: float) -> Index:
    """Return the voxels per block along x, y, z: as many as stay within ``most_mm``, at least one."""
    return np.maximum(np.floor(most_mm / np.asarray(spacing_mm) + 1e-9), 1.0).astype(np.int64)


def read_box(
    scan: Scan,
    low: Index,
    high: Index,
    most_mm: float,
    overview: Overview | None = None,
    margin: tuple[float, int] = (MARGIN_MM, MARGIN_BLOCKS),
) -> Box:
    """Read a box of the scan once, averaged over blocks.

    Parameters
    ----------
    scan : Scan
    low, high : ndarray of int, (3,)
        First voxel x, y, z of what shall be in the box, and one past its last.
    most_mm : float
        Largest edge of a block.
    overview : Overview, optional
        For the constant outside of the field of view.
    margin : (float, int)
        Around it, mm and blocks, whichever is more, as far as the scan reaches.

    Notes
    -----
    Sums over the means times the block's volume are the sums over the voxels: the grey integral and its first
    moments do not change. A block counts as one larger voxel in the point spread. Where the box ends at the
    border of the scan, its blocks end there too.

    Raises
    ------
    StapeskitError
        Voxels that cannot be read or are refused.
    """
    size = scan.size
    block = block_for(scan.spacing_mm, most_mm)
    around = np.maximum(margin[1] * block, np.ceil(margin[0] / scan.spacing_mm)).astype(np.int64)
    first = np.maximum(low.astype(np.int64) - around, 0)
    last = np.minimum(high.astype(np.int64) + around, size)
    rest = (last - first) % block
    whole = (last == size) & (first == 0) & (rest > 0)
    block, rest = np.where(whole, 1, block), np.where(whole, 0, rest)
    first = np.where((last == size) & (first > 0), first + rest, first)
    count = (last - first) // block
    last = first + count * block
    z, y, x = (slice(int(a), int(b)) for a, b in zip(first[::-1], last[::-1], strict=True))
    part = z, y, x
    single = None
    if np.all(block == 1):
        grey = scan.read(part).astype(np.float32)
    else:
        grey, _ = block_means(scan, [int(n) for n in block], part)
        middle = tuple(
            slice(int(a + n // 2), int(b), int(n))
            for a, b, n in zip(first[::-1], last[::-1], block[::-1], strict=True)
        )
        single = scan.read((middle[0], middle[1], middle[2]))
    transform = scan.scan_from_index.copy()
    transform[:3, :3] = transform[:3, :3] * block
    transform[:3, 3] = scan.scan_points(first + (block - 1) / 2.0)
    box = Box(
        grey=grey,
        first=first,
        block=block,
        spacing_mm=scan.spacing_mm * block,
        scan_from_index=transform,
        begins=np.asarray(first == 0),
        ends=np.asarray(last > size - block),
        single=single,
    )
    measured = None if overview is None else _measured(box, overview)
    if overview is None or measured is None:
        return box
    return _as_air(box, measured, float(overview.levels[0]))


def from_coarse(box: Box, mask: NDArray[Any], first: Index, step: Index) -> NDArray[Any]:
    """Return a coarse mask [z, y, x] on the grid of a box: each block takes its nearest coarse cell.

    ``first``: index x, y, z in the scan of the voxel in the middle of the first cell; ``step``: voxels per
    cell.
    """
    places = []
    for axis in range(3):
        k = 2 - axis
        centre = box.first[k] + (box.block[k] - 1) / 2.0 + np.arange(box.shape[axis]) * box.block[k]
        nearest = np.round((centre - first[k]) / step[k]).astype(np.int64)
        places.append(np.clip(nearest, 0, mask.shape[axis] - 1))
    return np.asarray(mask[np.ix_(*places)])


def _measured(box: Box, overview: Overview) -> Mask | None:
    """Return where the scan was measured, in a box; None where it was everywhere."""
    if overview.unmeasured is None or overview.padding is None:
        return None
    from ct_inertia.grey.start import grown

    outside = from_coarse(box, grown(overview.unmeasured), overview.step // 2, overview.step)
    stored = box.grey if box.single is None else box.single
    outside &= stored == np.asarray(overview.padding, dtype=stored.dtype)
    if not outside.any():
        return None
    return ~(grown(outside) if np.any(box.block > 1) else outside)


def _as_air(box: Box, measured: Mask, air: float) -> Box:
    """Let what was not measured hold air: a constant far from it would leak into every blur beside it.

    The value is the stored one nearest to the level of air, so that no new grey step appears.
    """
    stored = box.grey if box.single is None else box.single
    known = np.unique(stored[measured])
    nearest = known[np.argmin(np.abs(known.astype(float) - air))]
    grey = np.where(measured, box.grey, np.float32(nearest))
    single = None if box.single is None else np.where(measured, box.single, nearest)
    return replace(box, grey=grey, single=single, measured=measured)

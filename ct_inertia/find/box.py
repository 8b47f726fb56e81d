"""A box of the scan, averaged over blocks of voxels to a grid that is still fine enough to measure on."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ct_inertia.bodies import Box, Index
from ct_inertia.find.overview import Overview
from ct_inertia.scan.scan import Scan, block_means
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import grown
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some

ALONE_MM, IN_SITU_MM = 0.024, 0.0124
"""Largest blocks for a stapes alone, and for one that touches other bone, mm: finer ones cost time only."""

_APART_MM = 0.04  # of the voxels by which slices are compared: some thousand in a slice
_CRUS_MM2 = 0.02  # least cross-section of a crus, before and behind blank slices
_BRIGHT = 0.25  # share of the contrast above air that is beyond blur and noise
_AS_AIR = 0.5  # share of a slice that has one value where its air is without noise
_STILL, _NOISY = 1e-3, 0.4  # of the contrast; share of voxels that change by more where there is noise
_MOST_COPIES = 0.25  # share of slices that are copies where some were lost or doubled

MARGIN = (0.25, 16)
"""Around the stapes, mm and blocks, whichever is more: room for its blur and for air beyond it."""


def block_for(spacing_mm: Array, most_mm: float) -> Index:
    """Return the voxels per block along x, y, z: as many as stay within ``most_mm``, at least one."""
    return np.maximum(np.floor(most_mm / np.asarray(spacing_mm) + 1e-9), 1.0).astype(np.int64)


def read_box(
    scan: Scan,
    low: Index,
    high: Index,
    most_mm: float,
    overview: Overview | None = None,
    margin: tuple[float, int] = MARGIN,
) -> Box:
    """Read a box of the scan once, averaged over blocks.

    Parameters
    ----------
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
    border of the scan, its blocks end there too; along an axis that is wholly in the box and no multiple of
    the block, blocks are single voxels.

    Raises
    ------
    StapeskitError
        Voxels that cannot be read or are refused, and blank slices amid others.
    """
    block = block_for(scan.spacing_mm, most_mm)
    around = np.maximum(margin[1] * block, np.ceil(margin[0] / scan.spacing_mm)).astype(np.int64)
    first = np.maximum(low.astype(np.int64) - around, 0)
    last = np.minimum(high.astype(np.int64) + around, scan.size)
    block = np.where((last == scan.size) & (first == 0) & ((last - first) % block > 0), 1, block)
    first = np.where((last == scan.size) & (first > 0), first + (last - first) % block, first)
    count = (last - first) // block
    grid = Grid.of(scan, tuple(int(n) for n in count[::-1]), first, block)
    last = first + count * block
    z, y, x = (slice(int(a), int(b)) for a, b in zip(first[::-1], last[::-1], strict=True))
    if overview is not None:
        repeated = _repeated_slices(scan, overview, z, y, x)
    if np.all(block == 1):
        box = Box(**vars(grid), grey=scan.read((z, y, x)).astype(np.float32))
    else:
        middle = [
            slice(int(a + n // 2), int(b), int(n))
            for a, b, n in zip(first[::-1], last[::-1], block[::-1], strict=True)
        ]
        grey = block_means(scan, [int(n) for n in block], (z, y, x))
        box = Box(**vars(grid), grey=grey, single=scan.read((middle[0], middle[1], middle[2])))
    return box if overview is None else replace(_with_measured(box, overview), repeated=repeated)


def _repeated_slices(scan: Scan, overview: Overview, z: slice, y: slice, x: slice) -> tuple[int, ...]:
    """Return the slices that repeat the one before; refuse blank ones between two parts of the picture.

    Without noise or where air was clipped, slices of air between bodies are blank, and slices may be alike:
    there only a single blank slice is refused, and nothing is a copy. Where more than a quarter of the slices
    are copies, the scan was interpolated. Voxels 40 um apart along x and y are looked at, two at least.

    Raises
    ------
    StapeskitError
        Blank slices lie between two that are brighter than air in the same places: they cut the body.
    """
    along, down = np.maximum(np.round(_APART_MM / scan.spacing_mm[:2]), 2).astype(int).tolist()
    values = scan.read((z, slice(y.start, y.stop, down), slice(x.start, x.stop, along)))
    contrast = float(overview.levels[-1] - overview.levels[0])
    bright = values > overview.levels[0] + _BRIGHT * contrast
    blank = np.all(values == values[:, :1, :1], axis=(1, 2))
    least = _CRUS_MM2 / (along * down * float(np.prod(scan.spacing_mm[:2])))
    for before, behind in pairwise(np.flatnonzero(~blank)):
        lost = values[before + 1].flat[0]
        both = bright[before] & bright[behind] & (values[before] != lost) & (values[behind] != lost)
        most = 1 if np.mean(values[before] == lost) > _AS_AIR else len(values)
        if 1 < behind - before <= 1 + most and np.count_nonzero(both) > least:
            numbers = list_some([str(z.start + k) for k in range(before + 1, behind)], 6)
            got = f"{lost} in every voxel of slice {numbers}, counted from 0"
            step = "They were lost: reconstruct or copy them again"
            raise StapeskitError.of("the scan", "without blank slices in the stapes", got, scan.name, step)
    shown = ~blank & np.any(bright, axis=(1, 2))
    pairs = np.flatnonzero(shown[1:] & shown[:-1])
    same = np.array([np.array_equal(values[k], values[k + 1]) for k in pairs], dtype=bool)
    if not same.any() or np.mean(same) > _MOST_COPIES:
        return ()
    steps = (np.abs(values[k + 1].astype(np.float32) - values[k]) for k in pairs[~same])
    if np.median([np.mean(step > np.float32(_STILL * contrast)) for step in steps]) < _NOISY:
        return ()
    return tuple(int(k) for k in z.start + 1 + pairs[same])


def _with_measured(box: Box, overview: Overview) -> Box:
    """Return a box that knows where the scan was measured, and holds air elsewhere.

    A constant far from air would leak into every blur beside it. The value is the stored one nearest to the
    level of air, so that no new grey step appears.
    """
    if overview.unmeasured is None or overview.padding is None:
        return box
    outside = box.taken(grown(overview.unmeasured), overview.grid, repeat=True)
    outside &= box.stored == np.asarray(overview.padding, dtype=box.stored.dtype)
    if not outside.any():
        return box
    measured = ~(grown(outside) if np.any(box.block > 1) else outside)
    known = np.unique(box.stored[measured])
    air = known[np.argmin(np.abs(known.astype(float) - overview.levels[0]))]
    single = None if box.single is None else np.where(measured, box.single, air)
    return replace(box, grey=np.where(measured, box.grey, np.float32(air)), single=single, measured=measured)

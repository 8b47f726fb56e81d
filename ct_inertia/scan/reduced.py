"""Block means of a scan, read a few planes at a time: never the whole volume as floating point numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.scan import Box, Scan

_PLANES = 16  # read at a time: few enough to hold, many enough for two threads


def block_means(scan: Scan, block: Sequence[int], box: Box | None = None) -> tuple[NDArray[np.float32], Scan]:
    """Average a box of the scan over blocks of voxels.

    Sums over the means times the volume of a block are the sums over the voxels: the grey integral does not
    change, and its first moments only by what grey values vary within blocks. What is left over at the end of
    the box is not read.

    Parameters
    ----------
    scan : Scan
    block : sequence of 3 int
        Voxels of a block along x, y, z.
    box : tuple of 3 slice, optional
        Along z, y, x, with steps of 1; the whole scan without it.

    Returns
    -------
    ndarray of float32, [z, y, x]
        The means.
    Scan
        The grid of the block centres; reading it gives the means.

    Raises
    ------
    StapeskitError
        A voxel cannot be read or is not finite, or the box holds fewer than two blocks along an axis.
    """
    bx, by, bz = (int(n) for n in block)
    whole = box or (slice(None), slice(None), slice(None))
    starts = [along.indices(n)[0] for along, n in zip(whole, scan.shape, strict=True)]
    counts = [
        len(range(n)[along]) // size for along, n, size in zip(whole, scan.shape, (bz, by, bx), strict=True)
    ]
    exact = tuple(
        slice(start, start + count * size)
        for start, count, size in zip(starts, counts, (bz, by, bx), strict=True)
    )
    means = np.empty(counts, dtype=np.float32)
    if bx == by == bz == 1:
        for first, slab in scan.slabs(_PLANES, exact):  # type: ignore[arg-type]
            means[first : first + len(slab)] = slab
        return means, _grid_of(means, scan, starts, (1, 1, 1))
    share = np.float32(1.0 / (bx * by * bz))
    for first, slab in scan.slabs(bz, exact):  # type: ignore[arg-type]
        layer = slab[0].astype(np.float32)
        for plane in slab[1:]:
            layer += plane
        rows = layer[::by] * share
        for j in range(1, by):
            rows += layer[j::by] * share
        mean = means[first // bz]
        np.copyto(mean, rows[:, ::bx])
        for i in range(1, bx):
            mean += rows[:, i::bx]
    return means, _grid_of(means, scan, starts, (bx, by, bz))


def _grid_of(
    means: NDArray[np.float32], scan: Scan, starts: Sequence[int], block: tuple[int, int, int]
) -> Scan:
    """Return means as a scan whose voxels are blocks; ``starts`` are the first voxels along z, y, x."""
    centre = np.array(starts[::-1]) + (np.array(block) - 1) / 2.0
    return Scan.from_array(
        means,
        scan.spacing_mm * block,
        origin_mm=scan.scan_points(centre),
        direction=scan.direction,
        source=scan.source,
        files=scan.files,
        handedness_confirmed=scan.handedness_confirmed,
        nan_as_air=scan.nan_as_air,
    )

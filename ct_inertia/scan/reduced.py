"""Block means of a scan, read a few planes at a time: never the whole volume as floating point numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.scan import Box, Scan


def block_means(scan: Scan, block: Sequence[int], box: Box) -> NDArray[np.float32]:
    """Average a box of the scan over blocks of voxels.

    Sums over the means times the volume of a block are the sums over the voxels: the grey integral does not
    change, and its first moments only by what grey values vary within blocks.

    Parameters
    ----------
    scan : Scan
    block : sequence of 3 int
        Voxels of a block along x, y, z.
    box : tuple of 3 slice
        Along z, y, x, with steps of 1; a whole number of blocks.

    Returns
    -------
    ndarray of float32, [z, y, x]
        The means.

    Raises
    ------
    StapeskitError
        A voxel cannot be read or is not finite.
    """
    bx, by, bz = (int(n) for n in block)
    lengths = [len(range(n)[along]) for along, n in zip(box, scan.shape, strict=True)]
    means = np.empty([n // size for n, size in zip(lengths, (bz, by, bx), strict=True)], dtype=np.float32)
    share = np.float32(1.0 / (bx * by * bz))
    for first, slab in scan.slabs(bz, box):
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
    return means

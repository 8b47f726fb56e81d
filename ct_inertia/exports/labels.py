"""The labels of everything found, on the voxels of the scan, made slab by slab."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Labelled
from ct_inertia.scan.label_file import write_segmentation
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import used_box

_SLAB_VOXELS = 1 << 22  # at a time: 4 MB


def write_labels(path: Path, labelled: Labelled, scan: Scan) -> None:
    """Write labels as a segmentation of 3D Slicer: cells of the first look, and finer at the stapes.

    Parameters
    ----------
    path : Path
    labelled : Labelled
    scan : Scan
        Its voxels are those of the file, which ends where labels do.
    """
    parts: list[Grid] = [labelled.box]
    used = used_box(labelled.cells.labels != 0)
    if used is not None:
        parts.append(labelled.cells.grid.part(used))
    first = np.min([part.first for part in parts], axis=0)
    last = np.minimum(np.max([part.first + part.size * part.block for part in parts], axis=0), scan.size)
    z, y, x = (int(n) for n in (last - first)[::-1])
    grid = Grid.of(scan, (z, y, x), first, np.ones(3, dtype=np.int64))
    numbers = labelled.numbers()

    def slabs() -> Iterator[NDArray[np.uint8]]:
        layers = max(1, _SLAB_VOXELS // (x * y))
        for start in range(0, z, layers):
            part = grid.part((slice(start, start + layers), slice(0, y), slice(0, x)))
            labels = part.taken(labelled.cells.labels, labelled.cells.grid)
            yield part.taken(numbers, labelled.box, into=labels)

    write_segmentation(path, slabs(), grid.shape, grid.scan_from_index)

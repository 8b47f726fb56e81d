"""The labels of everything found, on the voxels of the scan, made slab by slab."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Index, Labelled
from ct_inertia.scan.label_file import write_segmentation
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.masks import used_box
from stapeskit.arrays import Array

_SLAB_VOXELS = 1 << 22  # at a time: 4 MB


@dataclass(frozen=True)
class LabelFile:
    """Labels on a part of the scan's grid: cells of the first look, and around the stapes voxels.

    Attributes
    ----------
    labelled : Labelled
    first, last : ndarray of int, (3,)
        Index x, y, z in the scan of the first voxel, and one past the last.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the part to scan coordinates, mm.
    """

    labelled: Labelled
    first: Index
    last: Index
    scan_from_index: Array

    @classmethod
    def of(cls, labelled: Labelled, scan: Scan) -> LabelFile:
        """Take everything that is labelled."""
        box, cells = labelled.box, labelled.cells
        low, high = box.first, box.first + box.block * np.array(box.shape[::-1])
        used = used_box(cells.labels != 0)
        if used is not None:
            starts = np.array([part.start for part in used[::-1]])
            stops = np.array([part.stop for part in used[::-1]])
            low = np.minimum(low, cells.first + starts * cells.step)
            high = np.maximum(high, cells.first + stops * cells.step)
        low, high = np.maximum(low, 0), np.minimum(high, scan.size)
        transform = scan.scan_from_index.copy()
        transform[:3, 3] = scan.scan_points(low)
        return cls(labelled, low, high, transform)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along z, y, x."""
        x, y, z = (int(n) for n in self.last - self.first)
        return z, y, x

    def slabs(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the labels some layers at a time, [z, y, x]."""
        z, y, x = self.shape
        layers = max(1, _SLAB_VOXELS // (x * y))
        box = self.labelled.box
        local = self.labelled.numbers()
        for start in range(0, z, layers):
            stop = min(start + layers, z)
            labels = np.zeros((stop - start, y, x), dtype=np.uint8)
            cells = self.labelled.cells
            self._put(labels, start, cells.labels, cells.first, cells.step)
            self._put(labels, start, local, box.first, box.block)
            yield labels

    def _put(
        self, labels: NDArray[np.uint8], start: int, values: NDArray[np.uint8], first: Index, step: Index
    ) -> None:
        """Write values of a coarser grid into a slab that begins at a layer."""
        places, sources = [], []
        begins = (self.first[2] + start, self.first[1], self.first[0])
        for axis, begin in enumerate(begins):
            index = (begin + np.arange(labels.shape[axis]) - first[2 - axis]) // step[2 - axis]
            inside = (index >= 0) & (index < values.shape[axis])
            places.append(np.flatnonzero(inside))
            sources.append(index[inside])
        if all(len(place) for place in places):
            window = tuple(slice(int(place[0]), int(place[-1]) + 1) for place in places)
            labels[window] = values[np.ix_(*sources)]

    def write(self, path: Path) -> None:
        """Write the labels as a segmentation of 3D Slicer."""
        write_segmentation(path, self.slabs(), self.shape, self.scan_from_index)

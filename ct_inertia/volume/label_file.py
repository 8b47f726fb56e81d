"""Label files: written so that they lie on the scan in 3D Slicer, ITK-SNAP and Fiji."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_GZIP = 31  # wbits of zlib: the widest window (15), with the header of gzip (16)


class Labels(Protocol):
    """Labels of a box of voxels, and where it lies; see ct_inertia.bodies.LabelledVolume."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along z, y, x."""

    @property
    def spacing_mm(self) -> Array:
        """Voxel spacing along x, y, z, mm."""

    @property
    def direction(self) -> Array:
        """Directions of the array axes in scan coordinates, (3, 3), in columns."""

    @property
    def origin_mm(self) -> Array:
        """Scan coordinates of the centre of the first voxel, (3,), mm."""

    def slabs(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the labels [z, y, x] some layers at a time."""


def packed_labels(labels: Labels) -> bytes:
    """Return labels as a compressed NRRD with spacing, origin and direction, packed some layers at a time.

    Notes
    -----
    The axes are LPS, as scan coordinates are: https://teem.sourceforge.net/nrrd/format.html. Labels are long
    runs of one value: zlib is asked to look for runs only, which is fastest.
    """
    packer = zlib.compressobj(level=1, wbits=_GZIP, strategy=zlib.Z_RLE)
    parts = [packer.compress(np.ascontiguousarray(slab).data) for slab in labels.slabs()]
    return b"".join([_header(labels).encode("ascii"), *parts, packer.flush()])


def _header(labels: Labels) -> str:
    axes = labels.direction * labels.spacing_mm
    sizes = " ".join(str(n) for n in reversed(labels.shape))
    lines = [
        "NRRD0004",
        "type: uint8",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {sizes}",
        f"space directions: {' '.join(_vector(axes[:, k]) for k in range(3))}",
        "kinds: domain domain domain",
        "encoding: gzip",
        f"space origin: {_vector(labels.origin_mm)}",
    ]
    return "\n".join(lines) + "\n\n"


def _vector(values: Iterable[float]) -> str:
    return f"({','.join(repr(float(v)) for v in values)})"

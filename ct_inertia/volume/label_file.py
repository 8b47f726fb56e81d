"""Label files: written so that they lie on the scan in 3D Slicer, ITK-SNAP and Fiji."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from itertools import chain, repeat
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ct_inertia.native import compiled

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
    """Return labels as a compressed NRRD with spacing, origin and direction, made some layers at a time.

    Notes
    -----
    The axes are LPS, as scan coordinates are: https://teem.sourceforge.net/nrrd/format.html. Labels are long
    runs of one value: gzip looks for those only.
    """
    kernels = compiled()
    parts = _by_zlib(labels) if kernels is None else _by_kernel(kernels, labels)
    return b"".join([_header(labels).encode("ascii"), *parts])


def _by_zlib(labels: Labels) -> list[bytes]:
    packer = zlib.compressobj(level=1, wbits=_GZIP, strategy=zlib.Z_RLE)
    parts = [packer.compress(np.ascontiguousarray(slab).data) for slab in labels.slabs()]
    return [*parts, packer.flush()]


def _by_kernel(kernels: Any, labels: Labels) -> list[bytes]:
    memory, parts = np.zeros(64, dtype=np.uint8), []
    end = np.zeros(0, dtype=np.uint8)
    for stage, slab in chain(zip(chain([0], repeat(1)), labels.slabs(), strict=False), [(2, end)]):
        whole = np.ascontiguousarray(slab)
        out = np.empty(whole.size + 1024, dtype=np.uint8)
        count = kernels.packed(memory.ctypes.data, stage, whole.ctypes.data, whole.size, out.ctypes.data)
        if count < 0:
            return _by_zlib(labels)
        parts.append(out[:count].tobytes())
    return parts


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

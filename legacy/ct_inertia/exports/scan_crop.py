"""The grey values around the stapes as NRRD, for scans whose format does not carry their place to others."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.readers.formats import format_of
from legacy.ct_inertia.volume.label_file import nrrd_header
from legacy.stapeskit.background import Later

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies
    from legacy.ct_inertia.options import MassOptions

# Border around the stapes, so that the annulus, the face of the plate and the tip of the incus are in the
# picture: a choice for the eye; nothing is computed from it.
_MARGIN_MM = 0.5
# Written at a time: it stays in the processor's cache between reading and writing, and a file of voxels that
# are packed is unpacked by all processors.
_SLAB_BYTES = 8 << 20
_TYPES = {
    "u1": "uint8",
    "i1": "int8",
    "u2": "uint16",
    "i2": "int16",
    "u4": "uint32",
    "i4": "int32",
    "u8": "uint64",
    "i8": "int64",
    "f4": "float",
    "f8": "double",
}


class EarlyCrop:
    """The crop, written on another thread as soon as the bodies are found, while their frames are sought.

    Parameters
    ----------
    options : MassOptions
    path : Path
    hash_of : callable, optional
        Called with the path when it is written, on that thread: it remembers the hash of the file.
    """

    def __init__(
        self, options: MassOptions, path: Path, hash_of: Callable[[Path], str] | None = None
    ) -> None:
        self._options, self._path, self._hash_of = options, path, hash_of
        self._written: Later[None] | None = None

    def begin(self, bodies: Bodies) -> None:
        """Begin to write where the scan needs a crop."""
        if needs_crop(self._options):
            self._written = Later(self._write, bodies)

    def _write(self, bodies: Bodies) -> None:
        write_crop(bodies, self._path)
        if self._hash_of is not None:
            self._hash_of(self._path)

    def finish(self, bodies: Bodies) -> None:
        """Wait until the crop is written, or write it now."""
        if self._written is None:
            self._write(bodies)
        else:
            self._written.result()


def needs_crop(options: MassOptions) -> bool:
    """Return whether other programs would not place the scan where its scan coordinates are.

    So it is for formats without spacing, origin or direction, and where ``--spacing`` or ``--mirror`` changed
    what the file says.
    """
    if options.scan is None or options.is_mesh:
        return False
    if options.spacing_mm is not None or options.mirror is not None:
        return True
    return not format_of(Path(options.scan), options.raw).placed


def write_crop(bodies: Bodies, path: Path) -> None:
    """Write the box of the stapes and 0.5 mm around it, in the voxels and grey values of the scan."""
    volume = bodies.volume
    index = volume.index_points(bodies.stapes.vertices_mm)
    margin = np.ceil(_MARGIN_MM / volume.spacing_mm)
    low = np.clip(np.floor(index.min(axis=0) - margin), 0, volume.size - 1).astype(np.int64)
    high = np.clip(np.ceil(index.max(axis=0) + margin) + 1, 1, volume.size).astype(np.int64)
    z, y, x = (slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    shape = tuple(int(n) for n in (high - low)[::-1])
    stored = volume.array.dtype.newbyteorder("<")
    header = nrrd_header(
        _TYPES[stored.str[1:]],
        shape,
        volume.direction * volume.spacing_mm,
        volume.scan_points(low),
        encoding="raw",
    )
    layers = max(1, _SLAB_BYTES // (shape[1] * shape[2] * stored.itemsize))
    with path.open("wb") as stream:
        stream.write(header)
        for start in range(z.start, z.stop, layers):
            part = volume.array[start : min(start + layers, z.stop), y, x]
            stream.write(np.ascontiguousarray(part, dtype=stored).data)
        stream.flush()
        os.fsync(stream.fileno())  # it is the largest output: on the disk before the others wait for it

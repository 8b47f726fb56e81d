"""The grey values around the stapes as NRRD, for scans whose format does not carry their place to others."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ct_inertia.readers.formats import format_of
from ct_inertia.volume.label_file import nrrd_header

if TYPE_CHECKING:
    from ct_inertia.ct2mass import MassMeasurement

# Border around the stapes, so that the annulus, the face of the plate and the tip of the incus are in the
# picture: a choice for the eye; nothing is computed from it.
_MARGIN_MM = 0.5
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


def needs_crop(result: MassMeasurement) -> bool:
    """Return whether other programs would not place the scan where its scan coordinates are.

    So it is for formats without spacing, origin or direction, and where ``--spacing`` or ``--mirror`` changed
    what the file says.
    """
    options = result.options
    if result.bodies is None or options.scan is None or options.is_mesh:
        return False
    if options.spacing_mm is not None or options.mirror is not None:
        return True
    return not format_of(Path(options.scan), options.raw).placed


def write_crop(result: MassMeasurement, path: Path) -> None:
    """Write the box of the stapes and 0.5 mm around it, in the voxels and grey values of the scan."""
    if result.bodies is None:
        raise ValueError("a surface has no grey values")
    volume = result.bodies.volume
    index = volume.index_points(result.stapes.vertices_mm)
    margin = np.ceil(_MARGIN_MM / volume.spacing_mm)
    low = np.clip(np.floor(index.min(axis=0) - margin), 0, volume.size - 1).astype(np.int64)
    high = np.clip(np.ceil(index.max(axis=0) + margin) + 1, 1, volume.size).astype(np.int64)
    z, y, x = (slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    part = np.asarray(volume.array[z, y, x])
    part = np.ascontiguousarray(part, dtype=part.dtype.newbyteorder("<"))
    header = nrrd_header(
        _TYPES[part.dtype.str[1:]],
        part.shape,
        volume.direction * volume.spacing_mm,
        volume.scan_points(low),
        encoding="raw",
    )
    with path.open("wb") as stream:
        stream.write(header)
        stream.write(part.data)

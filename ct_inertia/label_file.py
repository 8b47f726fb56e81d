"""Label files: written so that they lie on the scan in 3D Slicer, ITK-SNAP and Fiji."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ct_inertia.bodies import LabelledVolume

_GZIP = 31


def packed_labels(labels: LabelledVolume) -> bytes:
    """Return labels as a compressed NRRD with spacing, origin and direction, made some layers at a time.

    Notes
    -----
    The axes are LPS, as scan coordinates are: https://teem.sourceforge.net/nrrd/format.html. Labels are long
    runs of one value: gzip looks for those only.
    """
    packer = zlib.compressobj(level=1, wbits=_GZIP, strategy=zlib.Z_RLE)
    parts = [_header(labels).encode("ascii")]
    parts += [packer.compress(slab.tobytes()) for slab in labels.slabs()]
    return b"".join([*parts, packer.flush()])


def _header(labels: LabelledVolume) -> str:
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

"""NIfTI-1, NIfTI-2 and Analyze 7.5 volumes (.nii, .nii.gz, .hdr with .img), memory-mapped where not packed.

The format: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, check_dimensions, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault, no_grey_values, not_readable, several_values
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

_TYPES = {
    2: "u1",
    4: "i2",
    8: "i4",
    16: "f4",
    64: "f8",
    256: "i1",
    512: "u2",
    768: "u4",
    1024: "i8",
    1280: "u8",
}
_UNITS = {1: 1e3, 2: 1.0, 3: 1e-3}
_LPS = np.diag([-1.0, -1.0, 1.0])
# Form and offset of every field that is used (nifti1.h, nifti2.h).
_NIFTI1 = {
    **{"dim": ("8h", 40), "datatype": ("h", 70), "pixdim": ("8f", 76), "offset": ("f", 108)},
    **{"slope": ("f", 112), "intercept": ("f", 116), "units": ("B", 123), "qform": ("h", 252)},
    **{"sform": ("h", 254), "quaternion": ("3f", 256), "shift": ("3f", 268), "rows": ("12f", 280)},
}
_NIFTI2 = {
    **{"dim": ("8q", 16), "datatype": ("h", 12), "pixdim": ("8d", 104), "offset": ("q", 168)},
    **{"slope": ("d", 176), "intercept": ("d", 184), "units": ("i", 500), "qform": ("i", 344)},
    **{"sform": ("i", 348), "quaternion": ("3d", 352), "shift": ("3d", 376), "rows": ("12d", 400)},
}


@dataclass(frozen=True)
class _Header:
    """The fields used, as the file has them."""

    dim: tuple[int, ...]
    datatype: int
    pixdim: Array
    offset: int
    slope: float
    intercept: float
    units: int
    qform: int
    sform: int
    quaternion: Array
    shift: Array
    rows: Array
    order: str
    alone: bool
    bytes: int = 352


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a NIfTI volume, its place from the sform, otherwise from the qform.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, not three-dimensional, several values per voxel, or a left-handed
        direction matrix without ``mirror``.
    """
    header = _header(_head_file(path))
    size = [int(n) for n in header.dim[1 : 1 + max(0, min(header.dim[0], 7))]]
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    if len(size) > 3 and min(size[:3]) > 1:
        raise several_values(path, f"{int(np.prod(size[3:]))} (a vector or time image)")
    check_dimensions(size, path.name)
    return grid_volume(_grid(path, header, size), path, options)


def companion_files(path: Path) -> list[Path]:
    """Return the voxels of a separate header."""
    return [path.with_suffix(".img")] if path.suffix.lower() == ".hdr" else []


def _head_file(path: Path) -> Path:
    return path.with_suffix(".hdr") if path.suffix.lower() == ".img" else path


def _header(path: Path) -> _Header:
    try:
        packed = path.suffix.lower() == ".gz"
        with gzip.open(path) if packed else path.open("rb") as stream:
            head = stream.read(560)
    except (OSError, EOFError, zlib.error) as fault:
        raise not_readable(path, "NIfTI volume", fault) from fault
    for order in "<>":
        length = struct.unpack_from(order + "i", head)[0] if len(head) >= 4 else 0
        if length == 348 and len(head) >= 348 and head[344:347] in (b"n+1", b"ni1"):
            return _read_header(head, order, _NIFTI1, head[344:347] == b"n+1")
        if length == 348 and len(head) == 348 and path.suffix.lower() == ".hdr":
            # Analyze 7.5, of which NIfTI kept sizes, type and steps; it has no place.
            header = _read_header(head, order, _NIFTI1, False)
            return replace(header, offset=0, slope=1.0, intercept=0.0, units=0, qform=0, sform=0)
        if length == 540 and len(head) >= 540 and head[4:7] in (b"n+2", b"ni2"):
            return replace(_read_header(head, order, _NIFTI2, head[4:7] == b"n+2"), bytes=544)
    raise header_fault(path, "NIfTI volume", "a file that does not begin as one")


def _read_header(head: bytes, order: str, fields: Mapping[str, tuple[str, int]], alone: bool) -> _Header:
    """Read the fields of a header, whose forms and offsets a table gives."""
    values = {name: struct.unpack_from(order + form, head, at) for name, (form, at) in fields.items()}
    arrays: dict[str, Any] = {
        name: np.array(values.pop(name), dtype=float) for name in ("pixdim", "quaternion", "shift")
    }
    rows = np.array(values.pop("rows"), dtype=float).reshape(3, 4)
    dim, offset = values.pop("dim"), _integer_offset(values.pop("offset")[0])
    single = {name: value for name, (value,) in values.items()}
    return _Header(dim=dim, offset=offset, rows=rows, order=order, alone=alone, **arrays, **single)


def _integer_offset(value: float) -> int:
    """Return an offset that may be stored as a float; an impossible one as beyond every file."""
    return int(value) if abs(value) < 1e15 else 1 << 60


def _grid(path: Path, header: _Header, size: list[int]) -> Grid:
    if header.datatype not in _TYPES:
        known = {32: "complex numbers", 1792: "complex numbers", 128: "a colour (RGB) image"}
        raise no_grey_values(path, known.get(header.datatype, f"data type {header.datatype}"))
    notices = []
    unit = _UNITS.get(header.units & 7)
    if unit is None:
        unit = 1.0
        text = f"{path.name} does not say its unit of length: mm was taken, as NIfTI programs do."
        notices.append(Notice("unit_not_told", text))
    affine = _affine(header)
    spacing = np.linalg.norm(affine[:, :3], axis=0)
    spacing_mm = None
    if np.all(np.isfinite(spacing)) and np.all(spacing > 0.0):
        spacing_mm, direction = spacing * unit, affine[:, :3] / spacing
        notices += _contradictions(header, affine, unit, size, path.name)
    else:
        direction = np.eye(3)
    slope, intercept = header.slope, header.intercept
    if not np.isfinite(slope) or slope == 0.0 or not np.isfinite(intercept):
        slope, intercept = 1.0, 0.0
    packed = path.suffix.lower() == ".gz"
    data = path if header.alone else path.with_suffix(".img")
    start = max(0, header.offset)
    if header.alone and start < header.bytes:
        # 0 means the least that is possible: the header and four bytes that say whether extensions follow.
        if start:
            raise header_fault(path, "NIfTI volume", f"voxels at byte {start}, within its header")
        start = header.bytes
    return Grid(
        (size[0], size[1], size[2]),
        np.dtype(header.order + _TYPES[header.datatype]),
        ((data, 0 if packed else start),),
        spacing_mm,
        affine[:, 3] * unit,
        direction,
        "gzip" if packed else "raw",
        max(header.qform, header.sform) > 0,
        slope,
        intercept,
        skip=start if packed else 0,
        notices=tuple(notices),
    )


def _contradictions(header: _Header, affine: Array, unit: float, size: list[int], name: str) -> list[Notice]:
    """Return a notice where the sform, which counts, and the rest of the header place voxels differently."""
    if header.sform <= 0:
        return []
    other, told = _affine(replace(header, sform=0)), "qform"
    steps, stated = (np.linalg.norm(one[:, :3], axis=0) for one in (affine, other))
    if header.qform <= 0:  # sizes alone are told twice
        other, told = np.column_stack([affine[:, :3] / steps * stated, affine[:, 3]]), "pixdim"
    corners = np.array(list(product(*((0, n - 1) for n in size))), dtype=float)
    apart = np.linalg.norm(np.column_stack([corners, np.ones(8)]) @ (affine - other).T, axis=1).max() * unit
    if not (apart > 0.5 * unit * steps.min() or np.max(np.abs(stated / steps - 1.0)) > 1e-3):
        return []
    first, second = (", ".join(f"{v:.5g}" for v in unit * one) for one in (steps, stated))
    text = (
        f"{name} states the place of its voxels twice: by the sform ({first} mm a voxel), which was used, "
        f"and by the {told} ({second} mm); a corner lies {apart:.4g} mm apart. Programs that prefer the "
        f"other show other coordinates and sizes. Save it anew from the program that shows it rightly."
    )
    return [Notice("two_places_told", text)]


def _affine(header: _Header) -> Array:
    """Return the 3x4 affine from indices to LPS, in the units of the file.

    Notes
    -----
    NIfTI space is RAS. The sform counts where it is given, then the qform (quaternion b, c, d; the sign of
    the third axis in pixdim[0]), then pixdim alone: nifti1.h, methods 3, 2 and 1.
    """
    if header.sform > 0:
        return np.asarray(_LPS @ header.rows)
    steps = np.abs(header.pixdim[1:4])
    if header.qform <= 0:
        return np.column_stack([np.diag(steps), np.zeros(3)])
    b, c, d = header.quaternion
    a = np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))
    b, c, d = np.array([b, c, d]) / max(1e-12, float(np.sqrt(a * a + b * b + c * c + d * d)))
    turn = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    if header.pixdim[0] < 0.0:
        turn[:, 2] = -turn[:, 2]
    return np.asarray(_LPS @ np.column_stack([turn * steps, header.shift]))

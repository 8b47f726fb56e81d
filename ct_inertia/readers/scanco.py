"""Scanco volumes: ISQ as the scanner writes them and AIM of version 020, memory-mapped."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import check_size, settle_spacing
from ct_inertia.volume import Volume
from kinematics.errors import sentence

Array = NDArray[np.float64]

SCANCO_SUFFIXES = (".isq", ".aim")
_ISQ = b"CTDATA-HEADER_V1"
_AIM_030 = b"AIMDATA_V030"
_BLOCK = 512
_AIM_TYPES = {0x00010001: "<i1", 0x00020002: "<i2", 0x001A0004: "<f4"}


@dataclass(frozen=True)
class _Layout:
    """Where the voxels lie in the file: numbers of voxels x, y, z, their type, byte offset, place."""

    size: tuple[int, int, int]
    dtype: np.dtype
    offset: int
    spacing_mm: Array
    origin_mm: Array


def read_scanco(path: Path, spacing_mm: Sequence[float] | None = None) -> Volume:
    """Read an ISQ or AIM volume.

    Raises
    ------
    CtInertiaError
        Not such a file, truncated, packed, or of a data type that is no grey value.

    Notes
    -----
    An ISQ stores the extent of the whole volume in whole micrometres: the voxel size is rounded to that
    over the number of voxels. An AIM stores the voxel size itself.
    """
    with path.open("rb") as stream:
        head = stream.read(1024)
    if head.startswith(_ISQ):
        layout = _isq(head, path)
    elif head.startswith(_AIM_030):
        raise CtInertiaError(
            sentence(
                "the AIM file", "of version 020", "version 030", path.name, "Export it as ISQ, MHA or TIFF"
            )
        )
    elif len(head) >= 160 and head[:8] == struct.pack("<2i", 20, 140):
        layout = _aim(head, path)
    else:
        raise CtInertiaError(
            sentence(
                "the scan",
                "a Scanco ISQ or AIM file",
                f"a file that begins with {head[:8]!r}",
                path.name,
                next_step="Export it again, or as TIFF with --spacing",
            )
        )
    shape = layout.size[::-1]
    check_size(shape, layout.dtype, path.stat().st_size - layout.offset, False, path.name)
    array = np.memmap(path, dtype=layout.dtype, mode="r", offset=layout.offset, shape=shape)
    found = layout.spacing_mm if np.all(layout.spacing_mm > 0.0) else None
    spacing, notices = settle_spacing(found, spacing_mm, path.name)
    return Volume(array, spacing, layout.origin_mm, np.eye(3), source=path, notices=notices)


def _isq(head: bytes, path: Path) -> _Layout:
    if len(head) < _BLOCK:
        raise CtInertiaError(
            sentence(
                "the ISQ file",
                "at least 512 bytes long",
                len(head),
                path.name,
                next_step="Copy or export it again",
            )
        )
    size = struct.unpack_from("<3i", head, 44)
    extent = np.array(struct.unpack_from("<3i", head, 56), dtype=float) * 1e-3
    (blocks,) = struct.unpack_from("<i", head, 508)
    _check_positive(size, path)
    return _Layout(size, np.dtype("<i2"), (blocks + 1) * _BLOCK, extent / np.array(size), np.zeros(3))


def _aim(head: bytes, path: Path) -> _Layout:
    pre, image, log = struct.unpack_from("<3i", head, 0)
    # Five words of processing, then the type, position, size, six more triples, and the voxel size.
    (kind,) = struct.unpack_from("<i", head, pre + 20)
    values = struct.unpack_from("<21i", head, pre + 24)
    position, size = values[0:3], values[3:6]
    if kind not in _AIM_TYPES:
        raise CtInertiaError(
            sentence(
                "the AIM data",
                "8-bit, 16-bit or float voxels, not packed",
                f"type {kind:#x}",
                path.name,
                "Export it unpacked, or as ISQ or MHA",
            )
        )
    _check_positive(size, path)
    cell = pre + 24 + 21 * 4
    spacing = np.array([_vax_float(head[cell + 4 * k : cell + 4 * k + 4]) for k in range(3)])
    return _Layout(
        (int(size[0]), int(size[1]), int(size[2])),
        np.dtype(_AIM_TYPES[kind]),
        pre + image + log,
        spacing,
        np.array(position, dtype=float) * spacing,
    )


def _vax_float(four: bytes) -> float:
    """Return a VAX F float: its two halves swapped, four times the IEEE number of the same bits."""
    return float(struct.unpack("<f", four[2:] + four[:2])[0]) / 4.0


def _check_positive(size: Sequence[int], path: Path) -> None:
    if min(size) <= 0:
        raise CtInertiaError(
            sentence(
                "the size in the header",
                "positive",
                " x ".join(map(str, size)),
                path.name,
                next_step="Copy or export it again",
            )
        )

"""Scanco AIM volumes of versions 020 and 030, memory-mapped.

The layout follows the reader in ITK: https://github.com/KitwareMedical/ITKIOScanco
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import check_positive, density_notice
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

_V030 = b"AIMDATA_V030"
_TYPES = {
    0x00010001: "<i1",
    0x00160001: "<u1",
    0x000D0001: "<u1",
    0x00020002: "<i2",
    0x00170002: "<u2",
    0x00030004: "<i4",
    0x001A0004: "<f4",
}
# Most bytes of the processing log that are read: a damaged header may claim any length.
_LONGEST_LOG = 1 << 20


@dataclass(frozen=True)
class _Head:
    """The fields of the header that are used, and the offsets of log and voxels."""

    kind: int
    position: Array
    size: tuple[int, int, int]
    cell_mm: Array
    log: int
    data: int


def read(path: Path, options: ReadOptions) -> Volume:
    """Read an AIM volume; its place in the original scan gives the origin.

    Raises
    ------
    CtInertiaError
        Not such a file, truncated, packed, or of a data type that is no grey value.

    Notes
    -----
    The voxel size is a VAX float in mm in version 020 and whole nanometres in version 030.
    """
    with path.open("rb") as stream:
        start = stream.read(4096)
        head = _read_new_head(start, path) if start.startswith(_V030) else _read_old_head(start, path)
        if not 0 <= head.log <= head.data <= path.stat().st_size:
            raise header_fault(path, "AIM file", f"data at byte {head.data}")
        stream.seek(head.log)
        log = stream.read(min(_LONGEST_LOG, max(0, head.data - head.log))).decode("latin-1")
    if head.kind not in _TYPES:
        wanted, step = (
            "8-bit, 16-bit, 32-bit or float voxels, not packed",
            "Export it unpacked, or as ISQ or MHA",
        )
        raise CtInertiaError.of("the AIM data", wanted, f"type {head.kind:#x}", path.name, step)
    check_positive(head.size, path.name)
    spacing = head.cell_mm if np.all(head.cell_mm > 0.0) else None
    grid = Grid(
        head.size,
        np.dtype(_TYPES[head.kind]),
        ((path, head.data),),
        spacing,
        np.zeros(3) if spacing is None else head.position * spacing,
        notices=tuple(_calibration(log, path.name)),
    )
    return grid_volume(grid, path, options)


def _read_old_head(start: bytes, path: Path) -> _Head:
    if len(start) < 160 or start[:8] != struct.pack("<2i", 20, 140):
        raise header_fault(path, "AIM file", f"a file that begins with {start[:8]!r}")
    pre, image, log = struct.unpack_from("<3i", start, 0)
    # Five words of processing, then type, position, size, five more triples, and the voxel size.
    kind, *values = struct.unpack_from("<7i", start, pre + 20)
    cell = pre + 24 + 21 * 4
    spacing = np.array([_vax_float(start[cell + 4 * k : cell + 4 * k + 4]) for k in range(3)])
    return _head(kind, values, spacing, pre + image, log)


def _read_new_head(start: bytes, path: Path) -> _Head:
    if len(start) < 280:
        raise header_fault(path, "AIM file", f"{len(start)} bytes")
    pre, image, log = struct.unpack_from("<3q", start, 16)
    if pre != 40 or image < 204 or log < 0:
        raise header_fault(path, "AIM file", f"blocks of {pre}, {image} and {log} bytes")
    at = 16 + pre
    # Version, identity, reference, type as four 32-bit words; then triples of 64 bits.
    kind, *values = struct.unpack_from("<i6q", start, at + 12)
    cell = np.array(struct.unpack_from("<3q", start, at + 16 + 21 * 8), dtype=float) * 1e-6
    return _head(kind, values, cell, at + image, log)


def _head(kind: int, values: Sequence[int], cell_mm: Array, log: int, log_bytes: int) -> _Head:
    """Return the header of type, position and size (six numbers), voxel size, and the place of the log."""
    x, y, z = values[3:]
    return _Head(kind, np.array(values[:3], dtype=float), (x, y, z), cell_mm, log, log + log_bytes)


def _calibration(log: str, name: str) -> list[Notice]:
    """Return the line from grey value to density in the processing log."""
    entries = {}
    for line in log.splitlines():
        key, _, value = line.partition("  ")
        entries[key.strip()] = value.strip()
    try:
        scaling, slope, intercept = (
            float(entries[key]) for key in ("Mu_Scaling", "Density: slope", "Density: intercept")
        )
    except (KeyError, ValueError):
        return []
    return density_notice(name, scaling, slope, intercept, entries.get("Density: unit", ""))


def _vax_float(four: bytes) -> float:
    """Return a VAX F float: its two halves swapped, four times the IEEE number of the same bits."""
    return float(struct.unpack("<f", four[2:] + four[:2])[0]) / 4.0

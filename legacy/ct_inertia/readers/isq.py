"""Scanco ISQ volumes as the scanner writes them, memory-mapped.

The layout follows the reader in ITK: https://github.com/KitwareMedical/ITKIOScanco
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from legacy.ct_inertia.readers.checks import check_positive, density_notice
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.warnings import Notice

_MAGIC = b"CTDATA-HEADER_V1"
# Bytes a block of the header, and most blocks of it that are read: 128 kB hold the calibration.
_BLOCK = 512
_MOST_BLOCKS = 256


def read(path: Path, options: ReadOptions) -> Volume:
    """Read an ISQ volume.

    Raises
    ------
    CtInertiaError
        Not such a file, or truncated.

    Notes
    -----
    An ISQ stores the extent of the whole volume in whole micrometres: the voxel size is rounded to that
    over the number of voxels.
    """
    with path.open("rb") as stream:
        start = stream.read(_BLOCK * _MOST_BLOCKS)
    if not start.startswith(_MAGIC):
        raise header_fault(path, "ISQ file", f"a file that begins with {start[:8]!r}")
    if len(start) < _BLOCK:
        raise header_fault(path, "ISQ file", f"{len(start)} bytes, less than its header of 512")
    size = struct.unpack_from("<3i", start, 44)
    extent = np.array(struct.unpack_from("<3i", start, 56), dtype=float) * 1e-3
    (blocks,) = struct.unpack_from("<i", start, 508)
    check_positive(size, path.name)
    if blocks < 0:
        raise header_fault(path, "ISQ file", f"data at block {blocks}")
    spacing = extent / np.array(size)
    grid = Grid(
        (size[0], size[1], size[2]),
        np.dtype("<i2"),
        ((path, (blocks + 1) * _BLOCK),),
        spacing if np.all(spacing > 0.0) else None,
        notices=tuple(_calibration(start[: (blocks + 1) * _BLOCK], path.name)),
    )
    return grid_volume(grid, path, options)


def _calibration(head: bytes, name: str) -> list[Notice]:
    """Return the line from grey value to density in the extended header."""
    scaling = struct.unpack_from("<i", head, 88)[0]
    if len(head) < 4 * _BLOCK:
        return []
    at, skipped = _BLOCK, 1
    if head[at + 8 : at + 24] == b"MultiHeader     ":
        at, skipped = at + _BLOCK, 2
    for entry in range(4):
        place = at + entry * 128
        (blocks,) = struct.unpack_from("<i", head, place + 24)
        if blocks < 0 or (1 + skipped + blocks) * _BLOCK > len(head):
            break
        if head[place + 8 : place + 24] == b"Calibration     " and blocks >= 2:
            block = head[(1 + skipped) * _BLOCK :]
            unit = block[648:664].split(b"\0")[0].decode("latin-1").strip()
            return density_notice(
                name, float(scaling), _vax_double(block[664:672]), _vax_double(block[672:680]), unit
            )
        skipped += blocks
    return []


def _vax_double(eight: bytes) -> float:
    """Return a VAX D float: four 16-bit words, high word first, excess 128, 55 bits of fraction."""
    words = struct.unpack("<4H", eight)
    bits = (words[0] << 48) | (words[1] << 32) | (words[2] << 16) | words[3]
    exponent = (bits >> 55) & 0xFF
    if exponent == 0:
        return 0.0
    value = (1.0 + (bits & ((1 << 55) - 1)) / float(1 << 55)) * 2.0 ** (exponent - 129)
    return -value if bits >> 63 else value

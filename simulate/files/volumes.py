"""Formats of a scan: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from simulate.ear import Placed
from simulate.scanner import Scan, render, render_into

IMAGEJ_BYTES = 1 << 31


def write_scan(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a scan into a folder in the format it asks for; return the file, or folder of slices."""
    return WRITERS[scan.format](folder, placed, scan)


def _tif(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an uncompressed ImageJ stack (big-endian, as ImageJ has it), or above 2 GiB an OME BigTIFF."""
    import tifffile

    nx, ny, nz = placed.shape
    dx, dy, dz = placed.voxel_mm
    dtype = np.dtype(scan.dtype)
    if dtype.itemsize * nx * ny * nz > IMAGEJ_BYTES:
        return _ome(folder, placed, scan)
    path = folder / "scan.tif"
    stack = tifffile.memmap(
        path,
        shape=(nz, ny, nx),
        dtype=dtype.newbyteorder(">"),
        imagej=True,
        resolution=(1.0 / dx, 1.0 / dy),
        metadata={"spacing": dz, "unit": "mm", "axes": "ZYX"},
    )
    return _rendered(stack, placed, scan, path)


def _ome(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME BigTIFF in the machine's byte order."""
    import tifffile

    path = folder / "scan.ome.tif"
    sizes = {f"PhysicalSize{axis}": float(size) for axis, size in zip("XYZ", placed.voxel_mm, strict=True)}
    units = {f"{name}Unit": "mm" for name in sizes}
    stack = tifffile.memmap(
        path,
        shape=placed.shape[::-1],
        dtype=np.dtype(scan.dtype),
        bigtiff=True,
        ome=True,
        metadata={"axes": "ZYX", **sizes, **units},
    )
    return _rendered(stack, placed, scan, path)


def _rendered(stack: Any, placed: Placed, scan: Scan, path: Path) -> Path:
    """Render slab by slab into an array that a file is mapped to."""
    render_into(stack, placed, scan)
    stack.flush()
    return path


WRITERS: dict[str, Callable[[Path, Placed, Scan], Path]] = {"tif": _tif, "ome.tif": _ome}
"""Writers by format: they write into a folder and return the file."""

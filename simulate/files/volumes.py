"""Formats of a scan: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulate.coverage import coverage_of
from simulate.ear import Placed
from simulate.scanner import Scan, render, render_into

IMAGEJ_BYTES = 1 << 31
Writer = Callable[[Path, Placed, Scan], Path]


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
    render_into(stack, placed, scan)
    stack.flush()
    return path


def _ome(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME BigTIFF in the machine's byte order."""
    import tifffile

    sizes = {f"PhysicalSize{axis}": float(size) for axis, size in zip("XYZ", placed.voxel_mm, strict=True)}
    metadata: dict[str, Any] = {"axes": "ZYX", **sizes, **{f"{name}Unit": "mm" for name in sizes}}
    path, dtype = folder / "scan.ome.tif", np.dtype(scan.dtype)
    stack = tifffile.memmap(
        path, shape=placed.shape[::-1], dtype=dtype, bigtiff=True, ome=True, metadata=metadata
    )
    render_into(stack, placed, scan)
    stack.flush()
    return path


def _nrrd(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a packed NRRD: origin 0, identity direction (LPS)."""
    return _by_itk(folder / "scan.nrrd", render(placed, scan), placed)


def _by_itk(path: Path, volume: NDArray[Any], placed: Placed) -> Path:
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(volume)
    image.SetSpacing(placed.voxel_mm.tolist())
    sitk.WriteImage(image, str(path), useCompression=True)
    return path


def _slices(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a folder of plain TIFF slices; the voxel size stands nowhere but in the study."""
    import tifffile

    target = folder / "slices"
    target.mkdir(exist_ok=True)
    for number, picture in enumerate(render(placed, scan)):
        tifffile.imwrite(target / f"slice_{number:04d}.tif", picture, photometric="minisblack", metadata=None)
    return target


def _surface(folder: Path, placed: Placed, _: Scan) -> Path:
    """Write the exact stapes alone as a closed mesh in scan coordinates, mm (PLY, double precision)."""
    solid = placed.solids[0][0]
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment scan coordinates, mm, normals outward\n"
        f"element vertex {len(solid.vertices_mm)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(solid.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(solid.faces), dtype=[("n", "u1"), ("corner", "<i4", (3,))])
    rows["n"], rows["corner"] = 3, solid.faces
    path = folder / "stapes.ply"
    path.write_bytes(header.encode() + solid.vertices_mm.astype("<f8").tobytes() + rows.tobytes())
    return path


def write_labels(path: Path, placed: Placed, samples: int = 4) -> Path:
    """Write the true labels: 1 stapes, 2 plate, 3 other bone, each where it fills half a voxel.

    NRRD, NIfTI or MetaImage by the suffix.
    """
    labels = np.zeros(placed.shape[::-1], dtype=np.uint8)
    parts = {2: [s for s, material in placed.solids if material == "plastic"]}
    parts[3] = [s for s, material in placed.solids[1:] if material == "bone"]
    parts[1] = [placed.solids[0][0]]
    for value, solids in parts.items():
        filled = sum(coverage_of(solid, placed.shape, placed.voxel_mm, samples) for solid in solids)
        labels[np.asarray(filled) >= 0.5] = value
    return _by_itk(path, labels, placed)


WRITERS: dict[str, Writer] = {"tif": _tif, "ome.tif": _ome, "nrrd": _nrrd, "slices": _slices, "ply": _surface}
"""Writers by format: they write into a folder and return what to open; ``ply`` is a surface."""
WITHOUT_SPACING = ("slices",)
"""Formats that do not say the voxel size: the study does."""

"""Formats of a scan: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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


def _by_itk(
    path: Path,
    volume: NDArray[Any],
    placed: Placed,
    reverse_x: bool = False,
    keys: Mapping[str, str] | None = None,
) -> Path:
    """Write an image in its place; with its x axis in reverse the grid is left-handed."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(np.flip(volume, 2) if reverse_x else volume)
    image.SetSpacing(placed.voxel_mm.tolist())
    if reverse_x:
        image.SetOrigin([float(placed.voxel_mm[0]) * (placed.shape[0] - 1), 0.0, 0.0])
        image.SetDirection([-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    for key, value in (keys or {}).items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), useCompression=True)
    return path


def _metaimage(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a packed MetaImage."""
    return _by_itk(folder / "scan.mha", render(placed, scan), placed)


def _nifti(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a packed NIfTI on a left-handed grid: its x axis runs the other way, every voxel in its place."""
    return _by_itk(folder / "scan.nii.gz", render(placed, scan), placed, reverse_x=True)


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


def _soup(folder: Path, placed: Placed, _: Scan) -> Path:
    """Write the stapes as a binary STL, every third face wound the other way and every fifth one twice."""
    solid = placed.solids[0][0]
    faces = solid.faces.copy()
    faces[::3] = faces[::3, ::-1]
    faces = np.concatenate([faces, faces[::5]])
    rows = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("", "<u2")])
    rows["corners"] = solid.vertices_mm[faces]
    path = folder / "stapes.stl"
    path.write_bytes(bytes(80) + np.array([len(faces)], "<u4").tobytes() + rows.tobytes())
    return path


def write_labels(path: Path, placed: Placed, samples: int = 4) -> Path:
    """Write the true labels: 1 stapes, 2 plate, 3 other bone, each where it fills half a voxel.

    NRRD, NIfTI or MetaImage by the suffix; a ``.seg.nrrd`` is a segmentation as 3D Slicer has it, in which
    names say what the numbers 3 (stapes), 1 (plate) and 2 are.
    """
    labels = np.zeros(placed.shape[::-1], dtype=np.uint8)
    parts = {2: [s for s, material in placed.solids if material == "plastic"]}
    parts[3] = [s for s, material in placed.solids[1:] if material == "bone"]
    parts[1] = [placed.solids[0][0]]
    for value, solids in parts.items():
        filled = sum(coverage_of(solid, placed.shape, placed.voxel_mm, samples) for solid in solids)
        labels[np.asarray(filled) >= 0.5] = value
    keys: dict[str, str] = {}
    if path.name.endswith(".seg.nrrd"):
        labels = np.array([0, 3, 1, 2], dtype=np.uint8)[labels]
        for k, (number, name) in enumerate({1: "Plate", 2: "Temporal bone", 3: "Stapes left"}.items()):
            entries = {"ID": f"Segment_{number}", "Name": name, "LabelValue": str(number), "Layer": "0"}
            keys |= {f"Segment{k}_{entry}": value for entry, value in entries.items()}
    return _by_itk(path, labels, placed, keys=keys)


WRITERS: dict[str, Writer] = {
    "tif": _tif,
    "ome.tif": _ome,
    "nrrd": _nrrd,
    "mha": _metaimage,
    "nii.gz": _nifti,
    "slices": _slices,
    "ply": _surface,
    "stl": _soup,
}
"""Writers by format: they write into a folder and return what to open; ``ply`` and ``stl`` are surfaces.

Those of scanners and viewers, from the descriptions of their formats, are in tests/scan_files.
"""
WITHOUT_SPACING = ("slices",)
"""Formats that do not say the voxel size: the study does."""

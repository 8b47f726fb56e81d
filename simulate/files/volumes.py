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
_ROOT = "1.2.826.0.1.3680043.8.498"  # of the identifiers in DICOM files
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


def _dicom(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a folder of CT slices, the names of their files in another order than their positions."""
    import SimpleITK as sitk

    target = folder / "scan_dicom"
    target.mkdir(exist_ok=True)
    dx, dy, dz = placed.voxel_mm
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k, picture in enumerate(render(placed, scan)):
        image = sitk.GetImageFromArray(picture[None])
        image.SetSpacing([dx, dy, dz])
        fields = {
            "0008|0060": "CT",
            "0008|0018": f"{_ROOT}.3.{k}",
            "0020|000d": f"{_ROOT}.1",
            "0020|000e": f"{_ROOT}.2",
            "0020|0013": str(k + 1),
            "0020|0032": f"0\\0\\{k * dz:.9g}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
        }
        for tag, value in fields.items():
            image.SetMetaData(tag, value)
        writer.SetFileName(str(target / f"{placed.shape[2] - k:05d}.dcm"))
        writer.Execute(image)
    return target


def _zarr(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME-Zarr 0.5 image of two levels, in micrometres."""
    import zarr

    volume = render(placed, scan)
    group = zarr.create_group(folder / "scan.zarr", zarr_format=3)
    datasets = []
    for number, step in enumerate((1, 2)):
        level = volume[::step, ::step, ::step]
        group.create_array(str(number), shape=level.shape, chunks=(32, 32, 32), dtype=level.dtype)[...] = (
            level
        )
        scale = [float(1e3 * step * size) for size in placed.voxel_mm[::-1]]
        datasets.append(
            {"path": str(number), "coordinateTransformations": [{"type": "scale", "scale": scale}]}
        )
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    image: Any = {"axes": axes, "datasets": datasets}
    group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
    return folder / "scan.zarr"


def _isq(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a Scanco ISQ of signed 16-bit numbers; its extents are whole micrometres."""
    head = np.zeros(256, dtype="<i4")
    head[:4] = np.frombuffer(b"CTDATA-HEADER_V1", dtype="<i4")
    head[11:14] = placed.shape
    head[14:17] = np.rint(1e3 * placed.voxel_mm * placed.shape)
    head[127] = 1
    path = folder / "scan.isq"
    path.write_bytes(head.tobytes() + render(placed, scan).astype("<i2").tobytes())
    return path


def _vgi(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write the header of a VGStudio volume, and its voxels in a file beside it."""
    volume = render(placed, scan)
    (folder / "scan.vol").write_bytes(volume.tobytes())
    kind = {"u": "unsigned integer", "i": "signed integer", "f": "float"}[volume.dtype.kind]
    size, steps = (" ".join(f"{one:.9g}" for one in row) for row in (placed.shape, placed.voxel_mm))
    path = folder / "scan.vgi"
    path.write_text(
        f"{{volume1}}\n[representation]\nsize = {size}\n[file1]\nName = scan.vol\nFileFormat = raw\n"
        f"Size = {size}\nDatatype = {kind}\nBitsPerElement = {8 * volume.dtype.itemsize}\n"
        f"{{volumeprimitive1}}\n[geometry]\nresolution = {steps}\nunit = mm\n",
        encoding="ascii",
    )
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
    "dicom": _dicom,
    "zarr": _zarr,
    "isq": _isq,
    "vgi": _vgi,
    "slices": _slices,
    "ply": _surface,
    "stl": _soup,
}
"""Writers by format: they write into a folder and return what to open; ``ply`` and ``stl`` are surfaces."""
WITHOUT_SPACING = ("slices",)
"""Formats that do not say the voxel size: the study does."""

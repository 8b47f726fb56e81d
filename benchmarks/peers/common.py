"""Reading and writing that all peers share: the stack with its voxel size, box, labels, mass properties."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np

DENSITY_KG_M3 = 1900.0
STAPES_MM3 = 2.3


def read_stack(path: Path) -> tuple[Any, float]:
    """Return the volume (z, y, x) in the machine's byte order, mapped if so stored, and its voxel size."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        spacing = float(file.ome_metadata.split('PhysicalSizeX="')[1].split('"')[0])
    volume = tifffile.memmap(path, mode="r")
    return volume.astype(volume.dtype.newbyteorder("="), copy=False), spacing


def nearest_in_volume(voxels: Any, spacing: float) -> int:
    """Return which of some components (voxel counts) has the volume of a stapes."""
    return int(np.argmin(np.abs(np.asarray(voxels) * spacing**3 - STAPES_MM3)))


def widened(box: Any, shape: tuple[int, ...], by: int = 2) -> tuple[slice, ...]:
    """Return slices around a box."""
    return tuple(slice(max(s.start - by, 0), min(s.stop + by, n)) for s, n in zip(box, shape, strict=True))


def write_labels(folder: Path, mask: Any, box: tuple[slice, ...], spacing: float) -> None:
    """Write the label volume of a box (z, y, x), compressed, with its place in the scan."""
    nz, ny, nx = mask.shape
    origin = ", ".join(f"{s.start * spacing:.9g}" for s in reversed(box))
    header = (
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\n"
        f"sizes: {nx} {ny} {nz}\nspace directions: ({spacing},0,0) (0,{spacing},0) (0,0,{spacing})\n"
        f"kinds: domain domain domain\nencoding: gzip\nspace origin: ({origin})\n\n"
    )
    data = gzip.compress(np.ascontiguousarray(mask, dtype=np.uint8).tobytes(), compresslevel=1)
    (folder / "labels.nrrd").write_bytes(header.encode() + data)


def write_mass(folder: Path, volume_mm3: float, centre_mm: Any, inertia_mm5: Any) -> None:
    """Write mass, centre of mass and inertia about it."""
    properties = {
        "mass_kg": DENSITY_KG_M3 * volume_mm3 * 1e-9,
        "volume_mm3": volume_mm3,
        "center_of_mass_mm": np.asarray(centre_mm).tolist(),
        "inertia_kg_m2": (DENSITY_KG_M3 * 1e-15 * np.asarray(inertia_mm5)).tolist(),
    }
    (folder / "mass.json").write_text(json.dumps(properties, indent=1), encoding="utf-8")


def mesh_and_mass(folder: Path, points: Any, faces: Any) -> None:
    """Write a mesh, and its mass properties by trimesh."""
    import trimesh

    mesh = trimesh.Trimesh(points, faces, process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    mesh.export(folder / "stapes.ply")
    write_mass(folder, mesh.volume, mesh.center_mass, mesh.moment_inertia)


def image(array: Any, spacing: float) -> Any:
    """Return an array (z, y, x) as VTK's image, without a copy."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    grid = vtkImageData()
    grid.SetDimensions(*array.shape[::-1])
    grid.SetSpacing(spacing, spacing, spacing)
    grid.GetPointData().SetScalars(numpy_to_vtk(array.reshape(-1)))
    return grid


def flying_edges(grey: Any, spacing: float, level: float) -> tuple[Any, Any]:
    """Return the isosurface of an array by VTK on all cores: points (n, 3) in mm, faces (m, 3)."""
    import os

    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    vtkSMPTools.SetBackend("STDThread")
    vtkSMPTools.Initialize(os.cpu_count() or 1)
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image(grey, spacing))
    edges.SetValue(0, level)
    edges.ComputeNormalsOff()
    edges.ComputeGradientsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    surface = edges.GetOutput()
    points = vtk_to_numpy(surface.GetPoints().GetData()).astype(float)
    return points, vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3).copy()

"""Volume, centre of mass and inertia of one body as labs measure them now; each from a grey volume (z, y, x).

Each returns volume (mm3), centre (mm) and second moments about it (mm5).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.peers import common

Found = tuple[float, Any, Any]


def voxel_count(grey: Any, spacing: float, level: float) -> Found:
    """Count the voxels of the largest component."""
    points = np.argwhere(_largest(grey > level))[:, ::-1] * spacing
    centre = points.mean(axis=0)
    return len(points) * spacing**3, centre, (points - centre).T @ (points - centre) * spacing**3


def vtk_flying_edges(grey: Any, spacing: float, level: float) -> Found:
    """Mesh by VTK's flying edges, volume by vtkMassProperties, centre and inertia by trimesh."""
    import pyvista as pv
    from vtkmodules.vtkFiltersCore import vtkMassProperties

    points, faces = common.flying_edges(grey.astype(np.float32), spacing, level + 0.25)
    body = largest_piece(points, faces)
    _, centre, second = _of_mesh(points, faces)
    properties = vtkMassProperties()
    properties.SetInputData(pv.PolyData.from_regular_faces(body.vertices, body.faces))
    return properties.GetVolume(), centre, second


def simpleitk_otsu(grey: Any, spacing: float, level: float) -> Found:
    """Label statistics of SimpleITK above its own Otsu level (``level``, from the whole scan)."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(_largest(grey > level).astype(np.uint8))
    image.SetSpacing((spacing,) * 3)
    statistics = sitk.LabelShapeStatisticsImageFilter()
    statistics.ComputePerimeterOff()
    statistics.Execute(image)
    axes = np.array(statistics.GetPrincipalAxes(1)).reshape(3, 3)
    volume = statistics.GetPhysicalSize(1)
    second = axes.T @ np.diag(statistics.GetPrincipalMoments(1)) @ axes * volume
    return volume, np.array(statistics.GetCentroid(1)), second


def surface_nets(grey: Any, spacing: float, level: float) -> Found:
    """SurfaceNets of the label with the smoothing that PyVista's contour_labels does by default."""
    import pyvista as pv

    mask = np.ascontiguousarray(_largest(grey > level), dtype=np.uint8)
    image = pv.ImageData(dimensions=mask.shape[::-1], spacing=(spacing,) * 3)
    image.point_data["label"] = mask.ravel()
    surface = image.contour_labels(output_mesh_type="triangles", scalars="label")
    return _of_mesh(np.asarray(surface.points, dtype=float), surface.regular_faces)


def otsu_level(volume: Any) -> float:
    """Return SimpleITK's Otsu level of a whole scan."""
    import SimpleITK as sitk

    otsu = sitk.OtsuThresholdImageFilter()
    otsu.Execute(sitk.GetImageFromArray(volume))
    return float(otsu.GetThreshold())


def _largest(mask: Any) -> Any:
    from scipy.ndimage import label

    labels, _ = label(mask)
    return labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))


def largest_piece(points: Any, faces: Any) -> Any:
    """Return the largest closed piece of a mesh, outward."""
    import trimesh

    mesh = max(trimesh.Trimesh(points, faces).split(), key=lambda part: abs(part.volume))
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _of_mesh(points: Any, faces: Any) -> Found:
    mesh = largest_piece(points, faces)
    inertia = np.array(mesh.moment_inertia)
    return float(mesh.volume), np.array(mesh.center_mass), 0.5 * np.trace(inertia) * np.eye(3) - inertia

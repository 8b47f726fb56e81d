"""Closed iso surfaces of grey values, their level chosen so that the volume is a given one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.surface import Surface, enclosed_volume
from kinematics.errors import sentence

Array = NDArray[np.float64]
_TINY_SHARE = 1e-3
_ROUNDS = 8


def iso_surface(field: NDArray[np.float32], level: float, scan_from_index: Array) -> Surface:
    """Return the closed outward surface where a field [z, y, x] crosses a level.

    Parameters
    ----------
    field : ndarray of float32, [z, y, x]
        Higher inside; what lies outside the array counts as far below the level.
    level : float
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the field to scan coordinates, mm.

    Raises
    ------
    CtInertiaError
        Nothing lies above the level.
    """
    points, faces = _contour(np.pad(field, 1, constant_values=_below(field, level)), level)
    if len(faces) == 0:
        raise CtInertiaError(
            sentence(
                "the body",
                "visible above its grey level",
                f"nothing above {level:g}",
                next_step="Check the labels and the grey values there",
            )
        )
    points, faces = largest_part(points, faces)
    return _placed(points - 1.0, faces, scan_from_index)


def volume_matched(
    field: NDArray[np.float32], volume_mm3: float, scan_from_index: Array, level: float = 0.5
) -> tuple[Surface, float]:
    """Return the iso surface that encloses a given volume, and its level.

    Parameters
    ----------
    field : ndarray of float32, [z, y, x]
        Share of bone, 0 to 1 and noise.
    volume_mm3 : float
        Met within 1e-5 of itself.
    scan_from_index : ndarray, (4, 4)
    level : float
        Start of the search by secants.

    Notes
    -----
    At the half level a convex, blurred body encloses too little; the level that matches the integral of
    the grey values gives a surface for pictures, contact and export that weighs what the body weighs.
    """
    surface = iso_surface(field, level, scan_from_index)
    area = surface.area_mm2
    start = (level, surface.volume_mm3 - volume_mm3)
    # Across an edge the field falls from 1 to 0 within about 3 voxels.
    voxel = float(np.abs(np.linalg.det(scan_from_index[:3, :3]))) ** (1.0 / 3.0)
    other = level + float(np.clip(start[1] / (area * 3.0 * voxel), -0.1, 0.1)) + 1e-4
    for _ in range(_ROUNDS):
        other = float(np.clip(other, 0.1, 0.9))
        surface = iso_surface(field, other, scan_from_index)
        fault = surface.volume_mm3 - volume_mm3
        if abs(fault) < 1e-5 * volume_mm3 or fault == start[1]:
            return surface, other
        slope = (fault - start[1]) / (other - start[0])
        start, other = (other, fault), other - float(np.clip(fault / slope, -0.15, 0.15))
    return surface, start[0]


def _below(field: NDArray[np.float32], level: float) -> float:
    """Return a value as far below the level as the field's top lies above it: half-voxel caps at a border."""
    return 2.0 * level - max(float(field.max()), level + 1e-6)


def _contour(field: NDArray[np.float32], level: float) -> tuple[Array, NDArray[np.int64]]:
    """Contour a padded field by flying edges; points in index x, y, z, faces outward."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image = vtkImageData()
    image.SetDimensions(*field.shape[::-1])
    values = np.ascontiguousarray(field, dtype=np.float32)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=False))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, float(level))
    edges.ComputeNormalsOff()
    edges.ComputeGradientsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    result = edges.GetOutput()
    if result.GetNumberOfPolys() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = vtk_to_numpy(result.GetPoints().GetData()).astype(float)
    faces = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    if enclosed_volume(points, faces) < 0.0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return points, faces


def largest_part(points: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Keep the largest closed part of a surface and its cavities of more than 0.1 %; drop specks."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(points)
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    graph = coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(n, n))
    count, part = connected_components(graph, directed=False)
    if count == 1:
        return points, faces
    of_face = part[faces[:, 0]]
    a, b, c = (points[faces[:, k]] - points[faces[0, 0]] for k in range(3))
    volume = np.bincount(of_face, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0, minlength=count)
    main = int(np.argmax(volume))
    kept = (np.arange(count) == main) | (
        (volume < -_TINY_SHARE * volume[main]) & _inside_box(points, part, main, count)
    )
    faces = faces[kept[of_face]]
    used, place = np.unique(faces, return_inverse=True)
    return points[used], place.reshape(-1, 3)


def _inside_box(points: Array, part: NDArray[np.int32], main: int, count: int) -> NDArray[np.bool_]:
    low, high = points[part == main].min(axis=0), points[part == main].max(axis=0)
    outside = np.any((points < low) | (points > high), axis=1)
    return np.asarray(np.bincount(part, outside, minlength=count) == 0)


def _placed(points: Array, faces: NDArray[np.int64], scan_from_index: Array) -> Surface:
    return Surface(points @ scan_from_index[:3, :3].T + scan_from_index[:3, 3], faces)

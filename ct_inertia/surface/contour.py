"""Closed surfaces where a field on a grid passes a level, by the flying edges of VTK."""

from __future__ import annotations

import numpy as np

from ct_inertia.bodies import Grey
from ct_inertia.surface.surface import Faces, Surface, chosen_part
from ct_inertia.voxels.masks import starts, used_box, widened
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.polydata import arrays_of

_LEAST_CAVITY = 1e-3  # of the volume of the body: a smaller cavity is noise, and weighs less than it


def contour(field: Grey, scan_from_index: Array, level: float = 0.0, largest: bool = True) -> Surface:
    """Return the closed outward surface where a field [z, y, x] passes a level.

    Parameters
    ----------
    field : ndarray of float32, [z, y, x]
        Higher inside. Where its border cuts the body, the surface is closed half a voxel outside.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the field to scan coordinates, mm.
    largest : bool
        Keep the largest piece and its cavities only.

    Raises
    ------
    StapeskitError
        Nothing lies above the level.
    """
    first, part = padded_part(field - np.float32(level))
    points, faces = zero_surface(part, largest)
    return placed(points + first, faces, scan_from_index, field.shape)


def padded_part(field: Grey) -> tuple[Array, Grey]:
    """Return the positive part of a field [z, y, x], two voxels around, and its first index x, y, z.

    Raises
    ------
    StapeskitError
        Nothing is positive.
    """
    used = used_box(field > 0.0)
    if used is None:
        raise _nothing()
    box = widened(used, 2)
    part = np.pad(field[box], 1, mode="edge")
    for axis in range(3):
        for end in (0, -1):  # as far below zero as the field is above it: caps half a voxel outside
            side = np.moveaxis(part, axis, 0)[end]
            side[...] = -np.abs(side) - np.float32(1e-6)
    return np.asarray(starts(box) - 1.0), part


def zero_surface(field: Grey, largest: bool = True) -> tuple[Array, Faces]:
    """Return points (n, 3; index x, y, z) and outward faces of a zero surface, or of its largest piece."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    grid, edges = vtkImageData(), vtkFlyingEdges3D()
    grid.SetDimensions(*field.shape[::-1])
    grid.GetPointData().SetScalars(numpy_to_vtk(field.ravel()))
    edges.SetInputData(grid)
    edges.SetValue(0, 0.0)
    edges.ComputeNormalsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    points, faces = arrays_of(edges.GetOutput())
    if not len(faces):
        raise _nothing()
    a, b, c = (points[faces[:, k]] - points[faces[0, 0]] for k in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    if parts.sum() < 0.0:
        faces, parts = np.ascontiguousarray(faces[:, ::-1]), -parts
    return _largest(points, faces, parts) if largest else (points, faces)


def _nothing() -> StapeskitError:
    step = "Check the labels and the grey values there"
    return StapeskitError.of("the body", "visible in the grey values", "nothing", next_step=step)


def _largest(points: Array, faces: Faces, parts: Array) -> tuple[Array, Faces]:
    """Keep the largest closed piece and its cavities; ``parts`` (m,) are the signed volumes of the faces."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(points)
    links = (np.ones(2 * len(faces), dtype=np.int8), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()))
    pieces, piece = connected_components(coo_array(links, shape=(count, count)), directed=False)
    if pieces == 1:
        return points, faces
    volume = np.bincount(piece[faces[:, 0]], parts, minlength=pieces)
    main = int(np.argmax(volume))
    low, high = points[piece == main].min(axis=0), points[piece == main].max(axis=0)
    outside = np.bincount(piece, np.any((points < low) | (points > high), axis=1), minlength=pieces) > 0
    kept = (volume < -_LEAST_CAVITY * volume[main]) & ~outside
    kept[main] = True
    return chosen_part(points, faces, kept[piece[faces[:, 0]]])


def placed(points: Array, faces: Faces, scan_from_index: Array, shape: tuple[int, ...]) -> Surface:
    """Map a surface from grid indices (x, y, z) to scan coordinates; ``shape`` of the grid is (z, y, x)."""
    beyond = np.any((points < -1e-3) | (points > np.array(shape[::-1]) - 1.0 + 1e-3), axis=1)
    vertices = points @ scan_from_index[:3, :3].T + scan_from_index[:3, 3]
    return Surface(vertices, faces, beyond if beyond.any() else None)

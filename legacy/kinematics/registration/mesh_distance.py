"""Exact nearest points of a triangle surface (by VTK), and its normals averaged over its roughness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array

Index = NDArray[np.int64]
_ROUGHNESS_EDGES: float = calibrated("surface_fit.roughness_edges")
_SAME_SIDE_COSINE: float = calibrated("surface_fit.same_side_cosine")
# Cosine of neighbouring normals below which an edge is sharp.
_EDGE = 0.7


@dataclass(frozen=True)
class TriangleSurface:
    """A triangle surface, open or closed, with outward faces.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray, (m, 3), int
    name : str
        What it is, for messages.
    sd_mm : float or None
        Standard deviation of the surface, where one was stated.

    Raises
    ------
    KinematicsError
        There is no triangle with an area, or a number is not finite.
    """

    vertices_mm: Array
    faces: Index
    name: str = "surface"
    sd_mm: float | None = None
    _parts: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_mm, dtype=float)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        fine = vertices.ndim == 2 and faces.ndim == 2 and faces.shape[1:] == (3,) and len(faces) > 0
        if fine:
            fine = bool(np.all(np.isfinite(vertices)) and faces.min() >= 0 and faces.max() < len(vertices))
        if fine:
            corners = vertices[faces]
            area = 0.5 * np.linalg.norm(
                np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
            )
            faces = faces[area > 1e-9 * np.max(area)] if np.max(area) > 0.0 else faces[:0]
        if not fine or len(faces) == 0:
            raise KinematicsError.of(
                f"the {self.name}", "made of triangles with finite corners", "none", "", "Run ct2mass anew"
            )
        object.__setattr__(self, "vertices_mm", vertices)
        object.__setattr__(self, "faces", faces)

    def _index(self) -> dict[str, Any]:
        """Return the arrays and trees that searches need, built by the first search."""
        if not self._parts:
            from scipy.spatial import cKDTree

            corners = self.vertices_mm[self.faces]
            centre = corners.mean(axis=1)
            area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            size = np.linalg.norm(area, axis=1)
            self._parts.update(
                corners=corners,
                centre=centre,
                normal=area / size[:, None],
                area=0.5 * size,
                locator=_cell_locator(self.vertices_mm, self.faces),
                centres=cKDTree(centre),
                edge=float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))),
            )
        return self._parts

    @property
    def edge_mm(self) -> float:
        """Median length of an edge, mm: about one voxel on a surface from a scan."""
        return float(self._index()["edge"])

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the bounding box, mm."""
        used = self.vertices_mm[self.faces].reshape(-1, 3)
        return float(np.linalg.norm(np.ptp(used, axis=0)))

    def closest(self, points_mm: Array) -> tuple[Array, Array, Index]:
        """Return the nearest points (n, 3) of the surface, their distances (n,), mm, and their triangles."""
        from vtkmodules.vtkCommonCore import reference
        from vtkmodules.vtkCommonDataModel import vtkGenericCell

        find = self._index()["locator"].FindClosestPoint
        points = np.atleast_2d(np.asarray(points_mm, dtype=float))
        nearest = np.empty_like(points)
        triangles = np.empty(len(points), dtype=np.int64)
        cell, place = vtkGenericCell(), [0.0, 0.0, 0.0]
        triangle: Any = reference(0)
        part: Any = reference(0)
        square: Any = reference(0.0)
        for row, point in enumerate(points.tolist()):
            find(point, place, cell, triangle, part, square)
            nearest[row], triangles[row] = place, int(triangle)
        return nearest, np.linalg.norm(nearest - points, axis=1), triangles

    def normals(self, triangles: Index, reach_mm: float = 0.0) -> Array:
        """Return outward unit normals (n, 3) at triangles, averaged over the roughness of the surface.

        Neighbours that lie on another side of an edge are left out.
        """
        parts = self._index()
        radius = max(reach_mm, _ROUGHNESS_EDGES * parts["edge"])
        own = parts["normal"][triangles]
        if not len(triangles) or parts["edge"] > 0.05 * self.diagonal_mm:
            return np.asarray(own)
        mean = np.empty_like(own)
        for place, near in enumerate(parts["centres"].query_ball_point(parts["centre"][triangles], radius)):
            sides, areas = parts["normal"][near], parts["area"][near]
            mean[place] = _main_side(sides, areas, own[place])
        return mean

    def near_edge(self, near_mm: Array, normal: Array, reach_mm: Array) -> NDArray[np.bool_]:
        """Return which points (n, 3) have an edge, a turn by 45 degrees, within a reach (n,), mm."""
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
        first /= np.linalg.norm(first, axis=1)[:, None]
        second = np.cross(normal, first)
        edge = np.zeros(len(near_mm), dtype=bool)
        for turn in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False):
            step = reach_mm[:, None] * (np.cos(turn) * first + np.sin(turn) * second)
            _, away, triangle = self.closest(near_mm + step)
            other = self.normals(triangle)
            edge |= (np.sum(other * normal, axis=1) < _EDGE) | (away > 0.5 * reach_mm)
        return edge

    def signed(self, points_mm: Array) -> tuple[Array, Array, Array]:
        """Return signed distances (n,), mm (outside positive), along normals (n, 3), and nearest points."""
        near, distance, triangle = self.closest(points_mm)
        normal = self.normals(triangle)
        along = np.sum((points_mm - near) * normal, axis=1)
        return np.copysign(distance, along), normal, near

    def samples(self, count: int, seed: int = 0) -> tuple[Array, Array]:
        """Return points (count, 3), mm, spread evenly over the surface, and their triangles' normals."""
        parts = self._index()
        rng = np.random.default_rng(seed)
        steps = (np.arange(count) + rng.random(count)) / count
        triangle = np.searchsorted(np.cumsum(parts["area"]) / np.sum(parts["area"]), steps)
        triangle = np.minimum(triangle, len(self.faces) - 1)
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        share = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
        points = np.einsum("nk,nki->ni", share, parts["corners"][triangle])
        return points, parts["normal"][triangle]


def _main_side(sides: Array, areas: Array, own: Array) -> Array:
    """Average the normals of one side of an edge, the side that the neighbourhood's own normals lie on."""
    mean = own
    for _ in range(3):
        same = sides @ mean > _SAME_SIDE_COSINE
        if not np.any(same):
            return own
        total = areas[same] @ sides[same]
        mean = total / np.linalg.norm(total)
    return np.asarray(mean)


def _cell_locator(vertices_mm: Array, faces: Index) -> Any:
    """Return VTK's exact search for the nearest triangle."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator

    points, cells, mesh, locator = vtkPoints(), vtkCellArray(), vtkPolyData(), vtkStaticCellLocator()
    points.SetData(numpy_to_vtk(vertices_mm, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(faces).ravel(), deep=True))
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    locator.SetDataSet(mesh)
    locator.BuildLocator()
    return locator

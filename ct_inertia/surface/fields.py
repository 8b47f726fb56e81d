"""Fields on a triangulated surface: diffusion over a length in mm, normals on that length, refined meshes.

Nothing here depends on the triangles beyond their resolution, only on the surface.
"""

from __future__ import annotations

import numpy as np

from ct_inertia.surface.surface import Faces, Surface
from stapeskit.arrays import Array
from stapeskit.polydata import arrays_of, polydata

_LEAST_SINE = (
    0.1  # twice the area over the square of the longest edge: the stiffness of slivers is limited there
)


class Diffusion:
    """Diffusion over a surface by linear elements and implicit steps.

    Notes
    -----
    Stiffness by cotangents (Pinkall and Polthier 1993, doi:10.1080/10586458.1993.10504266), lumped mass.
    One step multiplies a field of surface wave number k by 1 / (1 + sigma^2 k^2 / 4); two of them are close
    to a Gaussian of standard deviation sigma.
    """

    def __init__(self, points: Array, faces: Faces, sigma_mm: float) -> None:
        from scipy.sparse import coo_array, diags_array
        from scipy.sparse.linalg import splu

        self.points, self.faces, self.sigma_mm = points, faces, sigma_mm
        count = len(points)
        corners = points[faces]
        areas = 0.5 * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        longest = np.max(np.sum((corners - np.roll(corners, -1, axis=1)) ** 2, axis=-1), axis=1)
        double = np.maximum(2.0 * areas, _LEAST_SINE * longest + 1e-30)
        rows, columns, weights = [], [], []
        for k in range(3):
            u = corners[:, (k + 1) % 3] - corners[:, k]
            v = corners[:, (k + 2) % 3] - corners[:, k]
            i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
            half = 0.125 * sigma_mm**2 * np.einsum("ij,ij->i", u, v) / double
            rows += [i, j, i, j]
            columns += [j, i, i, j]
            weights += [-half, -half, half, half]
        third = np.repeat(areas / 3.0, 3)
        self.mass = np.bincount(faces.ravel(), third, minlength=count) + 1e-15
        entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
        matrix = coo_array(entries, shape=(count, count)).tocsc() + diags_array(self.mass)
        symmetric = {"SymmetricMode": True}
        self._solve = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve

    def step(self, field: Array) -> Array:
        """Diffuse a field (n, k) by one step."""
        return np.asarray(self._solve(self.mass[:, None] * field))

    def normals(self, points: Array | None = None) -> Array:
        """Return outward normals (n, 3) after two steps, not of unit length; of displaced points if given."""
        corners = (self.points if points is None else points)[self.faces]
        thirds = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6.0
        return self.step(self._solve(sum_at_corners(self.faces, thirds, len(self.points))))

    def without_noise(self) -> Array:
        """Return the points (n, 3) averaged over the scale, without the shift of second order at bends."""
        once = self.step(self.step(self.points))
        return 2.0 * once - self.step(self.step(once))

    def sharpened(self, blur_mm: float) -> Array:
        """Return the points (n, 3) of a surface with a blur taken back.

        Notes
        -----
        Blur moves an iso surface inward where it is convex, by blur^2 / 2 times the sum of the principal
        curvatures; one step of diffusion on the scale s moves it by s^2 / 4 times its mean curvature vector.
        """
        normals = unit(self.normals())
        lift = 2.0 * (blur_mm / self.sigma_mm) ** 2 * (self.points - self.step(self.points))
        return self.points + np.sum(lift * normals, axis=1, keepdims=True) * normals


def sum_at_corners(faces: Faces, values: Array, count: int) -> Array:
    """Return the sums (count, k) at the corners of values (m, k) of faces."""
    flat = faces.ravel()
    return np.stack([np.bincount(flat, np.repeat(column, 3), minlength=count) for column in values.T], axis=1)


def ring_normals(surface: Surface) -> Array:
    """Return unit normals (m, 3) of the faces, averaged over two rings of neighbours."""
    vectors = surface.area_vectors_mm2
    for _ in range(2):
        vectors = sum_at_corners(surface.faces, vectors, len(surface.vertices_mm))[surface.faces].mean(axis=1)
    return unit(vectors)


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) at unit length."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30))


def refined(points: Array, faces: Faces, edge_mm: float) -> tuple[Array, Faces]:
    """Bisect the longer edges of a triangle mesh; the surface itself does not change."""
    corners = points[faces]
    if np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1).max(initial=0.0) <= edge_mm:
        return points, faces
    from vtkmodules.vtkFiltersCore import vtkCleanPolyData
    from vtkmodules.vtkFiltersModeling import vtkAdaptiveSubdivisionFilter

    divide, merge = vtkAdaptiveSubdivisionFilter(), vtkCleanPolyData()
    divide.SetInputData(polydata(points, faces))
    divide.SetMaximumEdgeLength(edge_mm)
    divide.SetMaximumTriangleArea(1e9)
    divide.SetMaximumNumberOfPasses(12)
    merge.SetInputConnection(divide.GetOutputPort())
    merge.Update()
    return arrays_of(merge.GetOutput())

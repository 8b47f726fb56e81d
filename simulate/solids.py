"""Closed triangle meshes of simple bodies, and their exact moments.

A solid is the truth of a simulation: its volume, centroid and second moments are those of the polyhedron
itself, in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform

Faces = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Exact moments of a body of uniform weight."""

    volume_mm3: float
    centroid_mm: Array  # (3,)
    second_mm5: Array  # (3, 3): Integral of (r - c)(r - c)^T dV about the centroid


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed triangle mesh."""

    vertices_mm: Array
    faces: Faces  # counter-clockwise seen from outside

    def moved(self, transform: RigidTransform) -> Solid:
        """Return the solid in another frame."""
        return Solid(transform.points(self.vertices_mm), self.faces)

    def stretched(self, factors: ArrayLike) -> Solid:
        """Return the solid with each axis scaled by a factor (3,); a mirrored one is turned outward again."""
        return outward(self.vertices_mm * np.asarray(factors, dtype=float), self.faces)

    def moments(self) -> Moments:
        """Return the exact moments of the polyhedron.

        Notes
        -----
        Sum over the tetrahedra of each face with a point near the body (Tonon 2004, J. Math. Stat. 1:8,
        doi:10.3844/jmssp.2005.8.11), so that a body far from the origin loses no digits.
        """
        centre = 0.5 * (self.vertices_mm.min(axis=0) + self.vertices_mm.max(axis=0))
        a, b, c = (self.vertices_mm[self.faces[:, k]] - centre for k in range(3))
        six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
        total = a + b + c
        volume = float(six_volumes.sum() / 6.0)
        second = (total * six_volumes[:, None]).T @ total
        for corner in (a, b, c):
            second += (corner * six_volumes[:, None]).T @ corner
        centroid = six_volumes @ total / 24.0 / volume
        second = second / 120.0 - volume * np.outer(centroid, centroid)
        return Moments(volume_mm3=volume, centroid_mm=centre + centroid, second_mm5=second)

    def is_closed(self) -> bool:
        """Return whether every edge is walked as often in one direction as in the other."""
        start, end = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        size = np.int64(len(self.vertices_mm))
        return bool(np.array_equal(np.sort(start * size + end), np.sort(end * size + start)))


def outward(vertices_mm: Array, faces: Faces) -> Solid:
    """Return a solid whose faces are turned outward."""
    a, b, c = (vertices_mm[faces[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
        faces = faces[:, ::-1]
    return Solid(vertices_mm, np.ascontiguousarray(faces))


def joined(*solids: Solid) -> Solid:
    """Return one solid of several that do not touch."""
    start = np.cumsum([0] + [len(solid.vertices_mm) for solid in solids])
    faces = [solid.faces + first for solid, first in zip(solids, start, strict=False)]
    return Solid(np.concatenate([solid.vertices_mm for solid in solids]), np.concatenate(faces))


def box(low_mm: ArrayLike, high_mm: ArrayLike) -> Solid:
    """Return an axis-parallel box between two corners (3,)."""
    low, high = np.asarray(low_mm, dtype=float), np.asarray(high_mm, dtype=float)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([part for a, b, c, d in quads for part in ((a, b, c), (a, c, d))])
    return outward(low + corners * (high - low), faces)


def ring(inner_mm: Array, outer_mm: Array, low_mm: float, high_mm: float) -> Solid:
    """Return the solid between two outlines (n, 2) of (x, z), from y = low to y = high."""
    levels = [(inner_mm, low_mm), (outer_mm, low_mm), (outer_mm, high_mm), (inner_mm, high_mm)]
    return _swept([np.insert(part, 1, y, axis=1) for part, y in levels])


def rod(start_mm: ArrayLike, end_mm: ArrayLike, radius_mm: float, sides: int = 48) -> Solid:
    """Return a cylinder between two points (3,)."""
    start, end = np.asarray(start_mm, dtype=float), np.asarray(end_mm, dtype=float)
    axis = end - start
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    other = np.cross(axis / np.linalg.norm(axis), across)
    turns = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    circle = radius_mm * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * other)
    return _swept([circle + start, circle + end], (start, end))


def ellipsoid(centre_mm: ArrayLike, radii_mm: ArrayLike, steps: int = 48) -> Solid:
    """Return an ellipsoid with its axes along x, y and z, as a mesh of ``steps`` by ``steps`` / 2 patches."""
    around = np.linspace(0.0, 2.0 * np.pi, steps, endpoint=False)
    circle = np.column_stack([np.cos(around), np.zeros(steps), np.sin(around)])
    pole, radii, centre = np.array([0.0, 1.0, 0.0]), np.asarray(radii_mm), np.asarray(centre_mm)
    down = np.linspace(0.0, np.pi, steps // 2 + 1)[1:-1]
    belts = [(np.sin(angle) * circle + np.cos(angle) * pole) * radii + centre for angle in down]
    return _swept(belts, (pole * radii + centre, -pole * radii + centre))


def _swept(levels: Sequence[Array], ends: tuple[Array, Array] | None = None) -> Solid:
    """Return the solid within closed lines (n, 3) one after the other.

    The last line is followed by the first, or both are closed by a point.
    """
    count = len(levels[0])
    here = np.arange(count)
    there = (here + 1) % count
    faces = []
    for level in range(len(levels) - (ends is not None)):
        a, b = level * count, (level + 1) % len(levels) * count
        faces += [
            np.column_stack([a + here, a + there, b + there]),
            np.column_stack([a + here, b + there, b + here]),
        ]
    vertices = np.concatenate(levels)
    if ends is not None:
        first, last = np.full(count, len(vertices)), (len(levels) - 1) * count
        faces += [
            np.column_stack([first, there, here]),
            np.column_stack([first + 1, last + here, last + there]),
        ]
        vertices = np.concatenate([vertices, ends])
    return outward(vertices, np.concatenate(faces))


def solid_of_field(
    field: Callable[[Array], Array], low_mm: Sequence[float], high_mm: Sequence[float], step_mm: float
) -> Solid:
    """Return the solid where a field of points (..., 3) in mm is negative, meshed by marching cubes.

    The mesh, not the field, is the body: each step gives a slightly different one with its own exact moments.
    """
    from skimage.measure import marching_cubes

    axes = [np.arange(a, b + step_mm, step_mm) for a, b in zip(low_mm, high_mm, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(field(grid), 0.0, allow_degenerate=False)
    return outward(vertices.astype(float) * step_mm + np.asarray(low_mm), faces.astype(np.int64))

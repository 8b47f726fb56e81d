"""A stapes-like body whose footplate frame is known by construction: an alternative to the real one.

A flat elliptic footplate with rounded rim, two crura and a head, symmetric about the plane z = 0; its medial
side is symmetric about x = 0 too, so the centre and the axes of the medial face are those of the coordinates.
Its mesh is the body: the moments of a polyhedron are exact.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.surface import Surface, write_surface
from sample_volumes.bodies import outward

Array = NDArray[np.float64]

FOOTPLATE_HALF_MM = (1.4, 0.65)
THICKNESS_MM = 0.3
HEAD_MM = (0.05, 3.1, 0.0)


@functools.lru_cache(maxsize=4)
def analytic_stapes(step_mm: float = 0.04) -> Surface:
    """Return the body as a closed surface in its own footplate axes, y = 0 on the flat of the medial face.

    Parameters
    ----------
    step_mm : float
        Size of the mesh; each size is a slightly different body with its own exact moments.

    Notes
    -----
    The footplate frame's origin stands above y = 0 by the rounded rim's share of the medial face only.
    """
    return solid_of(_distance, step_mm)


def write_analytic_stapes(path: Path, step_mm: float = 0.04) -> Path:
    """Write the body as a mesh file, for Ear.stapes, and return its path."""
    write_surface(path, analytic_stapes(step_mm))
    return path


def solid_of(distance: Callable[[Array], Array], step_mm: float) -> Surface:
    """Return the surface where a field of points (..., 3) in mm is 0, negative inside."""
    from skimage.measure import marching_cubes

    half = [np.arange(0.5 * step_mm, reach, step_mm) for reach in (1.8, 1.0)]
    x, z = (np.concatenate([-part[::-1], part]) for part in half)
    y = np.arange(-0.2 + 0.31 * step_mm, 3.9, step_mm)
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(distance(grid), 0.0)
    solid = outward(vertices * step_mm + [x[0], y[0], z[0]], faces)
    return Surface(solid.vertices, solid.faces)


def footplate(points: Array) -> Array:
    """Return about the distance in mm from the footplate's surface, negative inside."""
    x, y, z = np.moveaxis(points, -1, 0)
    a, b = FOOTPLATE_HALF_MM
    rim = 0.1
    level = np.hypot(x / a, z / b)
    across = level * (level - 1.0) / np.maximum(np.hypot(x / a**2, z / b**2), 1e-9) + rim
    along = np.abs(y - 0.5 * THICKNESS_MM) - 0.5 * THICKNESS_MM + rim
    inside = np.minimum(np.maximum(across, along), 0.0) - rim
    return np.asarray(inside + np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0)))


def _distance(points: Array) -> Array:
    """Return a field that is negative inside the body, about a distance in mm near its surface."""
    head = np.array(HEAD_MM)
    parts = [
        footplate(points),
        capsule(points, (-0.95, 0.25, 0.0), head - [0.35, 0.6, 0.0], 0.2),
        capsule(points, (0.95, 0.25, 0.0), head - [-0.25, 0.6, 0.0], 0.17),
        capsule(points, head - [0.0, 0.45, 0.0], head, 0.42),
    ]
    return np.asarray(np.minimum.reduce(parts))


def capsule(points: Array, start: object, end: object, radius: float) -> Array:
    """Return the distance in mm from a capsule's surface, negative inside."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    share = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1) - radius)

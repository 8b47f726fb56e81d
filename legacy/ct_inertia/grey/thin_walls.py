"""Where a surface at the half level lies too deep because the wall behind it is as thin as the blur."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.grid_operations import interpolated
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_quantile
from legacy.stapeskit.arrays import Array

# Walls thicker than this many widths of the blur have faces that do not see each other (3e-5 of a width).
_THICK = 5.0
# Walls thinner than this stay below the half level.
_THINNEST = 1.4
# Step along the normal in widths of the blur: the share is linear enough between two for a crossing.
_STEP = 0.25
# Rings of neighbours that the shift is averaged over: single normals are noisy. Chosen by judgement.
_SMOOTHING = 4
# Least grey value, as a share of bone, at the edge of a wall that is not shifted further: nearer to the half
# level the shift is without bound.
_LEAST_PLATEAU = 0.55


def thin_wall_shift(
    surface: Surface, normals: Array, share: NDArray[np.float32], transform: Array, blur_mm: float
) -> Array:
    """Return by how much each vertex (n,) lies too deep, mm, along its outward normal.

    Parameters
    ----------
    surface : Surface
        The half level of ``share``.
    normals : ndarray, (n, 3)
        Its `vertex_normals`.
    share : ndarray of float32, [z, y, x]
    transform : ndarray, (4, 4)
        Index x, y, z of the share to scan coordinates, mm.
    blur_mm : float
        Standard deviation of the blur of the share.

    Notes
    -----
    A plate of thickness T is seen as Phi((x + T/2) / b) - Phi((x - T/2) / b), which has the half level at
    x = t/2 < T/2. The thickness t is measured along the inward normal, T follows from the table of t(T).
    At the edge of a plate the inward normal runs within it: its grey value p < 1 there puts the half level
    where p Phi(x / b) = 1/2.
    """
    seen, most = _seen_thickness(surface.vertices_mm, normals, share, transform, blur_mm)
    true, lost = _lost_thickness()
    shift = np.interp(seen / blur_mm, true - 2.0 * lost, lost, left=float(lost[0]), right=0.0) * blur_mm
    edge = np.isinf(seen) & (most < 1.0)
    shift[edge] = normal_quantile(0.5 / np.clip(most[edge], _LEAST_PLATEAU, 1.0)) * blur_mm
    return smoothed(surface, shift)


def vertex_normals(surface: Surface) -> Array:
    """Return outward unit normals (n, 3) of vertices, averaged over their neighbours."""
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    vectors = np.cross(b - a, c - a)
    normals = np.zeros_like(surface.vertices_mm)
    for k in range(3):
        column = np.repeat(vectors[:, k], 3)
        normals[:, k] = np.bincount(surface.faces.ravel(), column, minlength=len(normals))
    for k in range(3):
        normals[:, k] = smoothed(surface, normals[:, k])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def smoothed(surface: Surface, field: Array, rounds: int = _SMOOTHING) -> Array:
    """Average a field (n,) over the neighbours of every vertex."""
    faces, n = surface.faces, len(field)
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    count = np.maximum(np.bincount(start, minlength=n), 1)
    for _ in range(rounds):
        field = 0.5 * field + 0.5 * np.bincount(start, field[end], minlength=n) / count
    return field


@cache
def _lost_thickness() -> tuple[Array, Array]:
    """Return the thickness of plates, and how far the half level lies below each face, in widths of blur."""
    true = np.linspace(_THINNEST, _THICK, 200)
    low, high = np.zeros_like(true), 0.5 * true + 1.0
    for _ in range(50):
        x = 0.5 * (low + high)
        above = normal_cdf(x + 0.5 * true) - normal_cdf(x - 0.5 * true) > 0.5
        low, high = np.where(above, x, low), np.where(above, high, x)
    return true, 0.5 * (true - (low + high))


def _seen_thickness(
    points_mm: Array, normals: Array, share: NDArray[np.float32], transform: Array, blur_mm: float
) -> tuple[Array, Array]:
    """Return how far the half level is along the inward normals (n,), mm, infinite where far; and the most.

    The most (n,) is the largest share beyond 1.5 widths of the blur behind the surface.
    """
    back = np.linalg.inv(transform)
    start = (points_mm @ back[:3, :3].T + back[:3, 3])[:, ::-1]
    along = (-normals @ back[:3, :3].T)[:, ::-1]
    depth = np.arange(1, int((_THICK + 1.0) / _STEP)) * (_STEP * blur_mm)
    places = start + depth[:, None, None] * along
    shares = interpolated(share, places.reshape(-1, 3)).reshape(places.shape[:2])
    # Noise right behind the surface is no second face.
    beyond = (shares < 0.5) & (depth > 0.5 * blur_mm)[:, None]
    first = np.argmax(beyond, axis=0)
    before, now = (shares[k, np.arange(len(start))] for k in (np.maximum(first - 1, 0), first))
    part = np.clip((before - 0.5) / np.maximum(before - now, 1e-6), 0.0, 1.0)
    seen = np.where(beyond.any(axis=0), (first + part) * (_STEP * blur_mm), np.inf)
    return seen, np.max(shares[depth > 1.5 * blur_mm], axis=0)

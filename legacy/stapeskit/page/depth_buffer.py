"""Which pixels triangles cover, and which triangle the eye sees there: a depth buffer in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

Pixels = NDArray[np.intp]
# Candidates for a pixel that are looked at together: bounds the memory to some 200 MB.
_TOGETHER = 1 << 21


def vertex_normals(points: Array, faces: NDArray[np.integer]) -> Array:
    """Return normals (n, 3) at the corners: means over the faces that meet there, by area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.stack(
        [np.bincount(faces.ravel(), areas[:, k], minlength=len(points)) for k in range(3)], axis=1
    )


def fragments(corners: Array, shape: tuple[int, int]) -> tuple[Pixels, Array, Pixels, Array]:
    """Return which pixels triangles cover.

    Parameters
    ----------
    corners : ndarray, (m, 3, 3)
        Column, row, and height towards the eye, of each corner.
    shape : (int, int)
        Rows and columns of the picture.

    Returns
    -------
    place, height, face, shares : ndarray, (n,), (n,), (n,), (n, 3)
        Pixel (row * columns + column), height there, number of the triangle, and the shares of its corners.
    """
    ends = shape[::-1]
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - 1e-9), 0, ends).astype(np.intp)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) + 1e-9) + 1, 0, ends).astype(np.intp)
    wide = (high - low).max(axis=1)
    shown = np.flatnonzero((high - low).min(axis=1) > 0)
    # Triangles of like size share a square of candidates.
    side = np.zeros(len(corners), dtype=np.intp)
    side[shown] = 2 ** np.ceil(np.log2(wide[shown])).astype(np.intp)
    parts = []
    for size in np.unique(side[shown]):
        members = shown[side[shown] == size]
        step = max(1, _TOGETHER // int(size * size))
        for start in range(0, len(members), step):
            parts.append(_pixels_inside(corners, low, members[start : start + step], int(size), shape))
    if not parts:
        return np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp), np.zeros((0, 3))
    place, height, face, shares = (np.concatenate(column) for column in zip(*parts, strict=True))
    return place, height, face, shares


def _pixels_inside(
    corners: Array, low: Pixels, members: Pixels, size: int, shape: tuple[int, int]
) -> tuple[Pixels, Array, Pixels, Array]:
    """Return the pixels of some triangles out of squares of candidates; see `fragments`."""
    grid = np.arange(size)
    column = low[members, 0, None] + np.tile(grid, size)
    row = low[members, 1, None] + np.repeat(grid, size)
    (ax, ay, _), (bx, by, _), (cx, cy, _) = (corners[members, k].T[:, :, None] for k in range(3))
    double = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    double = np.where(np.abs(double) > 1e-12, double, np.inf)
    first = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / double
    second = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / double
    third = 1.0 - first - second
    inside = (np.minimum(np.minimum(first, second), third) >= -1e-6) & (column < shape[1]) & (row < shape[0])
    which, _ = np.nonzero(inside)
    shares = np.stack([first[inside], second[inside], third[inside]], axis=1)
    face = members[which]
    height = np.einsum("nk,nk->n", shares, corners[face, :, 2])
    return row[inside] * shape[1] + column[inside], height, face, shares


def nearest(place: Pixels, height: Array, count: int) -> Pixels:
    """Return which fragment is nearest to the eye in each of ``count`` pixels that has one."""
    order = np.argsort(height, kind="stable")
    top = np.full(count, -1, dtype=np.intp)
    top[place[order]] = order  # of repeated pixels the last counts
    return top[top >= 0]

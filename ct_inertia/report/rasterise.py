"""Draw shaded surfaces with a depth buffer in numpy: the same on every machine, without a GL driver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ct_inertia.report.drawn_body import Body

Array = NDArray[np.float64]
Pixels = NDArray[np.intp]
# Directions to the lamp and the eye in the picture's axes, and the shares of ambient and diffuse light.
_LAMP, _EYE = np.array([-0.33, 0.44, 0.835]), np.array([0.0, 0.0, 1.0])
_AMBIENT, _BY_LAMP, _BY_EYE = 0.22, 0.58, 0.28
# Candidates for a pixel that are looked at together: bounds the memory to some 200 MB.
_TOGETHER = 1 << 21


def rasterise(
    bodies: Sequence[Body], picture_from_scan: Array, centre_mm: Array, half_mm: float, pixels: int
) -> NDArray[np.uint8]:
    """Draw surfaces in parallel projection.

    Parameters
    ----------
    bodies : sequence of Body
        Closed and outward: faces that look away are left out.
    picture_from_scan : ndarray, (4, 4)
        Scan coordinates to right, up and towards the eye, mm.
    centre_mm : ndarray, (2,)
        Right and up of the picture's centre.
    half_mm : float
        Half of its width and height.
    pixels : int
        Its width and height.

    Returns
    -------
    ndarray of uint8, (pixels, pixels, 3)
        The top row first, on white.
    """
    from matplotlib.colors import to_rgb

    picture = np.ones((pixels * pixels, 3))
    depth = np.full(pixels * pixels, -np.inf)
    # Opaque bodies first; what shines through them is blended over what lies behind.
    for body in sorted(bodies, key=lambda body: body.opacity < 1.0):
        points = body.vertices_mm @ picture_from_scan[:3, :3].T + picture_from_scan[:3, 3]
        faces = np.asarray(body.faces)
        a, b, c = (points[faces[:, k]] for k in range(3))
        areas = np.cross(b - a, c - a)
        seen = areas[:, 2] > 0.0
        faces, areas = faces[seen], areas[seen]
        normals = _vertex_normals(points, np.asarray(body.faces)) if body.smooth else None
        flat = points.copy()
        scale = pixels / (2.0 * half_mm)
        flat[:, 0] = (points[:, 0] - centre_mm[0] + half_mm) * scale - 0.5
        flat[:, 1] = (half_mm - points[:, 1] + centre_mm[1]) * scale - 0.5
        place, height, face, shares = _fragments(flat[faces], pixels)
        front = height > depth[place]
        place, height, face, shares = place[front], height[front], face[front], shares[front]
        nearest = _nearest(place, height, pixels)
        place, face, shares = place[nearest], face[nearest], shares[nearest]
        across = areas[face] if normals is None else np.einsum("nk,nkj->nj", shares, normals[faces[face]])
        across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
        light = _AMBIENT + _BY_LAMP * np.clip(across @ _LAMP, 0, 1) + _BY_EYE * np.clip(across @ _EYE, 0, 1)
        colour = np.clip(np.array(to_rgb(body.color)) * light[:, None], 0.0, 1.0)
        picture[place] += body.opacity * (colour - picture[place])
        if body.opacity >= 1.0:
            depth[place] = height[nearest]
    return np.rint(255.0 * picture).astype(np.uint8).reshape(pixels, pixels, 3)


def _vertex_normals(points: Array, faces: NDArray[np.integer]) -> Array:
    """Return normals (n, 3) at the corners: means over the faces that meet there, by area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.stack(
        [np.bincount(faces.ravel(), areas[:, k], minlength=len(points)) for k in range(3)], axis=1
    )


def _fragments(corners: Array, pixels: int) -> tuple[Pixels, Array, Pixels, Array]:
    """Return which pixels triangles cover.

    Parameters
    ----------
    corners : ndarray, (m, 3, 3)
        Column, row and depth of each corner.
    pixels : int

    Returns
    -------
    place, height, face, shares : ndarray, (n,), (n,), (n,), (n, 3)
        Pixel, depth there, number of the triangle, and the shares of its corners.
    """
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - 1e-9), 0, pixels).astype(np.intp)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) + 1e-9) + 1, 0, pixels).astype(np.intp)
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
            parts.append(_covered(corners, low, members[start : start + step], int(size), pixels))
    if not parts:
        return np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp), np.zeros((0, 3))
    place, height, face, shares = (np.concatenate(column) for column in zip(*parts, strict=True))
    return place, height, face, shares


def _covered(
    corners: Array, low: Pixels, members: Pixels, size: int, pixels: int
) -> tuple[Pixels, Array, Pixels, Array]:
    """Return the pixels of some triangles out of squares of candidates; see `_fragments`."""
    grid = np.arange(size)
    column = low[members, 0, None] + np.tile(grid, size)
    row = low[members, 1, None] + np.repeat(grid, size)
    (ax, ay, _), (bx, by, _), (cx, cy, _) = (corners[members, k].T[:, :, None] for k in range(3))
    double = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    double = np.where(np.abs(double) > 1e-12, double, np.inf)
    first = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / double
    second = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / double
    third = 1.0 - first - second
    inside = (np.minimum(np.minimum(first, second), third) >= -1e-6) & (column < pixels) & (row < pixels)
    which, _ = np.nonzero(inside)
    shares = np.stack([first[inside], second[inside], third[inside]], axis=1)
    face = members[which]
    height = np.einsum("nk,nk->n", shares, corners[face, :, 2])
    return row[inside] * pixels + column[inside], height, face, shares


def _nearest(place: Pixels, height: Array, pixels: int) -> Pixels:
    """Return which fragment is nearest to the eye in each pixel that has one."""
    order = np.argsort(height, kind="stable")
    top = np.full(pixels * pixels, -1, dtype=np.intp)
    top[place[order]] = order  # of repeated pixels the last counts
    return top[top >= 0]

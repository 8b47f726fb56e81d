"""A shaded picture of a surface, drawn by numpy alone: orthographic views of the footplate frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import axis_vector
from legacy.stapeskit.page.depth_buffer import Pixels, fragments, nearest, vertex_normals

Faces = NDArray[np.int64]
_BONE = np.array([0.93, 0.89, 0.80])
_LIGHT = np.array([-0.45, 0.55, 0.70])
# Finer pixels along each side of a pixel, which smooth the edges.
_FINER = 2


@dataclass(frozen=True)
class View:
    """A direction to look from.

    Attributes
    ----------
    eye : str
        Signed axis that points to the reader: ``+z``, ``+x``, ``+y``.
    right, up : str
        Signed axes that point right and up; right x up = eye.
    """

    eye: str
    right: str
    up: str

    @property
    def axes(self) -> Array:
        """Rows right, up, eye, (3, 3): ``points @ view.axes.T`` are picture coordinates and nearness."""
        return np.array([axis_vector(name) for name in (self.right, self.up, self.eye)], dtype=float)

    def flat(self, points_mm: Array) -> Array:
        """Return points (..., 3) as (right, up, nearness)."""
        return np.asarray(points_mm @ self.axes.T)


def views() -> tuple[View, View, View]:
    """Return the views along z, from anterior and from lateral, as in the reports of scan and stiffness."""
    return View("+z", "+x", "+y"), View("+x", "-z", "+y"), View("+y", "+x", "-z")


@dataclass(frozen=True)
class Shaded:
    """A picture.

    Attributes
    ----------
    image : ndarray, (rows, columns, 4)
        Red, green, blue, opacity, 0 to 1; row 0 is at the top.
    depth : ndarray, (rows, columns)
        Nearness of the surface to the reader, mm; -inf outside it.
    extent : tuple of float
        left, right, bottom, top in picture coordinates, mm.
    """

    image: Array
    depth: Array
    extent: tuple[float, float, float, float]

    def hides(self, flat: Array, margin_mm: float) -> NDArray[np.bool_]:
        """Return which points (n, 3), as (right, up, nearness), lie behind the surface, with a margin."""
        left, right, bottom, top = self.extent
        rows, columns = self.depth.shape
        column = np.clip(((flat[:, 0] - left) / (right - left) * columns).astype(int), 0, columns - 1)
        row = np.clip(((top - flat[:, 1]) / (top - bottom) * rows).astype(int), 0, rows - 1)
        inside = (flat[:, 0] >= left) & (flat[:, 0] <= right) & (flat[:, 1] >= bottom) & (flat[:, 1] <= top)
        return np.asarray(inside & (self.depth[row, column] > flat[:, 2] + margin_mm))


def shade(vertices_mm: Array, faces: Faces, view: View, pixels: int = 380) -> Shaded:
    """Draw a closed surface lit from the upper left.

    Parameters
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray, (m, 3), int
    pixels : int
        Along the longer side of the picture.
    """
    flat = view.flat(np.asarray(vertices_mm, dtype=float))
    low, pixel, columns, rows = _raster(flat, pixels, 2)
    shape = rows * _FINER, columns * _FINER
    place, near, face, shares = _visible(flat, faces, low, pixel / _FINER, shape)
    tone, depth = np.full(shape, np.nan), np.full(shape, -np.inf)
    tone.flat[place] = np.sum(shares * _vertex_light(flat, faces)[faces[face]], axis=1)
    depth.flat[place] = near
    image, depth = _halve(tone, depth)
    right, top = low[0] + columns * pixel, low[1] + rows * pixel
    return Shaded(image, depth, (float(low[0]), float(right), float(low[1]), float(top)))


def silhouette(vertices_mm: Array, faces: Faces, view: View, pixels: int = 220) -> tuple[Array, Array, Array]:
    """Return what a closed surface covers, smoothed so that the level 0.5 is its edge.

    Parameters
    ----------
    vertices_mm, faces, view, pixels
        As for shade.

    Returns
    -------
    across, up : ndarray, (columns,) and (rows,)
        Picture coordinates of the pixels, mm.
    covered : ndarray, (rows, columns)
        0 outside the surface to 1 within.
    """
    flat = view.flat(np.asarray(vertices_mm, dtype=float))
    low, pixel, columns, rows = _raster(flat, pixels, 3)
    covered = np.zeros((rows, columns))
    covered.flat[_visible(flat, faces, low, pixel, (rows, columns))[0]] = 1.0
    padded = np.pad(covered[::-1], 1)
    parts = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    smooth = sum(parts, np.zeros_like(covered)) / 9.0
    return low[0] + (np.arange(columns) + 0.5) * pixel, low[1] + (np.arange(rows) + 0.5) * pixel, smooth


def _raster(flat: Array, pixels: int, margin: int) -> tuple[Array, float, int, int]:
    """Return lower left corner, pixel size (mm), columns and rows for a surface with a margin of pixels."""
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    pixel = float(np.max(high - low)) / pixels or 1.0
    low = low - margin * pixel
    columns, rows = (int(np.ceil(side / pixel)) + 2 * margin - 2 for side in (high - low))
    return low, pixel, columns, rows


def _vertex_light(flat: Array, faces: Faces) -> Array:
    """Return the brightness of every vertex, (n,), 0 to 1, from normals averaged over its triangles."""
    mean = vertex_normals(flat, faces)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    lit = np.clip(mean @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    facing = np.clip(mean[:, 2], 0.0, 1.0)
    return np.asarray(0.30 + 0.50 * lit + 0.20 * facing)


def _visible(
    flat: Array, faces: Faces, low: Array, pixel: float, shape: tuple[int, int]
) -> tuple[Pixels, Array, Pixels, Array]:
    """Return what is seen of triangles that face the eye: pixel, nearness, triangle, corner shares."""
    corners = flat.copy()
    corners[:, 0] = (flat[:, 0] - low[0]) / pixel - 0.5
    corners[:, 1] = shape[0] - 0.5 - (flat[:, 1] - low[1]) / pixel
    a, b, c = (flat[faces[:, k], :2].T for k in range(3))
    facing = np.flatnonzero((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0)
    place, near, face, shares = fragments(corners[faces[facing]], shape)
    shown = nearest(place, near, shape[0] * shape[1])
    return place[shown], near[shown], facing[face[shown]], shares[shown]


def _halve(tone: Array, depth: Array) -> tuple[Array, Array]:
    """Return the coloured picture at half the resolution, and its depth."""
    rows, columns = tone.shape[0] // _FINER, tone.shape[1] // _FINER
    blocks = tone.reshape(rows, _FINER, columns, _FINER)
    filled = ~np.isnan(blocks)
    share = filled.mean(axis=(1, 3))
    bright = np.where(filled, blocks, 0.0).sum(axis=(1, 3)) / np.maximum(filled.sum(axis=(1, 3)), 1)
    image = np.empty((rows, columns, 4))
    image[..., :3] = np.clip(bright[..., None] * _BONE * 1.06, 0.0, 1.0)
    image[..., 3] = share
    return image, depth.reshape(rows, _FINER, columns, _FINER).max(axis=(1, 3))

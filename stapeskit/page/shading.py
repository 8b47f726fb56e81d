"""A shaded picture of a surface, drawn by numpy alone: orthographic views of the footplate frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stapeskit.frames import axis_vector

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
_BONE = np.array([0.93, 0.89, 0.80])
_LIGHT = np.array([-0.45, 0.55, 0.70])
# Samples a pixel along each axis, and along the edge of a triangle.
_FINER = 2
_MOST_SAMPLES = 64


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
        Nearness of the surface to the reader, mm; -inf beside it.
    extent : tuple of float
        left, right, bottom, top in picture coordinates, mm.
    """

    image: Array
    depth: Array
    extent: tuple[float, float, float, float]

    def hides(self, flat: Array, margin_mm: float) -> NDArray[np.bool_]:
        """Tell which points (n, 3), as (right, up, nearness), lie behind the surface, with a margin."""
        left, right, bottom, top = self.extent
        rows, columns = self.depth.shape
        column = np.clip(((flat[:, 0] - left) / (right - left) * columns).astype(int), 0, columns - 1)
        row = np.clip(((top - flat[:, 1]) / (top - bottom) * rows).astype(int), 0, rows - 1)
        inside = (flat[:, 0] >= left) & (flat[:, 0] <= right) & (flat[:, 1] >= bottom) & (flat[:, 1] <= top)
        return np.asarray(inside & (self.depth[row, column] > flat[:, 2] + margin_mm))


def shade(vertices_mm: Array, faces: Faces, view: View, pixels: int = 380) -> Shaded:
    """Draw a closed surface with one light from the upper left.

    Parameters
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray, (m, 3), int
    view : View
    pixels : int
        Along the longer side of the picture.

    Notes
    -----
    Triangles are sampled more densely than the pixels lie and sorted by nearness; pixels are halved
    afterwards, which smooths the edges.
    """
    flat = view.flat(np.asarray(vertices_mm, dtype=float))
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    pixel = float(np.max(high - low)) / pixels or 1.0
    low = low - 2.0 * pixel
    columns, rows = (int(np.ceil(side / pixel)) + 2 for side in (high - low))
    light = _vertex_light(flat, faces)
    place, near, bright = _samples(flat, faces, light, low, pixel / _FINER)
    width, height = columns * _FINER, rows * _FINER
    steps = (near - near.min()) * (65535.0 / max(float(np.ptp(near)), 1e-300))
    order = np.argsort(steps.astype(np.uint16), kind="stable")
    cell = ((height - 1 - place[order, 1]) * width + place[order, 0]).astype(np.int64)
    tone = np.full(height * width, np.nan)
    depth = np.full(height * width, -np.inf)
    tone[cell], depth[cell] = bright[order], near[order]
    tone, depth = _closed(tone.reshape(height, width), depth.reshape(height, width))
    image, depth = _halved(tone, depth)
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
        0 beside the surface to 1 within.
    """
    flat = view.flat(np.asarray(vertices_mm, dtype=float))
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    pixel = float(np.max(high - low)) / pixels or 1.0
    low = low - 3.0 * pixel
    columns, rows = (int(np.ceil(side / pixel)) + 4 for side in (high - low))
    place = _samples(flat, faces, np.zeros(len(flat)), low, pixel)[0]
    covered = np.zeros((rows, columns))
    covered[place[:, 1], place[:, 0]] = 1.0
    padded = np.pad(covered, 1)
    parts = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    smooth = sum(parts, np.zeros_like(covered)) / 9.0
    return low[0] + (np.arange(columns) + 0.5) * pixel, low[1] + (np.arange(rows) + 0.5) * pixel, smooth


def _vertex_light(flat: Array, faces: Faces) -> Array:
    """Return the brightness of every vertex, (n,), 0 to 1, from normals averaged over its triangles."""
    corner = flat[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    owner = faces.ravel()
    total = [np.bincount(owner, np.repeat(normal[:, k], 3), len(flat)) for k in range(3)]
    mean = np.column_stack(total)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    lit = np.clip(mean @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    facing = np.clip(mean[:, 2], 0.0, 1.0)
    return np.asarray(0.30 + 0.50 * lit + 0.20 * facing)


def _samples(
    flat: Array, faces: Faces, light: Array, low: Array, pixel: float
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return pixel (k, 2), nearness (k,) and brightness (k,) of samples of triangles facing the reader."""
    corner = flat[faces]
    edge_a, edge_b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    facing = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0] > 0.0
    faces, corner = faces[facing], corner[facing]
    edges = corner - np.roll(corner, 1, axis=1)
    longest = np.sqrt(np.max(np.sum(edges[:, :, :2] ** 2, axis=2), axis=1)) / pixel
    parts = np.clip(np.ceil(longest), 1, _MOST_SAMPLES).astype(int)
    places, nears, brights = [], [], []
    for count in np.unique(parts):
        own = parts == count
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
        inside = (i + j) <= count
        weight = np.column_stack([i[inside], j[inside], count - i[inside] - j[inside]]) / count
        at = (weight @ corner[own]).reshape(-1, 3)
        places.append(np.floor((at[:, :2] - low) / pixel).astype(np.int64))
        nears.append(at[:, 2])
        brights.append((light[faces[own]] @ weight.T).ravel())
    return np.concatenate(places), np.concatenate(nears), np.concatenate(brights)


def _closed(tone: Array, depth: Array) -> tuple[Array, Array]:
    """Fill single empty pixels that have filled ones on opposite sides."""
    padded, deep = np.pad(tone, 1, constant_values=np.nan), np.pad(depth, 1, constant_values=-np.inf)
    empty = np.isnan(tone)
    for first, second in (((0, 1), (2, 1)), ((1, 0), (1, 2))):
        rows, columns = tone.shape
        a, b = (padded[r : r + rows, c : c + columns] for r, c in (first, second))
        near = np.minimum(*(deep[r : r + rows, c : c + columns] for r, c in (first, second)))
        fill = empty & ~np.isnan(a) & ~np.isnan(b)
        tone = np.where(fill, 0.5 * (a + b), tone)
        depth = np.where(fill, near, depth)
    return tone, depth


def _halved(tone: Array, depth: Array) -> tuple[Array, Array]:
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

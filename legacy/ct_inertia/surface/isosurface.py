"""Closed iso surfaces of grey values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.surface.contours import contoured
from legacy.ct_inertia.surface.surface import Surface, enclosed_volume
from legacy.ct_inertia.volume.mesh_graphs import graph_pieces
from legacy.stapeskit.arrays import Array

_TINY_SHARE = calibrated("isosurface.least_cavity")
# Value of the padding, below every level, so that the surface closes at the border.
_OUTSIDE = -1.0


def iso_surface(field: NDArray[np.float32], level: float, scan_from_index: Array) -> Surface:
    """Return the closed outward surface where a field [z, y, x] crosses a level.

    Parameters
    ----------
    field : ndarray of float32, [z, y, x]
        Higher inside; what lies outside the array counts as far below the level.
    level : float
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the field to scan coordinates, mm.

    Raises
    ------
    CtInertiaError
        Nothing lies above the level.
    """
    corner, part = crop_field(field, level)
    points, faces = part_above(part, level)
    return place_surface(points + corner, faces, scan_from_index)


def crop_field(field: NDArray[np.float32], level: float) -> tuple[Array, NDArray[np.float32]]:
    """Return what lies above a level with two voxels around, and the index x, y, z of its first voxel.

    A border of voxels far below the level closes what the field's border cuts: caps half a voxel outside.
    """
    inside = field > level
    low, high = [], []
    for axis in range(3):
        other = tuple(k for k in range(3) if k != axis)
        place = np.flatnonzero(inside.any(axis=other))
        if len(place) == 0:
            raise _no_surface_error(level)
        low.append(int(place[0]))
        high.append(int(place[-1]) + 1)
    start = np.maximum(np.array(low) - 2, 0)
    box = tuple(slice(int(a), b + 2) for a, b in zip(start, high, strict=True))
    part = np.pad(field[box], 1, constant_values=_OUTSIDE)
    return start[::-1] - 1.0, part


def part_above(part: NDArray[np.float32], level: float) -> tuple[Array, NDArray[np.int64]]:
    """Return the largest closed surface at a level, in index x, y, z of a padded field."""
    below = np.float32(_border_value(part, level))
    for face in _sides(part):
        face[...] = below
    points, faces = _contour(part, level)
    if len(faces) == 0:
        raise _no_surface_error(level)
    return largest_part(points, faces)


def _sides(part: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return [np.moveaxis(part, axis, 0)[place] for axis in range(3) for place in (0, -1)]


def _no_surface_error(level: float) -> CtInertiaError:
    return CtInertiaError.of(
        "the body",
        "visible above its grey level",
        f"nothing above {level:g}",
        next_step="Check the labels and the grey values there",
    )


def _border_value(field: NDArray[np.float32], level: float) -> float:
    """Return a value as far below the level as the field's top lies above it: half-voxel caps at a border."""
    return 2.0 * level - max(float(field.max()), level + 1e-6)


def _contour(field: NDArray[np.float32], level: float) -> tuple[Array, NDArray[np.int64]]:
    """Contour a padded field; points in index x, y, z, faces outward."""
    points, faces = contoured(field, level)
    if len(faces) and enclosed_volume(points, faces) < 0.0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return points, faces


def largest_part(points: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Keep the largest closed part of a surface and its cavities of more than 0.1 %; drop specks."""
    n = len(points)
    # Two edges of every face join its corners.
    count, part = graph_pieces(n, np.concatenate([faces[:, :2], faces[:, 1:]]))
    if count == 1:
        return points, faces
    of_face = part[faces[:, 0]]
    a, b, c = (points[faces[:, k]] - points[faces[0, 0]] for k in range(3))
    volume = np.bincount(of_face, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0, minlength=count)
    main = int(np.argmax(volume))
    kept = (np.arange(count) == main) | (
        (volume < -_TINY_SHARE * volume[main]) & _inside_box(points, part, main, count)
    )
    faces = faces[kept[of_face]]
    used = np.zeros(n, dtype=bool)
    used[faces] = True
    place = np.cumsum(used) - 1
    return points[used], place[faces]


def _inside_box(points: Array, part: NDArray[np.int64], main: int, count: int) -> NDArray[np.bool_]:
    low, high = points[part == main].min(axis=0), points[part == main].max(axis=0)
    outside = np.any((points < low) | (points > high), axis=1)
    return np.asarray(np.bincount(part, outside, minlength=count) == 0)


def place_surface(points: Array, faces: NDArray[np.int64], scan_from_index: Array) -> Surface:
    """Return a surface in index x, y, z in scan coordinates."""
    return Surface(points @ scan_from_index[:3, :3].T + scan_from_index[:3, 3], faces)

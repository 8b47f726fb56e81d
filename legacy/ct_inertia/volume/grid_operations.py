"""Masks and grey values on a grid, by compiled kernels where there are any: what scipy.ndimage does else."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import checked, compiled, shape_of
from legacy.stapeskit.arrays import Array

Mask = NDArray[np.bool_]
Box = tuple[slice, ...]


def labelled(
    mask: Mask, corners: bool = False, out: NDArray[np.int32] | None = None
) -> tuple[NDArray[np.int32], int]:
    """Number the connected pieces of a mask in the order of their first voxels.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    corners : bool
        Voxels that touch in an edge or a corner hang together too.
    out : ndarray of int32, [z, y, x], optional
        Where to write; need not be contiguous.

    Returns
    -------
    labels : ndarray of int32, [z, y, x]
        From 1; 0 outside the mask.
    count : int
    """
    kernels = compiled()
    if kernels is None:
        from scipy import ndimage

        labels = np.empty(mask.shape, dtype=np.int32) if out is None else out
        count = int(ndimage.label(mask, structure=np.ones((3, 3, 3)) if corners else None, output=labels))
        return labels, count
    mask = np.ascontiguousarray(mask)
    labels = np.empty(mask.shape, dtype=np.int32)
    count = checked(kernels.label_pieces(mask.ctypes.data, shape_of(mask), int(corners), labels.ctypes.data))
    if out is not None:
        out[...] = labels
        labels = out
    return labels, count


def boxes_and_sizes(labels: NDArray[np.int32], count: int) -> tuple[list[Box | None], NDArray[np.int64]]:
    """Return the box (z, y, x) of every number from 1 to ``count``, and how many voxels have it, from 0."""
    kernels = compiled()
    if kernels is None:
        from scipy import ndimage

        return ndimage.find_objects(labels, count), np.bincount(labels.ravel(), minlength=count + 1)
    labels = np.ascontiguousarray(labels, dtype=np.int32)
    limits = np.empty((count + 1, 3, 2), dtype=np.int64)
    sizes = np.empty(count + 1, dtype=np.int64)
    kernels.measure_pieces(labels.ctypes.data, shape_of(labels), count, limits.ctypes.data, sizes.ctypes.data)
    boxes: list[Box | None] = [
        tuple(slice(a, b) for a, b in place) if place[0][1] else None for place in limits[1:].tolist()
    ]
    return boxes, sizes


def used_box(mask: Mask) -> Box | None:
    """Return the smallest box of slices (z, y, x) that holds a mask; None when it is empty."""
    kernels = compiled()
    if kernels is not None and mask.flags.c_contiguous:
        limits = np.empty((3, 2), dtype=np.int64)
        if not kernels.used_box(mask.ctypes.data, shape_of(mask), limits.ctypes.data):
            return None
        return tuple(slice(a, b) for a, b in limits.tolist())
    layers = np.asarray(mask.any(axis=(1, 2)))
    if not np.any(layers):
        return None
    flat = np.asarray(mask[layers].any(axis=0))
    places = [np.flatnonzero(line) for line in (layers, flat.any(axis=1), flat.any(axis=0))]
    return tuple(slice(int(place[0]), int(place[-1]) + 1) for place in places)


def dilated(mask: Mask, rounds: int = 1, within: Mask | None = None) -> Mask:
    """Grow a mask across faces by some voxels; only inside another mask where one is given."""
    kernels = compiled()
    if kernels is None:
        from scipy.ndimage import binary_dilation

        return np.asarray(binary_dilation(mask, iterations=rounds, mask=within))
    return _grow(kernels, mask, within, rounds, False)


def eroded(mask: Mask, rounds: int = 1) -> Mask:
    """Shrink a mask across faces by some voxels; what lies outside the grid counts as empty."""
    kernels = compiled()
    if kernels is None:
        from scipy.ndimage import binary_erosion

        return np.asarray(binary_erosion(mask, iterations=rounds))
    return _grow(kernels, mask, None, rounds, True)


def _grow(kernels: Any, mask: Mask, within: Mask | None, rounds: int, shrink: bool) -> Mask:
    mask = np.ascontiguousarray(mask)
    inner = None if within is None else np.ascontiguousarray(within)
    out = np.empty(mask.shape, dtype=bool)
    place = None if inner is None else inner.ctypes.data
    checked(kernels.grown(mask.ctypes.data, place, shape_of(mask), rounds, int(shrink), out.ctypes.data))
    return out


def majority(mask: Mask) -> Mask:
    """Return voxels most of whose 27 around them are in a mask whose rim is empty."""
    kernels = compiled()
    if kernels is None:
        from scipy.ndimage import uniform_filter

        return np.asarray(uniform_filter(mask.astype(np.float32), 3) > 0.5)
    mask = np.ascontiguousarray(mask)
    out = np.empty(mask.shape, dtype=bool)
    kernels.majority(mask.ctypes.data, shape_of(mask), out.ctypes.data)
    return out


def gaussian(grey: NDArray[np.float32], sigma: float | Array, truncate: float = 4.0) -> NDArray[np.float32]:
    """Smooth grey values [z, y, x] by a Gaussian, ``sigma`` voxels wide (along all axes, or z, y, x).

    They are mirrored at the border.
    """
    kernels = compiled()
    if kernels is None:
        from scipy.ndimage import gaussian_filter

        return np.asarray(gaussian_filter(grey, sigma, truncate=truncate))
    part = np.ascontiguousarray(grey, dtype=np.float32)
    for axis, width in enumerate(np.broadcast_to(np.asarray(sigma, dtype=float), 3).tolist()):
        radius = int(truncate * width + 0.5)
        if width <= 1e-15:
            continue
        place = np.arange(-radius, radius + 1)
        bell = np.exp(-0.5 / (width * width) * place**2)
        weights = np.ascontiguousarray((bell / bell.sum())[radius:])
        out = np.empty_like(part)
        given = (part.ctypes.data, shape_of(part), axis, radius, weights.ctypes.data)
        checked(kernels.smooth_axis(*given, out.ctypes.data))
        part = out
    return part.copy() if part is grey else part


def watershed(height: NDArray[np.float32], markers: NDArray[np.int32], mask: Mask) -> NDArray[np.int32]:
    """Give every voxel of a mask to the marker whose flood reaches it first from the high side.

    Parameters
    ----------
    height : ndarray of float32, [z, y, x]
    markers : ndarray of int32, [z, y, x]
        Positive numbers; 0 elsewhere.
    mask : ndarray of bool, [z, y, x]
    """
    kernels = compiled()
    if kernels is None:
        from skimage.segmentation import watershed as by_skimage

        return np.asarray(by_skimage(-height, markers, mask=mask), dtype=np.int32)
    height, mask = np.ascontiguousarray(height, dtype=np.float32), np.ascontiguousarray(mask)
    labels = np.array(markers, dtype=np.int32, order="C")
    checked(kernels.flooded(height.ctypes.data, mask.ctypes.data, shape_of(mask), labels.ctypes.data))
    return labels


def interpolated(grey: NDArray[np.float32], places: Array) -> Array:
    """Return grey values [z, y, x] at places (n, 3) by linear interpolation; the border's beyond it."""
    kernels = compiled()
    if kernels is None or grey.dtype != np.float32:
        from scipy.ndimage import map_coordinates

        return np.asarray(map_coordinates(grey, places.T, order=1, mode="nearest", output=float))
    grey = np.ascontiguousarray(grey)
    places = np.ascontiguousarray(places, dtype=float)
    out = np.empty(len(places))
    kernels.interpolated(grey.ctypes.data, shape_of(grey), places.ctypes.data, len(places), out.ctypes.data)
    return out

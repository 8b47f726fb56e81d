"""Part bones that touch in the image: erode to markers, then flood the grey values from them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ct_inertia.candidates import Piece, describe
from ct_inertia.distance import capped_distance

Array = NDArray[np.float64]

# From the narrowest gap that blur closes to the thickest neck that is still no crus.
DEPTHS_MM = (0.03, 0.045, 0.06, 0.08, 0.1)
_LEAST_DEPTH_VOXELS = 1.5
_LEAST_MARKER_MM3 = 0.004
_SMOOTH_VOXELS = 0.7


def flooded(
    grey: NDArray[np.float32], markers: NDArray[np.int32], mask: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Give every voxel of a mask to the marker whose flood reaches it first from the bright side.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    markers : ndarray of int32, [z, y, x]
        Positive numbers; 0 elsewhere.
    mask : ndarray of bool, [z, y, x]

    Notes
    -----
    Watershed of the negative grey values (Meyer's flooding): the border runs along the darkest line between
    two bodies, where each loses to the other as much of its blur as it gains.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter
    from skimage.segmentation import watershed

    result = np.where(mask, markers, 0).astype(np.int32)
    free = mask & (result == 0)
    index = np.nonzero(free)
    if len(index[0]) == 0:
        return result
    # Only markers that touch what is still free can flood it; the rest need not be looked at.
    box = tuple(slice(max(0, int(k.min()) - 3), int(k.max()) + 4) for k in index)
    active = binary_dilation(free[box], iterations=1) & mask[box]
    relief = gaussian_filter(grey[box], _SMOOTH_VOXELS)
    flood = watershed(-relief, np.where(active, result[box], 0), mask=active)
    part = result[box]
    part[free[box]] = flood[free[box]]
    return result


def separations(
    grey: NDArray[np.float32], bone: NDArray[np.bool_], spacing_mm: Array
) -> Iterator[tuple[float, NDArray[np.int32], NDArray[np.int32], list[Piece]]]:
    """Part bone at necks and closed gaps, from shallow to deep erosion.

    Yields
    ------
    depth_mm : float
        How deep was eroded.
    markers, labels : ndarray of int32, [z, y, x]
        What was left of each piece, and the pieces grown back over the bone.
    pieces : list of Piece
        From the largest to the smallest.
    """
    from scipy import ndimage

    voxel = float(np.prod(spacing_mm))
    least = _LEAST_DEPTH_VOXELS * float(np.mean(spacing_mm))
    deepest = max(DEPTHS_MM[-1], least)
    depth = capped_distance(~bone, spacing_mm, deepest + float(np.max(spacing_mm)))
    last = 0
    for wanted in DEPTHS_MM:
        limit = max(wanted, least) + 0.5 * float(np.mean(spacing_mm))
        markers, count = ndimage.label(depth > limit)
        sizes = np.bincount(markers.ravel())
        kept = sizes * voxel >= _LEAST_MARKER_MM3
        kept[0] = False
        if np.count_nonzero(kept) < 2 or count == last:
            continue
        last = count
        markers = np.where(kept[markers], markers, 0).astype(np.int32)
        labels = flooded(grey, markers, bone)
        boxes = ndimage.find_objects(labels)
        grown = np.bincount(labels.ravel())
        order = [int(k) for k in np.argsort(-grown[1:]) + 1 if grown[k] > 0]
        pieces = [describe(labels, k, boxes[k - 1], spacing_mm) for k in order]
        yield wanted, markers, labels, pieces

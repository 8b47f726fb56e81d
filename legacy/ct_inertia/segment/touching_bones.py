"""Separate bones that touch in the image: along narrow gaps, and across bridges over a gap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.segment.candidates import HALF_GAP_MM, Piece, describe
from legacy.ct_inertia.segment.necks import Neck
from legacy.ct_inertia.volume.distance import capped_distance, closed
from legacy.ct_inertia.volume.grid_operations import (
    boxes_and_sizes,
    dilated,
    gaussian,
    labelled,
    used_box,
    watershed,
)
from legacy.stapeskit.arrays import Array

# From a gap without bridges to bridges so wide that they meet half way round.
DEPTHS_MM = (0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35)
_LEAST_DEPTH_VOXELS = calibrated("separate.least_depth_voxels")
_LEAST_MARKER_MM3 = calibrated("separate.least_marker_mm3")
VALLEY = calibrated("separate.valley")
_HALF_VALLEY_MM = calibrated("separate.half_valley_mm")
_HALF_VALLEY_VOXELS = calibrated("separate.half_valley_voxels")
# Standard deviations of the smoothing against noise, in voxels, of the valleys and of the watershed's relief.
# Chosen by judgement: less than the blur of a scan, so that narrow gaps stay.
_CALM_VOXELS = 0.6
_SMOOTH_VOXELS = 0.7


def flood_from_markers(
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
    result = np.where(mask, markers, 0).astype(np.int32)
    free = mask & (result == 0)
    index = np.nonzero(free)
    if len(index[0]) == 0:
        return result
    # Only markers that touch what is still free can flood it; the rest need not be looked at.
    box = tuple(slice(max(0, int(k.min()) - 3), int(k.max()) + 4) for k in index)
    active = dilated(free[box]) & mask[box]
    relief = gaussian(grey[box], _SMOOTH_VOXELS)
    flood = watershed(relief, np.where(active, result[box], 0).astype(np.int32), active)
    part = result[box]
    part[free[box]] = flood[free[box]]
    return result


def narrow_gaps(share: NDArray[np.float32], bone: NDArray[np.bool_], spacing_mm: Array) -> NDArray[np.bool_]:
    """Return the narrow gaps between bones: what a closing by a ball fills.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
        Grey values as a share of the contrast between air and bone.
    bone : ndarray of bool, [z, y, x]
        Voxels above the level between air and bone.
    spacing_mm : ndarray, (3,)

    Notes
    -----
    Two levels are used: the middle one for gaps that are open in the image, a higher one for gaps of one
    or two voxels, which the blur fills.
    """
    valley = max(_HALF_VALLEY_MM, _HALF_VALLEY_VOXELS * float(np.mean(spacing_mm)))
    clear = gaussian(share, _CALM_VOXELS, truncate=3.0) > VALLEY
    return (closed(bone, spacing_mm, HALF_GAP_MM) & ~bone) | (closed(clear, spacing_mm, valley) & ~clear)


@dataclass(frozen=True)
class Separation:
    """One way to part the bone.

    Attributes
    ----------
    depth_mm : float
        How far from the narrow gaps the parts still hang together by themselves.
    labels : ndarray of int32, [z, y, x]
        The parts of the bone.
    sure : ndarray of bool, [z, y, x]
        Where they hold for certain: not along the gaps, where grey values decide.
    pieces : list of Piece
        From the largest to the smallest.
    neck : Neck or None
        The plane, when they were separated by one at a neck.
    cropped : bool
        The part beyond is bone that the border of the scan crops.
    doubtful : bool
        That may be the stapes' own.
    """

    depth_mm: float
    labels: NDArray[np.int32]
    sure: NDArray[np.bool_]
    pieces: list[Piece]
    neck: Neck | None = None
    cropped: bool = False
    doubtful: bool = False


def separate_bones(
    held: list[NDArray[np.float32]], bone: NDArray[np.bool_], spacing_mm: Array
) -> Iterator[Separation]:
    """Separate bone along its narrow gaps, from gaps without bridges to wide bridges.

    Parameters
    ----------
    held : list of one ndarray of float32, [z, y, x]
        Grey values as a share of the contrast; taken out of the list, so that their memory is freed early.
    bone : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)

    Notes
    -----
    A gap between two bones is a dark sheet, with holes where bone bridges it. The distance from the sheet
    grows into both bones and is least, across a bridge, on the surface that continues the sheet: its
    watershed parts the bones there. A crus, however thin, lies far from every narrow gap, so that it is
    not separated, which an erosion deep enough for the bridge would do.
    """
    gaps = narrow_gaps(held.pop(), bone, spacing_mm)
    box = used_box(bone)
    if box is None or not np.any(gaps):
        return
    voxel = float(np.prod(spacing_mm))
    least = _LEAST_DEPTH_VOXELS * float(np.mean(spacing_mm))
    depth = capped_distance(gaps, spacing_mm, DEPTHS_MM[-1] + least)
    del gaps
    labels: NDArray[np.int32] | None = None
    for wanted in DEPTHS_MM:
        markers, number = labelled(bone & (depth > max(wanted, least)))
        sizes = boxes_and_sizes(markers, number)[1]
        kept = sizes * voxel >= _LEAST_MARKER_MM3
        kept[0] = False
        count = int(np.count_nonzero(kept))
        markers = relabel(markers, np.where(kept, np.cumsum(kept), 0))
        if count < 2 or (labels is not None and _are_separate(labels, markers, count)):
            continue
        labels = np.zeros(bone.shape, dtype=np.int32)
        labels[box] = watershed(depth[box], markers[box], bone[box])
        del markers
        boxes, grown = boxes_and_sizes(labels, count)
        order = [int(k) for k in np.argsort(-grown[1:]) + 1 if grown[k] > 0]
        pieces = [describe(labels, k, boxes[k - 1] or (), spacing_mm) for k in order]
        yield Separation(wanted, labels, depth > least, pieces)


def relabel(labels: NDArray[np.int32], names: NDArray[np.integer]) -> NDArray[np.int32]:
    """Return labels [z, y, x] under other names (n,), layer by layer."""
    names = names.astype(np.int32)
    out = np.empty(labels.shape, dtype=np.int32)
    for layer, result in zip(labels, out, strict=True):
        np.take(names, layer, out=result)
    return out


def _are_separate(labels: NDArray[np.int32], markers: NDArray[np.int32], count: int) -> bool:
    """Return whether no two markers are in the same part."""
    marked = markers > 0
    pairs = np.unique(labels[marked].astype(np.int64) * (count + 1) + markers[marked])
    return bool(len(pairs) == count == len(np.unique(labels[labels > 0])))

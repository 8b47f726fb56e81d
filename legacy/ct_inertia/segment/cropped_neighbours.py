"""Cut off bone that the border of the scan crops and that joins the stapes, such as the tip of the incus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.segment.candidates import describe
from legacy.ct_inertia.segment.touching_bones import Separation
from legacy.ct_inertia.volume.grid_operations import boxes_and_sizes, dilated, eroded, gaussian, labelled
from legacy.stapeskit.arrays import Array

Share = NDArray[np.float32]
Mask = NDArray[np.bool_]

_WITHIN_MM = calibrated("cropped.within_mm")
_HALF_VALLEY_MM = calibrated("cropped.half_valley_mm")
_LEAST_VALLEY = calibrated("cropped.least_valley")
_NARROWER = calibrated("necks.narrower")
_GROWN = calibrated("necks.grown")
_STALK_MM = calibrated("cropped.stalk_mm")
_STALK_WIDENS = calibrated("cropped.stalk_widens")
# Powers of the share of bone by which a section counts: a dark section first, then a narrow one.
_DARKEST, _NARROWEST = 12, 4
# Standard deviation of the smoothing against noise, in voxels.
_CALM_VOXELS = 0.7
# Share of a section that need not be a valley: two bones may touch in some place.
_REST = 0.2
# Smoothing of the grey values along a gap, in voxels: it leaves a quarter of their noise.
_SMOOTH_VOXELS = 1.2
# Flow through a face of solid bone: integers, as the greatest flow is found in.
_CAPACITY = 1000.0


@dataclass(frozen=True)
class _ScanEnd:
    """A face of a grid [z, y, x] at which the scan ends: across array axis ``axis``, at its last layer."""

    axis: int
    last: bool

    def inwards(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a view of an array whose first layer is the one at the end of the scan."""
        turned = np.moveaxis(array, self.axis, 0)
        return turned[::-1] if self.last else turned


def _scan_ends(begins: NDArray[np.bool_], ends: NDArray[np.bool_]) -> list[_ScanEnd]:
    """Return the faces of a grid where the scan begins and ends along x, y, z."""
    return [
        _ScanEnd(2 - k, last)
        for k in range(3)
        for last, there in ((False, begins[k]), (True, ends[k]))
        if there
    ]


def cropped_separation(
    share: Share, bone: Mask, spacing_mm: Array, begins: NDArray[np.bool_], ends: NDArray[np.bool_]
) -> Separation | None:
    """Split a body at its smallest section before the border of the scan; None where there is none.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
        Grey values as a share of the contrast.
    bone : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
    begins, ends : ndarray of bool, (3,)
        Whether the grid begins, and whether it ends, where the scan does, along x, y, z.

    Notes
    -----
    Of a cropped bone a slab of one voxel may be left, too little for a marker or for the widening beyond a
    neck that other bones show. Looked at along lines across the border, though, even a gap that blur fills is
    darker than bone on both sides of it: where most of the section is such a valley, two bones meet there. A
    section through solid bone that is narrower than the body where the scan ends may be that of a pedicle, of
    the stapes or of the incus: it is ``doubtful``.
    """
    reached = [end for end in _scan_ends(begins, ends) if np.any(end.inwards(bone)[0])]
    near, last = np.zeros(bone.shape, dtype=bool), np.zeros(bone.shape, dtype=bool)
    for end in reached:
        end.inwards(near)[: round(_WITHIN_MM / float(spacing_mm[2 - end.axis]))] = True
        end.inwards(last)[0] = end.inwards(bone)[0]
    if not reached or not np.any(bone & ~near):
        return None
    calm = np.maximum(gaussian(share, _CALM_VOXELS, truncate=3.0), 0.0)
    for power in _DARKEST, _NARROWEST:
        cut_off = _beyond_least_cut(calm**power, bone, near, last, spacing_mm)
        labels = bone.astype(np.int32) + cut_off.astype(np.int32)
        beyond, count = labelled(labels == 2)
        sheet = np.where(dilated(labels == 1), beyond, 0)
        valleys = [_valleys(share, sheet, spacing_mm, end) for end in reached]
        solid = [piece for piece in range(1, count + 1) if not _parts(valleys, piece)]
        if not solid:
            break
    ending = [np.count_nonzero(beyond[last] == piece) for piece in solid]
    narrower = [
        np.count_nonzero(sheet == piece) < _NARROWER * seen for piece, seen in zip(solid, ending, strict=True)
    ]
    if not all(narrower) and not any(_is_stalk(end.inwards(bone), spacing_mm, end) for end in reached):
        return None
    boxes, _ = boxes_and_sizes(labels, 2)
    parts = [describe(labels, k, boxes[k - 1] or (), spacing_mm) for k in (1, 2)]
    sure = eroded(labels == 1) | eroded(labels == 2) | last
    return Separation(0.0, labels, sure, parts, None, cropped=True, doubtful=bool(solid))


def _parts(valleys: list[tuple[NDArray[np.float32], NDArray[np.int32]]], piece: int) -> bool:
    """Return whether most of a sheet is a valley, seen across one of the ends."""
    depths = [depth[number == piece] for depth, number in valleys if piece in number]
    return max((float(np.quantile(depth, _REST)) for depth in depths), default=0.0) >= _LEAST_VALLEY


def _is_stalk(layers: Mask, spacing_mm: Array, end: _ScanEnd) -> bool:
    """Return whether a body reaches the end of the scan as a stalk, which no rounded end is.

    ``layers`` [k, ., .] from the end inwards.
    """
    along = float(spacing_mm[2 - end.axis])
    areas = layers[: round(_WITHIN_MM / along)].sum(axis=(1, 2))
    first = areas[: max(2, round(_STALK_MM / along)) + 1]
    return bool(first.max() < _GROWN * areas.max() and first[-1] <= _STALK_WIDENS * first[0])


def _beyond_least_cut(strength: Share, bone: Mask, near: Mask, last: Mask, spacing_mm: Array) -> Mask:
    """Return the bone [z, y, x] between ends of the scan (``last``) and the least cut before them.

    Notes
    -----
    A cut counts by its area times its ``strength``, a power of the share of bone; the least one is that of
    the greatest flow (Ford and Fulkerson 1956, doi:10.4153/CJM-1956-045-5) from bone that is not ``near`` the
    ends to the last voxels.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    number = np.full(bone.shape, -1, dtype=np.int32)
    number[bone & ~near], number[last] = 0, 1
    inside = bone & near & ~last
    count = int(np.count_nonzero(inside)) + 2
    number[inside] = np.arange(2, count)
    strength = np.clip(strength, 0.0, 1.0)
    rows, columns, weights = [], [], []
    for axis, spacing in enumerate(spacing_mm[::-1]):
        one, other = (np.moveaxis(number, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        weight, next_weight = (
            np.moveaxis(strength, axis, 0)[part] for part in (slice(None, -1), slice(1, None))
        )
        joined = (one >= 0) & (other >= 0) & (one != other) & (one + other > 1)
        area = _CAPACITY * float(np.prod(spacing_mm) / spacing / np.max(spacing_mm) ** 2)
        flow = (1 + area * np.minimum(weight, next_weight)[joined]).astype(np.int32)
        rows += [one[joined], other[joined]]
        columns += [other[joined], one[joined]]
        weights += [flow, flow]
    shape = (count, count)
    capacity = csr_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape)
    left = capacity - maximum_flow(capacity, 0, 1).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    own = np.zeros(count, dtype=bool)
    own[breadth_first_order(left, 0, return_predecessors=False)] = True
    return np.asarray(bone & ~own[np.maximum(number, 0)])


def _valleys(
    share: Share, sheet: NDArray[np.int32], spacing_mm: Array, end: _ScanEnd
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return how much darker voxels of sheets are than bone on both sides across an end, and their numbers.

    ``sheet`` [z, y, x] numbers them; those within some distance of the end are looked at.
    """
    along = float(spacing_mm[2 - end.axis])
    reach = max(2, round(_HALF_VALLEY_MM / along))
    layers = round(_WITHIN_MM / along) + reach
    width = np.array([0.0, _SMOOTH_VOXELS, _SMOOTH_VOXELS])
    calm = gaussian(np.ascontiguousarray(end.inwards(share)[:layers]), width, truncate=3.0)
    number = end.inwards(sheet)[:layers]
    outer, inner = (_highest_within(calm, reach, back) for back in (True, False))
    inside = number > 0
    return (np.minimum(outer, inner) - calm)[inside], number[inside]


def _highest_within(layers: NDArray[np.float32], reach: int, back: bool) -> NDArray[np.float32]:
    """Return the highest of so many layers before (``back``) or after each one; 0 where there are none."""
    highest = np.zeros_like(layers)
    for k in range(1, min(reach, len(layers) - 1) + 1):
        if back:
            np.maximum(highest[k:], layers[:-k], out=highest[k:])
        else:
            np.maximum(highest[:-k], layers[k:], out=highest[:-k])
    return highest

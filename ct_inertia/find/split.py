"""Split one piece of bone where bones touch: along narrow gaps, across bridges over them, and at necks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Box, Grey, Index, Mask, Separation
from ct_inertia.calibrated import calibrated
from ct_inertia.find.box import from_coarse, read_box
from ct_inertia.find.distance import capped_distance, closed, used_box
from ct_inertia.find.necks import Neck, find_necks
from ct_inertia.find.overview import Overview, smooth_noise
from ct_inertia.find.pieces import (
    HALF_GAP_MM,
    MOST_SURROUNDED,
    USUAL_MM3,
    Piece,
    classify,
    describe,
    describe_all,
)
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array

DEPTHS_MM = (0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35)
"""From a gap without bridges to bridges so wide that they meet half way round."""

_FEW_DEPTHS = 3  # for a body that is a whole stapes but for its size: a gap without bridges, and narrow ones
_FINER_MM = calibrated("split.finer_mm")
_COARSEST_MM = 0.045  # grid on which a gap of 65 um is still seen
_MOST_VOXELS = 12_000_000  # of a grid: 50 MB, and some seconds of watersheds
_MARGIN = (0.1, 3)  # mm and voxels around the bones: their blur
_VALLEY = calibrated("split.valley")
_HALF_VALLEY_MM, _HALF_VALLEY_VOXELS = calibrated("split.half_valley")
_LEAST_MARKER_MM3 = calibrated("split.least_marker_mm3")
_LEAST_DEPTH_VOXELS = calibrated("split.least_depth_voxels")
_CALM_VOXELS = 0.6  # smoothing of the valleys against noise: less than the blur of a scan, so that gaps stay
_WHOLE = 0.99  # share of a union that hangs together
_LEAST_UNITED_MM3, _MOST_UNITED = 0.05, 7  # parts that are put together by twos and threes: 56 trials
_NECK_SCORE = -50.0  # size score from which a part is looked at for necks: for time only


@dataclass(frozen=True)
class Split:
    """One way to split a piece of bone.

    Attributes
    ----------
    grid : Box
        The finer grid of ``labels``.
    labels : ndarray of int32, [z, y, x]
        The parts.
    sure : ndarray of bool, [z, y, x]
        Where they hold for certain: not along the gaps, where grey values decide.
    parts : tuple of Piece
        From the largest to the smallest, in voxels of the grid.
    depth_mm : float
        How far from the narrow gaps the parts still hang together by themselves.
    neck : Neck or None
        The plane, in mm from voxel 0, 0, 0 of the grid along its axes.
    at_border : bool
        What was cut off reaches the border of the scan.
    """

    grid: Box
    labels: NDArray[np.int32]
    sure: Mask
    parts: tuple[Piece, ...]
    depth_mm: float
    neck: Neck | None = None
    at_border: bool = False

    def separation(self) -> Separation:
        """Return how the parts were separated."""
        if self.neck is None:
            method = f"split along narrow gaps, across bridges up to {2e3 * self.depth_mm:.0f} um"
            return Separation(method, bridge_mm=self.depth_mm)
        axes = self.grid.scan_from_index[:3, :3] / self.grid.spacing_mm
        normal = axes @ self.neck.normal
        height = self.neck.height_mm + float(normal @ self.grid.scan_from_index[:3, 3])
        method = f"cut at the neck of least cross-section ({self.neck.area_mm2:.2f} mm2) near an end"
        return Separation(method, normal, height, self.neck.area_mm2, cropped=self.at_border)

    def centre_mm(self, piece: Piece) -> Array:
        """Return the middle of a part, scan coordinates."""
        return self.grid.scan_points(piece.centre[None])[0]


def splits(
    scan: Scan,
    overview: Overview,
    pieces: NDArray[np.int32],
    whole: Piece,
    reading: tuple[float, float, float],
    around_mm: Array | None = None,
) -> Iterator[Split]:
    """Split one piece of the first look, on a finer grid, in every way that gaps and necks suggest.

    Parameters
    ----------
    scan : Scan
    overview : Overview
    pieces : ndarray of int32, [z, y, x]
        Pieces in coarse voxels.
    whole : Piece
        One of them.
    reading : (air, bone, between)
        Grey levels, and the one above which a voxel is bone.
    around_mm : ndarray, (3,), optional
        A point in scan coordinates: only what lies within 4 mm of it is looked at.

    Yields
    ------
    Split
        Nothing where the piece is too large for a grid on which gaps are seen.
    """
    low, high = whole.low * overview.step, np.minimum(whole.high * overview.step, scan.size)
    if around_mm is not None:
        middle, reach = scan.index_points(around_mm), 4.0 / scan.spacing_mm
        low = np.maximum(low, np.floor(middle - reach)).astype(np.int64)
        high = np.minimum(high, np.ceil(middle + reach)).astype(np.int64)
    size_mm = (high - low) * scan.spacing_mm + 2.0 * _MARGIN[0]
    edge = max(_FINER_MM, float(np.prod(size_mm) / _MOST_VOXELS) ** (1.0 / 3.0))
    if edge > _COARSEST_MM:
        return
    grid = read_box(scan, low, high, edge, margin=_MARGIN)
    air, bone, between = reading
    noise = overview.noise / float(np.sqrt(np.prod(grid.block)))
    grey = smooth_noise(grid.grey, noise / (bone - air))
    share = (grey - np.float32(air)) / np.float32(bone - air)
    solid = _of_the_whole(grey > np.float32(between), grid, pieces, whole, overview.step)
    if whole.arched and whole.surrounds < MOST_SURROUNDED:
        yield from _at_necks(grid, solid)
    complete = whole.possible and whole.empty_arch and not whole.at_border
    for way in _at_gaps(grid, share, solid, DEPTHS_MM[:_FEW_DEPTHS] if complete else DEPTHS_MM):
        yield way
        if not any(part.usual and part.arched for part in way.parts):
            yield from _united(way)
            yield from _necks_of_parts(way)


def _of_the_whole(bone: Mask, grid: Box, pieces: NDArray[np.int32], whole: Piece, step: Index) -> Mask:
    """Leave out bone of other pieces that reaches into the box: its cut ends are nobody's shape."""
    import cc3d

    first = step // 2
    coarse = from_coarse(grid, pieces, first, step)
    labels = cc3d.connected_components(bone, connectivity=6)
    count = int(labels.max()) + 1
    own = np.bincount(labels[bone & (coarse == whole.label)], minlength=count)
    other = np.bincount(labels[bone & (coarse != 0) & (coarse != whole.label)], minlength=count)
    kept = own > other
    kept[0] = False
    return np.asarray(kept[labels])


def _narrow_gaps(share: Grey, bone: Mask, spacing_mm: Array) -> Mask:
    """Return the narrow gaps between bones: what a closing by a ball fills.

    Two levels are used: the middle one for gaps that are open in the image, a higher one for gaps of one or
    two voxels, which the blur fills.
    """
    from ct_inertia.grey.fields import smooth

    valley = max(_HALF_VALLEY_MM, _HALF_VALLEY_VOXELS * float(np.mean(spacing_mm)))
    clear = smooth(share, np.full(3, _CALM_VOXELS)) > np.float32(_VALLEY)
    open_gaps = closed(bone, spacing_mm, HALF_GAP_MM) & ~bone
    return np.asarray(open_gaps | (closed(clear, spacing_mm, valley) & ~clear))


def _at_gaps(grid: Box, share: Grey, bone: Mask, depths_mm: tuple[float, ...]) -> Iterator[Split]:
    """Split bone along its narrow gaps, from gaps without bridges to wide bridges.

    Notes
    -----
    A gap between two bones is a dark sheet, with holes where bone bridges it. The distance from the sheet
    grows into both bones and is least, across a bridge, on the surface that continues the sheet: its
    watershed splits the bones there. A crus, however thin, lies far from every narrow gap, so that it is not
    cut, which an erosion deep enough for the bridge would do.
    """
    import cc3d
    from skimage.segmentation import watershed

    from ct_inertia.grey.start import grown

    spacing = grid.spacing_mm
    gaps = _narrow_gaps(share, bone, spacing)
    used = used_box(bone)
    if used is None or not gaps.any():
        return
    voxel = grid.voxel_mm3
    least = _LEAST_DEPTH_VOXELS * float(np.mean(spacing))
    depth = capped_distance(gaps, spacing, DEPTHS_MM[-1] + least)
    before: NDArray[np.int32] | None = None
    for wanted in depths_mm:
        pieces = cc3d.connected_components(bone & (depth > np.float32(max(wanted, least))), connectivity=6)
        sizes = np.bincount(pieces.ravel())
        kept = sizes * voxel >= _LEAST_MARKER_MM3
        kept[0] = False
        count = int(np.count_nonzero(kept))
        markers = np.where(kept, np.cumsum(kept), 0).astype(np.int32)[pieces]
        if count < 2 or (before is not None and _already_apart(before, markers, count)):
            continue
        labels = markers.copy()
        free = bone[used] & (markers[used] == 0)
        # Only markers that touch what is still free can flood it.
        active = bone[used] & grown(free)
        flooded = watershed(-depth[used], np.where(active, markers[used], 0), mask=active)
        labels[used][free] = flooded[free]
        before = labels
        yield _counted(Split(grid, labels, depth > np.float32(least), (), wanted))


def _already_apart(labels: NDArray[np.int32], markers: NDArray[np.int32], count: int) -> bool:
    """Return whether no two markers are in the same part."""
    marked = markers > 0
    pairs = np.unique(labels[marked].astype(np.int64) * (count + 1) + markers[marked])
    return bool(len(pairs) == count == len(np.unique(labels[labels > 0])))


def _counted(way: Split) -> Split:
    """Describe the parts of a split, and count the holes of those that can be a stapes."""
    parts = describe_all(way.labels, way.grid.spacing_mm)
    parts = [classify(way.labels, part, way.grid.spacing_mm) if part.possible else part for part in parts]
    return replace(way, parts=tuple(_border(way.grid, part) for part in parts))


def _border(grid: Box, part: Piece) -> Piece:
    """Correct the border flag: the scan may go on beyond the grid."""
    size = np.array(grid.shape[::-1])
    cut = np.any((part.low == 0) & grid.begins) or np.any((part.high == size) & grid.ends)
    return replace(part, at_border=bool(cut))


def _at_necks(grid: Box, bone: Mask) -> Iterator[Split]:
    """Cut bone by a plane at each of its necks, where what is left can be a stapes."""
    points = np.argwhere(bone)[:, ::-1] * grid.spacing_mm
    z, y, x = (np.arange(n) * edge for n, edge in zip(bone.shape, grid.spacing_mm[::-1], strict=True))
    for neck in find_necks(points, grid.spacing_mm):
        normal = neck.normal
        beyond = (normal[2] * z)[:, None, None] + (normal[1] * y)[:, None] + normal[0] * x > neck.height_mm
        labels = bone.astype(np.int32)
        labels[bone & beyond] = 2
        boxes = [used_box(labels == k) for k in (1, 2)]
        if boxes[0] is None or boxes[1] is None:
            continue
        left, cut = (
            _border(grid, describe(labels, k, box, grid.spacing_mm))
            for k, box in enumerate(boxes, 1)
            if box is not None
        )
        if left.usual:
            left = classify(labels, left, grid.spacing_mm, others=False)
            yield Split(grid, labels, bone, (left, cut), 0.0, neck, cut.at_border)


def _necks_of_parts(way: Split) -> Iterator[Split]:
    """Cut the parts of a split that have one hole, the likeliest stapes first, at their necks."""
    some = [part for part in way.parts if part.possible and part.empty_arch and part.size_score > _NECK_SCORE]
    for piece in sorted(some, key=lambda part: -part.size_score):
        name = int(way.labels.max()) + 1
        for cut in _at_necks(way.grid, way.labels == piece.label):
            labels = np.where(cut.labels == 2, np.int32(name), way.labels)
            ends = [replace(part, label=k) for part, k in zip(cut.parts, (piece.label, name), strict=True)]
            rest = [part for part in way.parts if part.label != piece.label]
            yield Split(way.grid, labels, way.sure, (*ends, *rest), way.depth_mm, cut.neck, cut.at_border)


def _united(way: Split) -> Iterator[Split]:
    """Put two or three parts together where that makes a stapes: depths for wide bridges may split it."""
    import cc3d

    parts = [part for part in way.parts if part.volume_mm3 > _LEAST_UNITED_MM3][:_MOST_UNITED]
    for some in (*combinations(parts, 2), *combinations(parts, 3)):
        if not USUAL_MM3[0] <= sum(part.volume_mm3 for part in some) <= USUAL_MM3[1]:
            continue
        low, high = np.min([part.low for part in some], axis=0), np.max([part.high for part in some], axis=0)
        box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        mask = np.isin(way.labels[box], [part.label for part in some])
        pieces = np.bincount(cc3d.connected_components(mask, connectivity=6)[mask])
        if pieces.max() < _WHOLE * pieces.sum():
            continue
        labels = way.labels.copy()
        labels[box][mask] = some[0].label
        piece = _border(way.grid, describe(labels, some[0].label, box, way.grid.spacing_mm))
        if piece.usual:
            piece = classify(labels, piece, way.grid.spacing_mm)
            if piece.empty_arch:
                rest = [part for part in way.parts if all(part is not one for one in some)]
                yield replace(way, labels=labels, parts=(piece, *rest))

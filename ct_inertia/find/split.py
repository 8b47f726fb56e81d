"""Split one piece of bone where bones touch: along narrow gaps, across bridges over them, and at necks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.find.box import block_for, read_box
from ct_inertia.find.levels import Reading
from ct_inertia.find.necks import Neck, find_necks
from ct_inertia.find.overview import Overview, smooth_noise
from ct_inertia.find.pieces import HALF_GAP_MM, Labels, Piece, describe_all
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.distance import capped_distance, closed
from ct_inertia.voxels.fields import Grey, smooth
from ct_inertia.voxels.flood import flood
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import Mask
from stapeskit.arrays import Array

DEPTHS_MM = (0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35)
"""From a gap without bridges to bridges so wide that they meet half way round."""

_FEW_DEPTHS = 3  # for a body that is a whole stapes but for its size: a gap without bridges, and narrow ones
_REACH_MM = 4.0  # from a point that is known to be in the stapes to its other end
_FINER_MM = 0.025  # grid on which bones are split where memory allows it: half of the narrowest gap
_COARSEST_MM = 0.045  # grid on which a gap of 65 um is still seen
_MOST_VOXELS = 12_000_000  # of a grid: 50 MB, and some seconds of watersheds
_MARGIN = (0.1, 3)  # mm and voxels around the bones: their blur
_VALLEY = calibrated("split.valley")
_HALF_VALLEY_MM, _HALF_VALLEY_VOXELS = calibrated("split.half_valley")
_LEAST_MARKER_MM3 = calibrated("split.least_marker_mm3")
_LEAST_DEPTH_VOXELS = calibrated("split.least_depth_voxels")
_CALM_VOXELS = 0.6  # smoothing of the valleys against noise: less than the blur of a scan, so that gaps stay
_NECK_SCORE = -50.0  # size score from which a part is looked at for necks: for time only


@dataclass(frozen=True, eq=False)
class Split:
    """One way to split a piece of bone.

    Attributes
    ----------
    grid : Grid
        The finer grid of ``labels``.
    labels : ndarray of uint8 or uint16, [z, y, x]
        The parts.
    sure : ndarray of bool, [z, y, x]
        Where they hold for certain: not along the gaps, where grey values decide.
    parts : tuple of Piece
        From the largest to the smallest; the two sides of a neck first.
    depth_mm : float
        How far from the narrow gaps the parts still hang together by themselves.
    neck : Neck or None
        The plane, in mm from voxel 0, 0, 0 of the grid along its axes.
    """

    grid: Grid
    labels: Labels
    sure: Mask
    parts: tuple[Piece, ...]
    depth_mm: float
    neck: Neck | None = None

    @property
    def cropped(self) -> bool:
        """What was cut off at a neck reaches the border of the scan."""
        return self.neck is not None and self.parts[1].at_border

    def __str__(self) -> str:
        if self.neck is None:
            return f"split along narrow gaps, across bridges up to {2e3 * self.depth_mm:.0f} um"
        return f"cut at the neck of least cross-section ({self.neck.area_mm2:.2f} mm2) near an end"


def splits(
    scan: Scan, overview: Overview, whole: Piece, reading: Reading, around_mm: Array | None = None
) -> Iterator[Split]:
    """Split one piece of the first look, on a finer grid, in every way that necks and gaps suggest.
    Necks of the whole come first; nothing where it is too large for a grid on which gaps are seen. Only what
    lies within 4 mm of ``around_mm`` (3,), a point in scan coordinates, is looked at.
    """
    low, high = whole.voxels
    if around_mm is not None:
        middle, reach = scan.index_points(around_mm), _REACH_MM / scan.spacing_mm
        low = np.maximum(low, np.floor(middle - reach)).astype(np.int64)
        high = np.minimum(high, np.ceil(middle + reach)).astype(np.int64)
    size_mm = (high - low) * scan.spacing_mm + 2.0 * _MARGIN[0]
    edge = grid_edge(size_mm, scan.spacing_mm)
    if edge > _COARSEST_MM:
        return
    box = read_box(scan, low, np.minimum(high, scan.size), edge, margin=_MARGIN)
    noise = overview.noise / float(np.sqrt(np.prod(box.block))) / reading.contrast
    grey = smooth_noise(box.grey, noise)
    bone = _of_the_whole(grey > np.float32(reading.between), box, whole)
    share = (grey - np.float32(reading.air)) / np.float32(reading.contrast)
    grid = Grid.of(scan, box.shape, box.first, box.block)
    del box, grey  # ways that may be chosen later keep no grey values
    complete = whole.possible and whole.empty_arch
    if complete:
        labels = bone.astype(np.uint8)
        uncut = Split(grid, labels, bone, tuple(describe_all(labels, grid)[:1]), 0.0)
        yield from _at_necks(uncut, uncut.parts)
    few = complete and not whole.at_border
    gaps = _narrow_gaps(share, bone, grid.spacing_mm)
    del share
    for way in _at_gaps(grid, gaps, bone, DEPTHS_MM[:_FEW_DEPTHS] if few else DEPTHS_MM):
        yield way
        possible = [part for part in way.parts if part.possible]
        if not any(part.usual and part.arched for part in possible):
            likely = sorted(possible, key=lambda part: -part.size_score)
            yield from _at_necks(way, [p for p in likely if p.size_score > _NECK_SCORE and p.empty_arch])


def grid_edge(size_mm: Array, spacing_mm: Array) -> float:
    """Return the largest edge of the blocks of a grid: the finest that memory and time allow.

    Blocks are whole voxels and may be much smaller than their largest edge: where the grid then has too many
    of them, the next larger ones are taken, if gaps are still seen on them.
    """
    edge = max(_FINER_MM, float(np.prod(size_mm) / _MOST_VOXELS) ** (1.0 / 3.0))
    for coarser in np.arange(edge, _COARSEST_MM, 0.001):
        if np.prod(size_mm / (block_for(spacing_mm, float(coarser)) * spacing_mm)) <= 2.0 * _MOST_VOXELS:
            return float(coarser)
    return edge


def _of_the_whole(bone: Mask, grid: Grid, whole: Piece) -> Mask:
    """Leave out bone of other pieces that reaches into the box: its cut ends are nobody's shape."""
    import cc3d

    coarse = grid.taken(whole.labels, whole.grid)
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
    valley = max(_HALF_VALLEY_MM, _HALF_VALLEY_VOXELS * float(np.mean(spacing_mm)))
    clear = smooth(share, np.full(3, _CALM_VOXELS)) > np.float32(_VALLEY)
    open_gaps = closed(bone, spacing_mm, HALF_GAP_MM) & ~bone
    return np.asarray(open_gaps | (closed(clear, spacing_mm, valley) & ~clear))


def _at_gaps(grid: Grid, gaps: Mask, bone: Mask, depths_mm: tuple[float, ...]) -> Iterator[Split]:
    """Split bone along its narrow gaps, from gaps without bridges to wide bridges.

    Notes
    -----
    A gap between two bones is a dark sheet, with holes where bone bridges it. The distance from the sheet
    grows into both bones and is least, across a bridge, on the surface that continues the sheet: its
    watershed splits the bones there. A crus, however thin, lies far from every narrow gap, so that it is not
    cut, which an erosion deep enough for the bridge would do.
    """
    import cc3d

    if not gaps.any():
        return
    least = _LEAST_DEPTH_VOXELS * float(np.mean(grid.spacing_mm))
    relief = -capped_distance(gaps, grid.spacing_mm, DEPTHS_MM[-1] + least)
    sure = relief < np.float32(-least)
    labels: Labels | None = None
    for wanted in depths_mm:
        pieces = cc3d.connected_components(bone & (relief < np.float32(-max(wanted, least))), connectivity=6)
        kept = np.bincount(pieces.ravel()) * grid.voxel_mm3 >= _LEAST_MARKER_MM3
        kept[0] = False
        count = int(np.count_nonzero(kept))
        markers = np.where(kept, np.cumsum(kept), 0).astype(np.min_scalar_type(count + 1))[pieces]
        del pieces
        if count < 2 or (labels is not None and _same_parts(labels, markers)):
            continue
        labels = flood(relief, markers, bone)
        yield Split(grid, labels, sure, tuple(describe_all(labels, grid)), wanted)


def _same_parts(labels: Labels, markers: Labels) -> bool:
    """Return whether each part holds one marker, so that a flood from the markers gives the same parts."""
    marked = markers > 0
    pairs = np.unique(labels[marked].astype(np.int64) * (int(markers.max()) + 1) + markers[marked])
    return bool(len(pairs) == markers.max() == len(np.unique(labels[labels > 0])))


def _at_necks(way: Split, pieces: Sequence[Piece]) -> Iterator[Split]:
    """Cut pieces of a split by a plane at each of their necks, where what is left can be a stapes."""
    spacing = way.grid.spacing_mm
    z, y, x = (np.arange(n) * edge for n, edge in zip(way.labels.shape, spacing[::-1], strict=True))
    for piece in pieces:
        rest = tuple(part for part in way.parts if part is not piece)
        own, beyond = way.labels == piece.label, int(way.labels.max()) + 1
        for neck in find_necks(np.argwhere(own)[:, ::-1] * spacing, spacing):
            height = (neck.normal[2] * z)[:, None, None] + (neck.normal[1] * y)[:, None] + neck.normal[0] * x
            labels = np.where(own & (height > neck.height_mm), beyond, way.labels)
            ends = {part.label: part for part in describe_all(labels, way.grid, (piece.label, beyond))}
            if len(ends) == 2 and ends[piece.label].usual:
                parts = (ends[piece.label], ends[beyond], *rest)
                yield Split(way.grid, labels, way.sure, parts, way.depth_mm, neck)

"""Connected pieces of bone, their measures, and how well they fit what is published of the stapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.voxels.distance import closed
from ct_inertia.voxels.grid import Grid, Index
from ct_inertia.voxels.masks import Mask, Slices, starts, used_box
from stapeskit.arrays import Array

Labels = NDArray[np.integer[Any]]

USUAL_MM3 = calibrated("stapes.volume_mm3")
_EXTENTS_MM = calibrated("stapes.extents_mm")
POSSIBLE_MM3, POSSIBLE_MM = calibrated("stapes.possible_mm3"), calibrated("stapes.possible_mm")
MOST_SURROUNDED = calibrated("stapes.most_surrounded")
HALF_GAP_MM = calibrated("split.half_gap_mm")
_PERFORATION_MM = calibrated("stapes.perforation_mm")
_LEAST_MM3 = 0.02  # of a piece that is described: a fortieth of a small stapes, for time only
_MOST_HOLES = 8  # of a perforated footplate; bone full of pores has more
_HULL_POINTS = 4000  # voxels that are sought in a hull, for time
_SPREAD = 0.1  # relative standard deviation of a length of stapedes, of a volume thrice as much
_NO_ARCH, _BORDER, _SURROUNDING = 6.0, 4.0, 6.0  # of the log-likelihood: one stapes in 400, in 50, in 400
USUAL = 0.5
"""Log-likelihood by which size and shape may fall behind the most usual stapes."""
RIVAL = 1.0
"""Log-likelihood below which two bodies count as equally likely: a ratio of 2.7."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A connected piece of bone; what costs time is measured when it is asked for.

    Attributes
    ----------
    label : int
        Its number in ``labels``.
    labels : ndarray of int, [z, y, x]
        All pieces of the picture or of a split.
    box : tuple of 3 slice
        Where it lies, z, y, x.
    extents_mm : ndarray, (3,)
        Along its principal axes, longest first.
    centre_mm : ndarray, (3,)
        Its middle, scan coordinates.
    """

    label: int
    labels: Labels
    grid: Grid
    box: Slices
    volume_mm3: float
    extents_mm: Array
    centre_mm: Array

    @property
    def inside(self) -> Mask:
        """Its mask in its box."""
        return np.asarray(self.labels[self.box] == self.label)

    @property
    def voxels(self) -> tuple[Index, Index]:
        """First voxel x, y, z of the scan in its box, and one past the last."""
        low, high = starts(self.box), np.array([part.stop for part in self.box[::-1]], dtype=np.int64)
        block = self.grid.block
        return self.grid.first + low * block, self.grid.first + high * block

    @property
    def at_border(self) -> bool:
        """It reaches the first or last blocks of the scan."""
        low, high = starts(self.box), np.array([part.stop for part in self.box[::-1]])
        return bool(
            np.any((low == 0) & self.grid.begins) or np.any((high == self.grid.size) & self.grid.ends)
        )

    @property
    def length_mm(self) -> float:
        """Longest extent."""
        return float(self.extents_mm[0])

    @cached_property
    def holes(self) -> int:
        """Tunnels through it: one in a stapes."""
        return count_holes(self.inside)

    @cached_property
    def arched(self) -> bool:
        """It has one hole as a stapes has it, be its footplate perforated or not.

        A hole through the footplate is narrower than the one between the crura, and a closing by a ball fills
        it alone. What bridges the gap to another bone makes a hole too, but no wider than such gaps.
        """
        if not (2 <= self.holes <= _MOST_HOLES and self.size_score > -USUAL):
            return self.holes == 1
        spacing = self.grid.spacing_mm
        padded = np.pad(self.inside, int(np.ceil(_PERFORATION_MM / float(np.min(spacing)))) + 1)
        wide, narrow = (count_holes(closed(padded, spacing, r)) for r in (_PERFORATION_MM, HALF_GAP_MM))
        return wide == 1 and narrow > 1

    @cached_property
    def surrounding(self) -> bool:
        """It has other bone within its convex hull, as the bone around a stapes has."""
        return self.arched and _surrounded(self) >= MOST_SURROUNDED

    @property
    def empty_arch(self) -> bool:
        """It has one hole, and no other bone within its hull."""
        return self.arched and not self.surrounding

    @property
    def possible(self) -> bool:
        """It has a volume and a length that a stapes can have."""
        volume, length = self.volume_mm3, self.length_mm
        return POSSIBLE_MM3[0] <= volume <= POSSIBLE_MM3[1] and POSSIBLE_MM[0] <= length <= POSSIBLE_MM[1]

    @property
    def size_score(self) -> float:
        """Log-likelihood of its volume and extents."""
        return size_score(self.volume_mm3, self.extents_mm)

    @property
    def usual(self) -> bool:
        """Its size and shape are usual for a stapes, and it surrounds no other bone."""
        return self.possible and self.size_score > -USUAL and not self.surrounding

    @property
    def whole_stapes(self) -> bool:
        """It is usual in every respect, and whole in the scan."""
        return self.usual and self.arched and not self.at_border

    @property
    def score(self) -> float:
        """Log-likelihood of being the stapes: size, one empty hole, whole within the scan."""
        penalty = _BORDER * self.at_border + _NO_ARCH * (not self.arched)
        return self.size_score - penalty - _SURROUNDING * self.surrounding


def size_score(volume_mm3: float, extents_mm: Array) -> float:
    """Return the log-likelihood of a volume and extents (3,): 0 within the published ranges, less beyond."""
    lengths = [volume_mm3 ** (1.0 / 3.0), *extents_mm]
    ranges = [[v ** (1.0 / 3.0) for v in USUAL_MM3], *_EXTENTS_MM]
    away = [max(0.0, np.log(a / v), np.log(v / b)) for v, (a, b) in zip(lengths, ranges, strict=True)]
    return -0.5 * float(np.sum(np.square(np.array(away) / _SPREAD)))


def label_pieces(mask: Mask, grid: Grid) -> list[Piece]:
    """Return the connected pieces (faces touching) of a mask [z, y, x] that are worth a look.

    From the largest to the smallest, nothing below 0.02 mm3.
    """
    import cc3d

    labels = np.zeros(mask.shape, dtype=np.int32)
    box = used_box(mask)
    if box is not None:
        labels[box] = cc3d.connected_components(mask[box], connectivity=6, out_dtype=np.uint32)
    return describe_all(labels, grid)


def describe_all(labels: Labels, grid: Grid, wanted: Sequence[int] | None = None) -> list[Piece]:
    """Describe the pieces of labels [z, y, x] that are worth a look, from the largest to the smallest.

    ``wanted``: their numbers, if not all are.
    """
    import cc3d

    found = cc3d.statistics(labels, no_slice_conversion=True)
    count, boxes = found["voxel_counts"].astype(np.int64), found["bounding_boxes"].astype(int)
    count[0] = 0
    worth = np.flatnonzero(count * grid.voxel_mm3 >= _LEAST_MM3)
    order = [int(k) for k in worth[np.argsort(-count[worth])] if wanted is None or k in wanted]
    return [_describe(labels, k, boxes[k], grid) for k in order]


def _describe(labels: Labels, label: int, ends: NDArray[np.int_], grid: Grid) -> Piece:
    z, y, x = (slice(int(first), int(last) + 1) for first, last in ends.reshape(3, 2))
    box = (z, y, x)
    inside = labels[box] == label
    place = np.flatnonzero(inside)
    some = place[:: max(1, place.size // 100_000)]
    index = np.stack(np.unravel_index(some, inside.shape)[::-1], axis=1)
    points = index * grid.spacing_mm
    vectors = np.linalg.eigh(np.cov(points.T) if len(points) > 3 else np.eye(3))[1]
    extents = np.sort(np.ptp(points @ vectors, axis=0) + grid.spacing_mm.mean())[::-1]
    centre = grid.scan_points((index.mean(axis=0) + starts(box))[None])[0]
    return Piece(label, labels, grid, box, place.size * grid.voxel_mm3, extents, centre)


def count_holes(inside: Mask) -> int:
    """Return how many tunnels go through the largest piece of a solid [z, y, x].

    Notes
    -----
    Euler characteristic = 1 - tunnels + cavities. A pinhole of noise must not count as a tunnel, so the solid
    is smoothed by a majority vote of 27 voxels first. Voxels that touch in a corner hang together.
    """
    import cc3d

    votes = np.pad(inside, 3).astype(np.uint8)
    for axis in range(3):
        side = np.moveaxis(votes, axis, 0)
        votes = np.moveaxis(side[:-2] + side[1:-1] + side[2:], 0, axis)
    smooth = np.ascontiguousarray(votes > 13)
    labels, count = cc3d.connected_components(smooth, connectivity=26, return_N=True)
    if count == 0:
        return 0
    smooth = labels == int(np.argmax(np.bincount(labels[smooth])))
    cavities = cc3d.connected_components(~smooth, connectivity=6, return_N=True)[1] - 1
    return 1 + cavities - _euler_number(smooth)


def _euler_number(solid: Mask) -> int:
    """Return corners - edges + faces - voxels of a solid [z, y, x] of closed cubes, off its border."""
    total = 0
    for axes in product((False, True), repeat=3):
        cells = solid
        for axis in np.flatnonzero(axes):
            along = np.moveaxis(cells, axis, 0)
            cells = np.moveaxis(along[1:] | along[:-1], 0, axis)
        total -= (-1) ** sum(axes) * int(np.count_nonzero(cells))
    return total


def _surrounded(piece: Piece) -> float:
    """Return the volume of other pieces inside a piece's convex hull, divided by the volume of the piece.

    The hull is that of some of its voxels.
    """
    from scipy.spatial import ConvexHull

    part = piece.labels[piece.box][::2, ::2, ::2]
    own, other = np.argwhere(part == piece.label), np.argwhere((part > 0) & (part != piece.label))
    if len(other) == 0 or len(own) < 50 or np.linalg.matrix_rank(np.cov(own.T)) < 3:
        return 0.0
    every = max(1, len(other) // _HULL_POINTS)
    sides = ConvexHull(own[:: max(1, len(own) // (4 * _HULL_POINTS))]).equations
    inside = np.all(other[::every] @ sides[:, :3].T <= -sides[:, 3], axis=1)
    return float(np.count_nonzero(inside) * every / len(own))

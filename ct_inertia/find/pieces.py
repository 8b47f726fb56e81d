"""Connected pieces of bone, their measures, and how well they fit what is published of the stapes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Index, Mask
from ct_inertia.calibrated import calibrated
from ct_inertia.find.distance import closed, used_box
from stapeskit.arrays import Array

Labels = NDArray[np.integer]

USUAL_MM3 = calibrated("stapes.volume_mm3")
_EXTENTS_MM = calibrated("stapes.extents_mm")
POSSIBLE_MM3, POSSIBLE_MM = calibrated("stapes.possible_mm3"), calibrated("stapes.possible_mm")
MOST_SURROUNDED = calibrated("stapes.most_surrounded")
HALF_GAP_MM = calibrated("split.half_gap_mm")
_PERFORATION_MM = calibrated("stapes.perforation_mm")
_LEAST_MM3 = 0.02  # of a piece that is described: a fortieth of a small stapes, for time only
_MOST_HOLES = 8  # of a perforated footplate; bone full of pores has more
_HULL_POINTS = 4000  # voxels of a piece for its convex hull, whose time grows with them
_SPREAD = 0.1  # relative standard deviation of a length of stapedes, of a volume thrice as much
_NO_ARCH, _BORDER, _SURROUNDING = 6.0, 4.0, 6.0  # of the log-likelihood: one stapes in 400, in 50, in 400
USUAL = 0.5
"""Log-likelihood by which size and shape may fall behind the most usual stapes."""
RIVAL = 1.0
"""Log-likelihood below which two bodies count as equally likely: a ratio of 2.7."""


@dataclass(frozen=True)
class Piece:
    """A connected piece of bone.

    Attributes
    ----------
    label : int
        Its number in the labelled array.
    low, high : ndarray of int, (3,)
        Its box in indices x, y, z: first, and one past the last.
    volume_mm3 : float
    extents_mm : ndarray, (3,)
        Along its principal axes, longest first.
    centre : ndarray, (3,)
        Mean index x, y, z.
    at_border : bool
        It reaches the first or last voxel of the scan.
    holes : int or None
        Tunnels through it (1 in a stapes), where counted.
    perforated : bool
        One hole is as wide as that between the crura, others are narrower and yet wider than gaps between
        bones.
    surrounds : float
        Volume of other bone within its convex hull, as a share of its own.
    """

    label: int
    low: Index
    high: Index
    volume_mm3: float
    extents_mm: Array
    centre: Array
    at_border: bool
    holes: int | None = None
    perforated: bool = False
    surrounds: float = 0.0

    @property
    def box(self) -> tuple[slice, ...]:
        """Its box as slices z, y, x."""
        return tuple(slice(int(a), int(b)) for a, b in zip(self.low[::-1], self.high[::-1], strict=True))

    @property
    def length_mm(self) -> float:
        """Longest extent."""
        return float(self.extents_mm[0])

    @property
    def arched(self) -> bool:
        """It has one hole as a stapes has it, be its footplate perforated or not."""
        return self.holes == 1 or self.perforated

    @property
    def empty_arch(self) -> bool:
        """It has one hole, and no other bone within its hull."""
        return self.arched and self.surrounds < MOST_SURROUNDED

    @property
    def possible(self) -> bool:
        """It has a volume and a length that a stapes can have."""
        volume, length = self.volume_mm3, self.length_mm
        return POSSIBLE_MM3[0] <= volume <= POSSIBLE_MM3[1] and POSSIBLE_MM[0] <= length <= POSSIBLE_MM[1]

    @property
    def size_score(self) -> float:
        """Log-likelihood of its volume and extents: 0 within the published ranges, less beyond them."""
        away = [_beyond(self.volume_mm3, USUAL_MM3) / 3.0]
        away += [_beyond(v, span) for v, span in zip(self.extents_mm, _EXTENTS_MM, strict=True)]
        return -0.5 * float(np.sum(np.square(np.array(away) / _SPREAD)))

    @property
    def usual(self) -> bool:
        """It has a size and a shape that nobody would call unusual, and surrounds no other bone."""
        return self.possible and self.size_score > -USUAL and self.surrounds < MOST_SURROUNDED

    @property
    def score(self) -> float:
        """Log-likelihood of being the stapes: size, one empty hole, whole within the scan."""
        penalty = _BORDER * self.at_border + _NO_ARCH * (not self.arched)
        return self.size_score - penalty - _SURROUNDING * (self.surrounds >= MOST_SURROUNDED)

    def as_json(self) -> dict[str, Any]:
        """Return what the report shows of it."""
        return {
            "volume_mm3": round(self.volume_mm3, 4),
            "extents_mm": [round(float(v), 3) for v in self.extents_mm],
            "holes": self.holes,
            "at_border": self.at_border,
            "log_likelihood": round(self.score, 2),
        }


def _beyond(value: float, span: tuple[float, float]) -> float:
    return float(max(0.0, np.log(span[0] / value), np.log(value / span[1])))


def label_pieces(mask: Mask, spacing_mm: Array) -> tuple[NDArray[np.int32], list[Piece]]:
    """Label the connected pieces (faces touching) of a mask [z, y, x] and describe those worth a look.

    Returns
    -------
    labels : ndarray of int32, [z, y, x]
    pieces : list of Piece
        From the largest to the smallest, nothing below 0.02 mm3.
    """
    import cc3d

    labels = np.zeros(mask.shape, dtype=np.int32)
    box = used_box(mask)
    if box is None:
        return labels, []
    labels[box] = cc3d.connected_components(mask[box], connectivity=6, out_dtype=np.uint32)
    return labels, describe_all(labels, spacing_mm)


def describe_all(labels: Labels, spacing_mm: Array) -> list[Piece]:
    """Describe the pieces of labels [z, y, x] that are worth a look, from the largest to the smallest."""
    from scipy.ndimage import find_objects

    count = np.bincount(labels.ravel())
    voxel = float(np.prod(spacing_mm))
    wanted = [int(k) for k in np.argsort(-count[1:]) + 1 if count[k] * voxel >= _LEAST_MM3]
    boxes = find_objects(labels)
    return [describe(labels, k, boxes[k - 1], spacing_mm) for k in wanted]


def describe(labels: Labels, label: int, box: tuple[slice, ...], spacing_mm: Array) -> Piece:
    """Measure one piece of a labelled array inside its box of slices (z, y, x)."""
    inside = labels[box] == label
    low = np.array([s.start for s in reversed(box)], dtype=np.int64)
    high = np.array([s.stop for s in reversed(box)], dtype=np.int64)
    place = np.flatnonzero(inside)
    some = place[:: max(1, place.size // 100_000)]
    points = np.stack(np.unravel_index(some, inside.shape)[::-1], axis=1) * spacing_mm
    centre = points.mean(axis=0)
    vectors = np.linalg.eigh(np.cov((points - centre).T) if len(points) > 3 else np.eye(3))[1]
    extents = np.sort(np.ptp(points @ vectors, axis=0) + spacing_mm.mean())[::-1]
    return Piece(
        label=label,
        low=low,
        high=high,
        volume_mm3=place.size * float(np.prod(spacing_mm)),
        extents_mm=extents,
        centre=centre / spacing_mm + low,
        at_border=bool(np.any(low == 0) or np.any(high == np.array(labels.shape[::-1]))),
    )


def classify(labels: Labels, piece: Piece, spacing_mm: Array, others: bool = True) -> Piece:
    """Count the holes of a piece of labels [z, y, x], and see whether it surrounds other bone."""
    inside = labels[piece.box] == piece.label
    if piece.holes is None:
        piece = with_holes(piece, inside, spacing_mm)
    if others and piece.arched and piece.surrounds == 0.0:
        piece = replace(piece, surrounds=_surrounded(labels, piece))
    return piece


def with_holes(piece: Piece, inside: Mask, spacing_mm: Array) -> Piece:
    """Return a piece with the holes of its solid [z, y, x] counted.

    Notes
    -----
    A hole through the footplate is narrower than the one between the crura, and a closing by a ball fills it
    alone. What bridges the gap to another bone makes a hole too, but one that is no wider than such gaps.
    """
    holes = count_holes(inside)
    if not 2 <= holes <= _MOST_HOLES or not piece.usual:
        return replace(piece, holes=holes)
    padded = np.pad(inside, int(np.ceil(_PERFORATION_MM / float(np.min(spacing_mm)))) + 1)
    perforated = count_holes(closed(padded, spacing_mm, _PERFORATION_MM)) == 1
    perforated = perforated and count_holes(closed(padded, spacing_mm, HALF_GAP_MM)) > 1
    return replace(piece, holes=holes, perforated=perforated)


def count_holes(inside: Mask) -> int:
    """Return how many tunnels go through the largest piece of a solid [z, y, x].

    Notes
    -----
    Euler characteristic = 1 - tunnels + cavities. A pinhole of noise must not count as a tunnel, so the solid
    is smoothed by a majority vote of 27 voxels first. Voxels that touch in a corner hang together.
    """
    import cc3d
    from scipy.ndimage import uniform_filter
    from skimage.measure import euler_number

    smooth = uniform_filter(np.pad(inside, 2).astype(np.float32), 3) > 0.5
    labels, count = cc3d.connected_components(smooth, connectivity=26, return_N=True)
    if count == 0:
        return 0
    smooth = labels == int(np.argmax(np.bincount(labels[smooth])))
    cavities = cc3d.connected_components(~smooth, connectivity=6, return_N=True)[1] - 1
    return int(1 + cavities - euler_number(smooth, connectivity=3))


def _surrounded(labels: Labels, piece: Piece) -> float:
    """Return the volume of other pieces within the convex hull of one, as a share of its own."""
    from scipy.spatial import ConvexHull, QhullError

    part = labels[piece.box][::2, ::2, ::2]
    own, other = np.argwhere(part == piece.label), np.argwhere((part > 0) & (part != piece.label))
    if len(other) == 0 or len(own) < 50:
        return 0.0
    every = max(1, len(other) // _HULL_POINTS)
    try:
        planes = ConvexHull(own[:: max(1, len(own) // (4 * _HULL_POINTS))]).equations
    except QhullError:  # flat
        return 0.0
    inside = np.all(other[::every] @ planes[:, :3].T + planes[:, 3] <= 0.0, axis=1)
    return float(np.count_nonzero(inside) * every / len(own))

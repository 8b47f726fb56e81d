"""Which piece of bone is the stapes: by volume, size, its one hole, and whether the scan cuts it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.volume.distance import closed
from legacy.ct_inertia.volume.grid_operations import boxes_and_sizes, labelled, majority, used_box
from legacy.ct_inertia.volume.mask_statistics import every_nth
from legacy.ct_inertia.volume.mesh_graphs import in_hull
from legacy.stapeskit.arrays import Array

TYPICAL_MM3 = calibrated("candidates.typical_mm3")
TYPICAL_MM = calibrated("candidates.typical_mm")
POSSIBLE_MM3 = calibrated("candidates.possible_mm3")
POSSIBLE_MM = calibrated("candidates.possible_mm")
# A stapes has next to no other bone within its hull; the bone around a window has the footplate there.
MOST_SURROUNDED = calibrated("candidates.most_surrounded")
HALF_GAP_MM = calibrated("separate.half_gap_mm")
_PERFORATION_BALL_MM = calibrated("candidates.perforation_ball_mm")
# Volume below which a piece is not described: a fortieth of the least typical stapes, for time only.
_LEAST_MM3 = 0.02
# Most voxels of a piece for its convex hull, whose time grows with them.
_HULL_POINTS = 4000


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
        Of its voxels.
    extents_mm : ndarray, (3,)
        Extents along its principal axes, longest first.
    centre : ndarray, (3,)
        Mean index x, y, z.
    at_border : bool
        It reaches the first or last voxel of the scan.
    holes : int or None
        Tunnels through it (1 in a stapes), when counted.
    surrounds : float
        Volume of other bone within its convex hull, as a share of its own: the bone around the oval window
        surrounds the footplate, a stapes nothing.
    perforated : bool
        It has more holes: one as wide as that between the crura, and others that are narrower and yet wider
        than the gaps between bones.
    """

    label: int
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    volume_mm3: float
    extents_mm: Array
    centre: Array
    at_border: bool
    holes: int | None = None
    surrounds: float = 0.0
    perforated: bool = False

    @property
    def box(self) -> tuple[slice, ...]:
        """Its box as slices z, y, x."""
        return tuple(slice(int(a), int(b)) for a, b in zip(self.low[::-1], self.high[::-1], strict=True))

    @property
    def arched(self) -> bool:
        """It has one hole as a stapes has it, be its footplate perforated or not."""
        return self.holes == 1 or self.perforated

    @property
    def possible(self) -> bool:
        """It has a volume and a length that a stapes can have."""
        return (
            POSSIBLE_MM3[0] <= self.volume_mm3 <= POSSIBLE_MM3[1]
            and POSSIBLE_MM[0] <= self.length_mm <= POSSIBLE_MM[1]
        )

    @property
    def length_mm(self) -> float:
        """Longest extent."""
        return float(self.extents_mm[0])

    @property
    def oddness(self) -> float:
        """How far volume and extents lie outside what stapedes have: 0 inside, else a sum of logarithms."""
        away = _log_distance(self.volume_mm3, TYPICAL_MM3)
        return away + 3.0 * sum(
            _log_distance(v, span) for v, span in zip(self.extents_mm, TYPICAL_MM, strict=True)
        )

    @property
    def score(self) -> float:
        """Rank among possible pieces: one empty hole counts most, then being whole, then size and shape."""
        hole = 3.0 * self.arched * (self.surrounds < MOST_SURROUNDED)
        return hole - 2.0 * self.at_border - 2.0 * self.oddness

    def as_json(self) -> dict[str, Any]:
        """Return what the report shows of it."""
        return {
            "volume_mm3": round(self.volume_mm3, 4),
            "extents_mm": [round(float(v), 3) for v in self.extents_mm],
            "holes": self.holes,
            "at_border": self.at_border,
        }


def labelled_pieces(mask: NDArray[np.bool_], spacing_mm: Array) -> tuple[NDArray[np.int32], list[Piece]]:
    """Label the connected pieces (faces touching) of a mask [z, y, x] and describe those worth a look.

    Returns
    -------
    labels : ndarray of int32, [z, y, x]
    pieces : list of Piece
        From the largest to the smallest, nothing below 0.02 mm3.
    """
    labels = np.zeros(mask.shape, dtype=np.int32)
    box = used_box(mask)
    if box is None:
        return labels, []
    part = labels[box]
    _, count = labelled(mask[box], out=part)
    boxes, sizes = boxes_and_sizes(part, count)
    voxel = float(np.prod(spacing_mm))
    pieces = []
    for k in np.argsort(-sizes[1:]) + 1:
        if sizes[k] * voxel < _LEAST_MM3:
            break
        ranges = zip(boxes[k - 1] or (), box, strict=True)
        place = tuple(slice(inner.start + outer.start, inner.stop + outer.start) for inner, outer in ranges)
        pieces.append(describe(labels, int(k), place, spacing_mm))
    return labels, pieces


def describe(labels: NDArray[np.integer], label: int, box: tuple[slice, ...], spacing_mm: Array) -> Piece:
    """Measure one piece of a labelled array inside its box of slices (z, y, x)."""
    inside = labels[box] == label
    low = np.array([s.start for s in reversed(box)], dtype=np.int64)
    high = np.array([s.stop for s in reversed(box)], dtype=np.int64)
    count = int(np.count_nonzero(inside))
    some = every_nth(inside, count // 100_000 if count > 200_000 else 1)
    index = np.stack(np.unravel_index(some, inside.shape)[::-1], axis=1)
    points = index * spacing_mm
    centre = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - centre).T) if len(points) > 3 else np.eye(3))
    extents = np.sort(np.ptp(points @ vectors, axis=0) + spacing_mm.mean())[::-1]
    size = np.array(labels.shape[::-1])
    return Piece(
        label=label,
        low=low,
        high=high,
        volume_mm3=count * float(np.prod(spacing_mm)),
        extents_mm=extents,
        centre=centre / spacing_mm + low,
        at_border=bool(np.any(low == 0) or np.any(high == size)),
    )


def surrounded(labels: NDArray[np.integer], piece: Piece) -> float:
    """Return the volume of other pieces within the convex hull of one, as a share of its own.

    Parameters
    ----------
    labels : ndarray of int, [z, y, x]
        Pieces by number; 0 elsewhere.
    piece : Piece
    """
    part = labels[piece.box][::2, ::2, ::2]
    own = np.argwhere(part == piece.label)
    other = np.argwhere((part > 0) & (part != piece.label))
    if len(other) == 0 or len(own) < 50 or np.any(np.ptp(own, axis=0) == 0):
        return 0.0
    every = max(1, len(other) // _HULL_POINTS)
    inside = in_hull(own[:: max(1, len(own) // (4 * _HULL_POINTS))], other[::every])
    return float(np.count_nonzero(inside) * every / len(own))


def within_hull(labels: NDArray[np.integer], piece: Piece, other: Piece) -> float:
    """Return the share of another piece that lies within the convex hull of one, both of labels [z, y, x]."""
    own, asked = (_places(labels, one) for one in (piece, other))
    low = np.minimum(own.min(axis=0), asked.min(axis=0))
    return float(np.mean(in_hull(own - low, asked - low)))


def _places(labels: NDArray[np.integer], piece: Piece) -> NDArray[np.intp]:
    """Return some voxels z, y, x of a piece, (n, 3)."""
    index = np.argwhere(labels[piece.box] == piece.label)
    return index[:: max(1, len(index) // (4 * _HULL_POINTS))] + piece.low[::-1]


def _log_distance(value: float, span: tuple[float, float]) -> float:
    return float(max(0.0, np.log(span[0] / value), np.log(value / span[1])))


def with_holes_of(piece: Piece, inside: NDArray[np.bool_], spacing_mm: Array) -> Piece:
    """Return a piece with the holes of a solid [z, y, x] counted.

    Notes
    -----
    A hole through the footplate is narrower than the one between the crura, and a closing by a ball fills it
    alone. What bridges the gap to another bone makes a hole too, but one that is no wider than such gaps.
    """
    holes = count_holes(inside)
    if holes < 2 or not piece.possible:
        return replace(piece, holes=holes)
    padded = np.pad(inside, int(np.ceil(_PERFORATION_BALL_MM / float(np.min(spacing_mm)))) + 1)
    return replace(piece, holes=holes, perforated=_is_perforated(padded, spacing_mm))


def _is_perforated(inside: NDArray[np.bool_], spacing_mm: Array) -> bool:
    if count_holes(closed(inside, spacing_mm, _PERFORATION_BALL_MM)) != 1:
        return False
    return count_holes(closed(inside, spacing_mm, HALF_GAP_MM)) > 1


def count_holes(inside: NDArray[np.bool_]) -> int:
    """Return how many tunnels go through the largest piece of a solid [z, y, x].

    Notes
    -----
    Euler characteristic = 1 - tunnels + cavities. A pinhole of noise must not count as a tunnel, so the
    solid is smoothed by a majority vote first. Voxels that touch in a corner hang together.
    """
    smooth = majority(np.pad(inside, 2))
    labels, count = labelled(smooth, corners=True)
    if count == 0:
        return 0
    if count > 1:
        smooth = labels == int(np.argmax(np.bincount(labels[smooth])))
    _, outside = labelled(~smooth)
    return 1 + (int(outside) - 1) - euler_number(smooth)


def euler_number(solid: NDArray[np.bool_]) -> int:
    """Return corners - edges + faces - voxels of the union of closed voxels; the rim must be empty."""
    total = 0
    for which in range(8):
        cells = solid
        for axis in range(3):
            if which >> axis & 1:
                ahead, back = [slice(None)] * 3, [slice(None)] * 3
                ahead[axis], back[axis] = slice(1, None), slice(None, -1)
                cells = cells[tuple(ahead)] | cells[tuple(back)]
        # Joined along k axes: the cells between voxels have 3 - k dimensions.
        total += (-1) ** (3 - which.bit_count()) * int(np.count_nonzero(cells))
    return total

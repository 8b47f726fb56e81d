"""Propose bodies at every reading of the grey levels, score each by one likelihood, take the best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ct_inertia.find.levels import Reading, readings
from ct_inertia.find.necks import find_necks
from ct_inertia.find.overview import Overview
from ct_inertia.find.pieces import RIVAL, Piece, label_pieces
from ct_inertia.find.refuse import check_not_open, no_bone_at_seed, no_stapes, rivals_fault, unusual_notice
from ct_inertia.find.split import Split, splits
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import eroded
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_LEAST_LARGE_MM3 = 0.8  # of a piece that may hold a stapes and more
_MOST_LARGE = 4  # pieces that are split, for time only
_MOST_MM3 = 40.0  # of a piece that is split: a stapes, an incus and millimetres of bone around the window
_LEAST_SCORE = -8.0  # log-likelihood from which a body may be a stapes: no arch, or cropped, and a little odd
_LONGEST_MM = 4.4  # of a body of one hole that is left whole where no gap shows another bone
_LEAST_BONE_MM3 = 0.2  # of a part that is a bone of its own
_SEED_REACH = 3  # blocks from a seed to the bone that it means
_LEAST_DEEP = 50  # coarse voxels inside a body from which its own level is read
_CLEARLY = 0.1  # log-likelihood by which another reading of the levels must be better
_SAME_LEVEL = 0.05  # of the contrast: a threshold that differs by less moves no surface of the first look


@dataclass(frozen=True, eq=False)
class Candidate:
    """A body that may be the stapes.

    Attributes
    ----------
    whole : Piece
        The piece of the first look that is the body or holds it.
    others : tuple of Piece
        The other pieces.
    split : Split or None
        How the body was split off its piece.
    part : Piece or None
        The body among the parts of the split.
    """

    reading: Reading
    whole: Piece
    others: tuple[Piece, ...]
    split: Split | None = None
    part: Piece | None = None

    @property
    def body(self) -> Piece:
        """The piece of bone that is proposed as the stapes."""
        return self.whole if self.part is None else self.part

    @property
    def score(self) -> float:
        """Log-likelihood; what has clearly grown on at a neck speaks for the cut."""
        return self.body.score + RIVAL * (self.split is not None and _has_grown(self.split, self.whole))


@dataclass(frozen=True)
class Search:
    """What a user can say about where the stapes is.

    Attributes
    ----------
    threshold : float or None
        Grey value between air and bone (--threshold).
    seed_mm : ndarray, (3,), or None
        A point inside the stapes, scan coordinates (--seed).
    """

    threshold: float | None = None
    seed_mm: Array | None = None


def choose(scan: Scan, overview: Overview, search: Search) -> tuple[Candidate, tuple[Notice, ...]]:
    """Choose the body that is most likely the stapes.
    Returns also what speaks against it.

    Raises
    ------
    StapeskitError
        None can be the stapes, several can equally, or the seed lies in no bone; a wrong voxel size and
        inverted grey values are named as such.
    """
    seed_mm = search.seed_mm
    if seed_mm is not None:
        _check_seed(scan, seed_mm)
    ranked: list[Candidate] = []
    tried: list[Piece] = []

    def proposed(reading: Reading) -> list[Candidate]:
        found = label_pieces(overview.above(reading.between, reading.contrast), overview.grid)
        tried.extend(found)
        return sorted(_propose(scan, overview, search, reading, found), key=lambda one: -one.score)

    for reading in readings(overview.levels, search.threshold):
        proposals = proposed(reading)
        if proposals and (not ranked or proposals[0].score > ranked[0].score + _CLEARLY):
            ranked = proposals
        if ranked and ranked[0].body.whole_stapes:
            break
    if not ranked or (seed_mm is None and ranked[0].body.score < _LEAST_SCORE):
        raise no_bone_at_seed(seed_mm) if seed_mm is not None and tried else no_stapes(overview, tried)
    own = _own_level(overview, ranked[0]) if search.threshold is None else None
    if own is not None:
        proposals = proposed(own)
        if proposals and (proposals[0].body.whole_stapes or proposals[0].score >= ranked[0].score):
            ranked = proposals
    if seed_mm is None:
        _refuse_rivals(ranked)
    check_not_open(ranked[0].body, seed_mm is not None)
    body = ranked[0].body
    answered = seed_mm is not None and body.possible  # the seed has named this body
    return ranked[0], () if answered else unusual_notice(body)


def _own_bone(overview: Overview, piece: Piece) -> float | None:
    """Return the grey level of a body's own bone; None where too little of it is deep.

    Blur lowers the outer voxels of the interior: its brighter quarter begins at the level of bone.
    """
    deep = overview.grey[piece.box][eroded(piece.inside)]
    return float(np.percentile(deep, 75.0)) if deep.size >= _LEAST_DEEP else None


def _own_level(overview: Overview, chosen: Candidate) -> Reading | None:
    """Return the reading with the threshold half way from air to the body's bone; None if already used.

    The brightest material of the scan may be bone of another density, so that the first threshold is far
    from the middle of the body's edges.
    """
    reading = chosen.reading
    bone = None if chosen.split is not None or overview.is_mask else _own_bone(overview, chosen.whole)
    if bone is None or not bone > reading.air:
        return None
    plastic = None if reading.plastic is None or reading.plastic >= bone else reading.plastic
    own = Reading.of(reading.air, plastic, bone)
    return own if abs(own.between - reading.between) >= _SAME_LEVEL * own.contrast else None


def _propose(
    scan: Scan, overview: Overview, search: Search, reading: Reading, found: list[Piece]
) -> Iterator[Candidate]:
    """Yield the bodies that may be the stapes at one reading: whole pieces, then parts of larger ones."""
    seed_mm = search.seed_mm

    def is_soft(piece: Piece) -> bool:
        """Return whether what was taken for bone is plastic or fluid: half as dense as the body's own."""
        bone = _own_bone(overview, piece) if search.threshold is None else None
        return bone is not None and reading.bone < 0.5 * (reading.air + bone)

    wholes = [piece for piece in _seeded(found, overview.grid, seed_mm) if not is_soft(piece)]
    others = {piece.label: tuple(one for one in found if one is not piece) for piece in wholes}
    for piece in wholes:
        if piece.possible:
            yield Candidate(reading, piece, others[piece.label])
    complete = [piece for piece in wholes if piece.whole_stapes]
    if any(not _looks_grown(piece) for piece in complete):
        return
    # Next to a whole stapes no other bone is cut into something like it, only what has grown on it is cut.
    large = complete or [
        piece for piece in wholes if _LEAST_LARGE_MM3 < piece.volume_mm3 < _MOST_MM3 or seed_mm is not None
    ]
    large.sort(key=lambda piece: piece.possible and piece.surrounding)
    for piece in large[:_MOST_LARGE]:
        for way in splits(scan, overview, piece, reading, seed_mm):
            if piece.usual and piece.arched and way.neck is None and not piece.at_border:
                break  # it is a stapes but for what may have grown on
            parts = _seeded(list(way.parts), way.grid, seed_mm)
            better = [part for part in parts if part.possible and _is_better(part, piece, way)]
            for part in better:
                yield Candidate(reading, piece, others[piece.label], way, part)
            if any(part.whole_stapes for part in better):
                break


def _looks_grown(piece: Piece) -> bool:
    """Return whether the first look shows a neck that is narrower than a head's."""
    grid = piece.grid
    necks = find_necks(np.argwhere(piece.inside)[:, ::-1] * grid.spacing_mm, grid.spacing_mm)
    return any(neck.grown_on(piece.at_border) for neck in necks)


def _has_grown(way: Split, whole: Piece) -> bool:
    """Return whether what was cut off at a neck is no head of a stapes, and has left a stapes behind."""
    grown = way.neck is not None and way.neck.grown_on(whole.at_border)
    return grown and way.parts[0].whole_stapes


def _is_better(part: Piece, whole: Piece, way: Split) -> bool:
    """Return whether a part of a split piece is a better candidate for the stapes than the whole piece.

    What hangs at a neck makes a body longer: a body of one empty hole that is only thick is left whole.
    Beside it only the incus can be, and it is no stapes: a split into more bones than these two has cut the
    stapes itself.
    """
    if part.at_border > whole.at_border:
        return False
    if not whole.possible or (_has_grown(way, whole) and part is way.parts[0]):
        return True
    if whole.usual and whole.volume_mm3 - part.volume_mm3 < _LEAST_BONE_MM3:
        return False
    gain = part.score - whole.score
    if not whole.empty_arch:
        return gain > RIVAL
    bones = [p for p in way.parts if p is not part and p.volume_mm3 > _LEAST_BONE_MM3]
    if len(bones) > 1 or any(p.possible and p.score > part.score - RIVAL for p in bones):
        return False
    if whole.length_mm <= _LONGEST_MM:
        return gain > RIVAL and (way.neck is None or way.cropped)
    return gain > 0.0


def _refuse_rivals(ranked: list[Candidate]) -> None:
    """Refuse two bodies that can be the stapes equally well: two pieces, or two parts of one split.

    A body that was separated in two ways is one: its middles lie within half of its shortest extent.
    """
    best, body = ranked[0], ranked[0].body
    equal = [body]
    for other in ranked[1:]:
        if other.whole.label == best.whole.label and other.split is not best.split:
            continue
        away = float(np.linalg.norm(other.body.centre_mm - body.centre_mm))
        if other.body.score > body.score - RIVAL and away > 0.5 * float(body.extents_mm[-1]):
            equal.append(other.body)
    if len(equal) > 1:
        raise StapeskitError(rivals_fault(equal))


def _check_seed(scan: Scan, seed_mm: Array) -> None:
    index = scan.index_points(seed_mm)
    if np.any(index < -0.5) or np.any(index > scan.size - 0.5):
        ends = np.sort(scan.scan_points(np.array([np.zeros(3), scan.size - 1.0])), axis=0)
        reach = ", ".join(f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", *ends, strict=True))
        raise StapeskitError.of(
            "--seed",
            f"inside the scan ({reach} mm)",
            ", ".join(f"{v:g}" for v in np.asarray(seed_mm)),
            next_step="Give it in scan coordinates, mm",
        )


def _seeded(pieces: list[Piece], grid: Grid, seed_mm: Array | None) -> list[Piece]:
    """Return all pieces without a seed; with one the piece at it, or the nearest within a few blocks."""
    if not pieces or seed_mm is None:
        return pieces
    back = np.linalg.inv(grid.scan_from_index)
    seed = np.rint(back[:3, :3] @ seed_mm + back[:3, 3]).astype(np.int64)
    low = np.clip(seed - _SEED_REACH, 0, None)
    box = tuple(slice(int(a), int(b) + _SEED_REACH + 1) for a, b in zip(low[::-1], seed[::-1], strict=True))
    near = pieces[0].labels[box]
    index = np.argwhere(np.isin(near, [piece.label for piece in pieces]))
    if len(index) == 0:
        return []
    away = np.linalg.norm(index[:, ::-1] + low - seed, axis=1)
    label = int(near[tuple(index[int(np.argmin(away))])])
    return [piece for piece in pieces if piece.label == label]

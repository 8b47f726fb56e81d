"""Propose bodies at every reading of the grey levels, score each by one likelihood, take the best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Mask
from ct_inertia.calibrated import calibrated
from ct_inertia.find.necks import find_necks
from ct_inertia.find.overview import Overview
from ct_inertia.find.pieces import RIVAL, Piece, classify, label_pieces
from ct_inertia.find.refuse import check_not_open, no_bone_at_seed, no_stapes, rivals_fault, unusual_notice
from ct_inertia.find.split import Split, splits
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_ABOVE_PLASTIC = calibrated("choose.above_plastic")
_LEAST_LARGE_MM3 = 0.8  # of a piece that may hold a stapes and more
_MOST_LARGE = 4  # pieces that are split, for time only
_MOST_MM3 = 40.0  # of a piece that is split: a stapes, an incus and millimetres of bone around the window
_LEAST_SCORE = -8.0  # log-likelihood from which a body may be a stapes: no arch, or cropped, and a little odd
_LONGEST_MM = 4.4  # of a body of one hole that is left whole where no gap shows another bone
_LEAST_BONE_MM3 = 0.2  # of a part that is a bone of its own
_SEED_REACH = 3  # coarse voxels from a seed to the bone that it means
_LEAST_DEEP = 50  # coarse voxels inside a body from which its own level is read
_SAME_LEVEL = (
    0.05  # of the contrast: a threshold that differs by less moves no surface that the first look shows
)


@dataclass(frozen=True)
class Reading:
    """Grey levels of air, plastic (None: there is none) and bone, and the one above which a voxel is bone."""

    air: float
    plastic: float | None
    bone: float
    between: float

    @classmethod
    def of(cls, air: float, plastic: float | None, bone: float) -> Reading:
        """Choose the level between bone and what is darker: half way from air, but well above plastic."""
        middle = 0.5 * (air + bone)
        between = middle if plastic is None else max(middle, plastic + _ABOVE_PLASTIC * (bone - plastic))
        return cls(air, plastic, bone, between)


@dataclass(frozen=True)
class Candidate:
    """A body that may be the stapes.

    Attributes
    ----------
    reading : Reading
    pieces : ndarray of int32, [z, y, x]
        Pieces of bone at this reading, coarse voxels.
    whole : Piece
        The piece that is the body or holds it.
    others : tuple of Piece
        The other pieces.
    split : Split or None
        How the body was split off its piece.
    part : Piece or None
        The body among the parts of the split.
    """

    reading: Reading
    pieces: NDArray[np.int32]
    whole: Piece
    others: tuple[Piece, ...]
    split: Split | None = None
    part: Piece | None = None

    @property
    def body(self) -> Piece:
        """The body itself; places are in voxels of its own grid."""
        return self.whole if self.part is None else self.part

    def centre_mm(self, scan: Scan, overview: Overview) -> Array:
        """Return its middle, scan coordinates."""
        if self.split is not None and self.part is not None:
            return self.split.centre_mm(self.part)
        return scan.scan_points(self.whole.centre * overview.step + overview.step // 2)


def readings(levels: Array, threshold: float | None) -> list[Reading]:
    """Return the possible readings of the materials' levels, the brightest material as bone first.

    A material above half way from air to bone is bone of another density, or else a dense plate.

    Raises
    ------
    StapeskitError
        A threshold that lies beyond all levels.
    """
    air = float(levels[0])
    if threshold is not None:
        below, above = levels[levels < threshold], levels[levels >= threshold]
        if below.size == 0 or above.size == 0:
            raise StapeskitError.of(
                "--threshold",
                f"between the grey levels of air and bone ({levels[0]:.6g} and {levels[-1]:.6g})",
                f"{threshold:g}",
                next_step="Read the two levels off the viewer, or leave --threshold out",
            )
        plastic = float(below[-1]) if below.size > 1 else None
        return [Reading(float(below[0]), plastic, float(above[-1]), threshold)]
    tried = []
    for k in range(len(levels) - 1, 0, -1):
        bone, between = float(levels[k]), levels[1:k]
        light, dense = between[between <= 0.5 * (air + bone)], between[between > 0.5 * (air + bone)]
        plastics = [float(light[-1]) if light.size else None, *(float(level) for level in dense)]
        tried += [Reading.of(air, plastic, bone) for plastic in plastics]
    return tried


def choose(
    scan: Scan, overview: Overview, threshold: float | None, seed_mm: Array | None
) -> tuple[Candidate, tuple[Notice, ...]]:
    """Choose the body that is most likely the stapes.

    Returns
    -------
    Candidate
    tuple of Notice
        What speaks against it.

    Raises
    ------
    StapeskitError
        None can be the stapes, several can equally, or the seed lies in no bone; a wrong voxel size and
        inverted grey values are named as such.
    """
    seed = None if seed_mm is None else _seed_index(scan, overview, seed_mm)
    best: Candidate | None = None
    rivals: list[Candidate] = []
    tried: list[tuple[Reading, NDArray[np.int32], list[Piece]]] = []
    for reading in readings(overview.levels, threshold):
        mask = overview.calm(reading.bone - reading.air) > np.float32(reading.between)
        pieces, found = label_pieces(_measured(mask, overview), overview.spacing_mm)
        found = _flag_border(found, scan, overview)
        if not found:
            continue
        tried.append((reading, pieces, found))
        proposals = list(_propose(scan, overview, (reading, pieces, found), seed, seed_mm))
        proposals = [
            one for one in proposals if threshold is not None or not _takes_soft_for_bone(one, overview)
        ]
        proposals.sort(key=lambda one: -one.body.score)
        if proposals and (best is None or proposals[0].body.score > best.body.score + 0.1):
            best, rivals = proposals[0], proposals[1:]
        if best is not None and best.body.usual and best.body.empty_arch and not best.body.at_border:
            break
    if best is None or (seed is None and best.body.score < _LEAST_SCORE):
        if seed is not None and tried:
            raise no_bone_at_seed(seed_mm)
        raise no_stapes(overview, tried)
    if threshold is None and best.split is None and not overview.is_mask:
        best = _at_own_level(scan, overview, best)
    if seed is None:
        _refuse_rivals(scan, overview, best, rivals)
    check_not_open(best.body, seed is not None)
    return best, unusual_notice(best.body)


def _propose(
    scan: Scan,
    overview: Overview,
    read: tuple[Reading, NDArray[np.int32], list[Piece]],
    seed: NDArray[np.int64] | None,
    seed_mm: Array | None,
) -> Iterator[Candidate]:
    """Yield the bodies that may be the stapes at one reading: whole pieces, then parts of larger ones."""
    reading, pieces, found = read
    if seed is not None:
        found = _seeded(pieces, found, seed)
    wholes = [classify(pieces, p, overview.spacing_mm) if p.possible else p for p in found]
    possible = [p for p in wholes if p.possible]
    good = False
    for piece in possible:
        others = tuple(p for p in read[2] if p.label != piece.label)
        whole = Candidate(reading, pieces, piece, others)
        if piece.usual and piece.arched:
            cut = _without_grown(scan, overview, whole)
            good = good or cut is not None or not piece.at_border
            yield whole if cut is None else cut
        else:
            yield whole
    if good and any(p.usual and p.empty_arch for p in possible):
        return
    large = [p for p in wholes if _LEAST_LARGE_MM3 < p.volume_mm3 < _MOST_MM3 or seed is not None]
    large.sort(key=lambda p: p.surrounds > 0.0)
    for piece in large[:_MOST_LARGE]:
        others = tuple(p for p in read[2] if p.label != piece.label)
        levels = (reading.air, reading.bone, reading.between)
        for way in splits(scan, overview, pieces, piece, levels, seed_mm):
            parts = way.parts if seed_mm is None else _parts_at(way, seed_mm)
            done = False
            for part in parts:
                if not part.possible or not _is_better(part, piece, way):
                    continue
                yield Candidate(reading, pieces, piece, others, way, part)
                done = done or (part.usual and part.empty_arch and not part.at_border)
            if done:
                break


def _is_better(part: Piece, whole: Piece, way: Split) -> bool:
    """Return whether a part may stand for its whole.

    What hangs at a neck makes a body longer: a body of one empty hole that is only thick is left whole.
    Beside it only the incus can be, and it is no stapes: a split into more bones than these two has cut the
    stapes itself.
    """
    if part.at_border > whole.at_border:
        return False
    if not whole.possible:
        return True
    if whole.usual and whole.volume_mm3 - part.volume_mm3 < _LEAST_BONE_MM3:
        return False
    if not whole.empty_arch:
        return part.score > whole.score + RIVAL
    bones = [p for p in way.parts if p.label != part.label and p.volume_mm3 > _LEAST_BONE_MM3]
    if len(bones) > 1 or any(p.possible and p.score > part.score - RIVAL for p in bones):
        return False
    gain = part.score - whole.score
    if whole.length_mm <= _LONGEST_MM:
        return gain > RIVAL and (way.neck is None or way.at_border)
    return gain > 0.0


def _without_grown(scan: Scan, overview: Overview, whole: Candidate) -> Candidate | None:
    """Cut off what has grown onto a body of usual size, such as an incus; None where nothing has."""
    piece = whole.whole
    inside = np.argwhere(whole.pieces[piece.box] == piece.label)[:, ::-1] + piece.low
    necks = find_necks(inside * overview.spacing_mm, overview.spacing_mm)
    if not any(neck.grown_on(piece.at_border) for neck in necks):
        return None
    reading = whole.reading
    levels = (reading.air, reading.bone, reading.between)
    for way in splits(scan, overview, whole.pieces, piece, levels):
        if way.neck is None or not way.neck.grown_on(piece.at_border):
            return None
        part = way.parts[0]
        if part.usual and part.arched and not part.at_border:
            return replace(whole, split=way, part=part)
    return None


def _at_own_level(scan: Scan, overview: Overview, chosen: Candidate) -> Candidate:
    """Take the threshold half way between air and the body's own bone, where it is still a stapes there.

    The brightest material of the scan may be bone of another density, so that the first threshold is far from
    the middle of the body's edges.
    """
    reading = chosen.reading
    own = chosen.pieces == chosen.whole.label
    bone = _own_bone(overview, own)
    if bone is None or not bone > reading.air:
        return chosen
    plastic = None if reading.plastic is None or reading.plastic >= bone else reading.plastic
    other = Reading.of(reading.air, plastic, bone)
    if abs(other.between - reading.between) < _SAME_LEVEL * (bone - reading.air):
        return chosen
    mask = _measured(overview.calm(bone - reading.air) > np.float32(other.between), overview)
    pieces, found = label_pieces(mask, overview.spacing_mm)
    votes = np.bincount(pieces[own], minlength=1)
    votes[0] = 0
    same = [p for p in _flag_border(found, scan, overview) if p.label == int(np.argmax(votes))]
    if not same:
        return chosen
    piece = classify(pieces, same[0], overview.spacing_mm)
    if not (piece.usual and piece.arched) and piece.score < chosen.body.score:
        return chosen
    return Candidate(other, pieces, piece, tuple(p for p in found if p.label != piece.label))


def _own_bone(overview: Overview, own: Mask) -> float | None:
    """Return the grey level of a body's own bone; None where too little of it is deep.

    Blur lowers the outer voxels of the interior: its brighter quarter begins at the level of bone.
    """
    from ct_inertia.grey.start import eroded

    deep = overview.grey[eroded(own)]
    return float(np.percentile(deep, 75.0)) if deep.size >= _LEAST_DEEP else None


def _takes_soft_for_bone(candidate: Candidate, overview: Overview) -> bool:
    """Return whether what was taken for bone is half as dense as the body's own, as plastic and fluid are."""
    bone = _own_bone(overview, candidate.pieces == candidate.whole.label)
    reading = candidate.reading
    return bone is not None and reading.bone < 0.5 * (reading.air + bone)


def _measured(mask: Mask, overview: Overview) -> Mask:
    return mask if overview.unmeasured is None else mask & ~overview.unmeasured


def _flag_border(found: list[Piece], scan: Scan, overview: Overview) -> list[Piece]:
    """Correct the border flag: the coarse grid may miss the last voxels of the scan."""
    step = overview.step
    flagged = []
    for piece in found:
        low, high = piece.low * step + step // 2, (piece.high - 1) * step + step // 2
        cut = bool(np.any(low <= step) or np.any(high >= scan.size - 1 - step))
        flagged.append(replace(piece, at_border=cut))
    return flagged


def _refuse_rivals(scan: Scan, overview: Overview, best: Candidate, rivals: list[Candidate]) -> None:
    """Refuse two bodies that can be the stapes equally well: two pieces, or two parts of one split.

    A body that was separated in two ways is one: its middles lie within half of its shortest extent.
    """
    place = best.centre_mm(scan, overview)
    one = 0.5 * float(best.body.extents_mm[-1])
    equal = [(best.body, place)]
    for other in rivals:
        if other.whole.label == best.whole.label and other.split is not best.split:
            continue
        away = other.centre_mm(scan, overview)
        if other.body.score > best.body.score - RIVAL and np.linalg.norm(away - place) > one:
            equal.append((other.body, away))
    if len(equal) > 1:
        raise StapeskitError(rivals_fault(equal))


def _seed_index(scan: Scan, overview: Overview, seed_mm: Array) -> NDArray[np.int64]:
    index = scan.index_points(seed_mm)
    if np.any(index < -0.5) or np.any(index > scan.size - 0.5):
        ends = scan.scan_points(np.array([np.zeros(3), scan.size - 1.0]))
        reach = ", ".join(
            f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", *np.sort(ends, axis=0), strict=True)
        )
        raise StapeskitError.of(
            "--seed",
            f"inside the scan ({reach} mm)",
            ", ".join(f"{v:g}" for v in np.asarray(seed_mm)),
            next_step="Give it in scan coordinates, mm",
        )
    return np.clip(np.round((index - overview.step // 2) / overview.step), 0, None).astype(np.int64)


def _seeded(pieces: NDArray[np.int32], found: list[Piece], seed: NDArray[np.int64]) -> list[Piece]:
    """Return the piece at the seed, or the nearest within a few coarse voxels; nothing without one."""
    low = np.maximum(seed - _SEED_REACH, 0)
    box = tuple(slice(int(a), int(b) + _SEED_REACH + 1) for a, b in zip(low[::-1], seed[::-1], strict=True))
    near = pieces[box]
    index = np.argwhere(np.isin(near, [p.label for p in found]))
    if len(index) == 0:
        return []
    away = np.linalg.norm(index[:, ::-1] + low - seed, axis=1)
    label = int(near[tuple(index[int(np.argmin(away))])])
    return [p for p in found if p.label == label]


def _parts_at(way: Split, seed_mm: Array) -> list[Piece]:
    """Return the part of a split that lies nearest to a seed."""
    back = np.linalg.inv(way.grid.scan_from_index)
    index = np.rint(back[:3, :3] @ seed_mm + back[:3, 3]).astype(np.int64)
    return _seeded(way.labels, list(way.parts), index)

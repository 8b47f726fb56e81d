"""Find the stapes and the plate in a coarse view of the scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.segment.ambiguity import RIVAL, USUAL, ambiguity_notices, refuse_rivals
from legacy.ct_inertia.segment.candidates import (
    MOST_SURROUNDED,
    TYPICAL_MM,
    TYPICAL_MM3,
    Piece,
    labelled_pieces,
)
from legacy.ct_inertia.segment.coarse_segmentation import (
    CoarseSegmentation,
    SearchOptions,
    between_levels,
    classify_piece,
    level_hypotheses,
)
from legacy.ct_inertia.segment.local_threshold import segment_at_local_threshold, takes_soft_for_bone
from legacy.ct_inertia.segment.necks import Neck, necks
from legacy.ct_inertia.segment.not_found import not_found_error
from legacy.ct_inertia.segment.split_pieces import MOST_WALL_MM3, CoarseGrid, SplitPiece, split_piece
from legacy.ct_inertia.volume.coarse_view import CoarseOverview, CoarseScan, coarse_overview, smooth_noise
from legacy.ct_inertia.volume.grid_operations import dilated
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault

_ODD = calibrated("search.odd")
# Most bodies that are split, the largest first: for time only.
_MOST_WHOLES = 4
_HALO_MM = calibrated("search.halo_mm")
_LEAST_BEYOND = calibrated("search.least_beyond")


def find_stapes(
    volume: Volume, options: SearchOptions, glance: CoarseOverview | None = None
) -> CoarseSegmentation:
    """Find the piece of bone that can be a stapes.

    Parameters
    ----------
    volume : Volume
    options : SearchOptions
    glance : CoarseOverview, optional
        The coarse view, when it was taken before.

    Raises
    ------
    CtInertiaError
        None can be one, or several can equally, or the seed lies in no bone; a wrong voxel size and
        inverted grey values are named as such.
    """
    glance = glance or coarse_overview(volume)
    scan, levels = glance.scan, glance.levels
    tried: list[CoarseSegmentation] = []
    doubtful: tuple[CoarseSegmentation, CoarseSegmentation] | None = None
    without_hole: CoarseSegmentation | None = None
    for air, plastic, bone in level_hypotheses(levels, options.threshold):
        between = options.threshold if options.threshold is not None else between_levels(air, plastic, bone)
        pieces, candidates = labelled_pieces(
            smooth_noise(scan.grey, scan.noise / (bone - air)) > between, scan.spacing_mm
        )
        candidates = _correct_border_flags(candidates, scan, volume)
        if not candidates:
            continue
        sight = CoarseSegmentation(
            scan, pieces, candidates[0], tuple(candidates[1:]), air, bone, plastic, between
        )
        tried.append(sight)
        chosen = _pick(volume, sight, options, alone=False)
        usual = chosen is not None and _is_usual(chosen.stapes)
        if chosen is not None and usual and chosen.stapes.arched:
            cut = _without_grown(volume, chosen, options)
            if cut is not None and _shows_more_bone(cut, doubtful):
                return cut
        # What ends at the border of the scan may be another bone that touches a whole stapes.
        if not usual or (chosen is not None and chosen.stapes.at_border):
            parted = _part(volume, sight, options)
            better = parted is not None and (chosen is None or _is_likelier(parted, chosen.stapes))
            soft = parted is not None and options.threshold is None and takes_soft_for_bone(parted)
            if parted is not None and better and not soft and _shows_more_bone(parted, doubtful):
                if parted.stapes.arched:
                    return parted
                without_hole = without_hole or parted
        if chosen is None:
            continue
        if usual and chosen.stapes.arched and _shows_more_bone(chosen, doubtful):
            if chosen.stapes.at_border:
                _refuse_two_ends(volume, chosen, options)
            own = _at_own_level(volume, _pick(volume, sight, options) or chosen, options)
            if own is not None:
                return own
        # Bone whose density changes along it can look like two materials: the next reading takes both.
        doubtful = doubtful or (sight, chosen)
    if without_hole is not None and (
        doubtful is None or _is_likelier(without_hole, classify_piece(doubtful[0], doubtful[1].stapes))
    ):
        return without_hole
    if doubtful is not None:
        return _pick(volume, doubtful[0], options) or doubtful[1]
    if tried and options.seed_mm is not None:
        raise CtInertiaError(
            Fault(
                "{seed}",
                "a point inside the stapes, scan coordinates in mm",
                "a point without bone around it",
                next_step="Read the coordinates off the viewer (LPS, mm)",
            )
        )
    raise CtInertiaError(not_found_error(scan, tried, options.seed_mm is not None))


def _is_likelier(parted: CoarseSegmentation, whole: Piece) -> bool:
    """Return whether a part is a likelier stapes than the whole.

    What hangs at a neck makes a body longer: a body of one hole that is only thick or heavy is left whole. No
    other parting cuts it either, unless the part is likelier by what two bodies may differ.
    """
    stout = _complete(whole) and whole.length_mm <= TYPICAL_MM[0][1]
    gain = parted.stapes.score - whole.score
    return gain > RIVAL and (parted.cropped or not parted.at_neck) if stout else gain > 0.0


def _without_grown(
    volume: Volume, chosen: CoarseSegmentation, options: SearchOptions
) -> CoarseSegmentation | None:
    """Cut off what has grown onto a body of usual size, such as an incus; None where nothing has.

    An incus reaches further beyond the neck than a head does, or to the border of the scan.
    """
    scan, whole = chosen.scan, chosen.stapes

    def grown(neck: Neck) -> bool:
        return neck.narrow and (whole.at_border or neck.longer_than_head)

    inside = np.stack(np.nonzero(chosen.pieces[whole.box] == whole.label)[::-1], axis=1) + whole.low
    if not any(grown(neck) for neck in necks(inside * scan.spacing_mm, scan.spacing_mm)):
        return None
    for way in split_piece(volume, _grid(chosen), whole):
        if way.doubtful:
            continue
        if not (way.cropped or (way.neck is not None and grown(way.neck))):
            return None
        part = _trial(volume, chosen, way, chosen.others, options)
        if part is not None and part.stapes.arched and _is_usual(part.stapes):
            return part
    return None


def _refuse_two_ends(volume: Volume, chosen: CoarseSegmentation, options: SearchOptions) -> None:
    """Refuse a body that the border crops and that is a usual stapes before a neck, too, as with it."""
    way = next(split_piece(volume, _grid(chosen), chosen.stapes), None)
    part = _trial(volume, chosen, way, chosen.others, options) if way is not None and way.doubtful else None
    if part is None or part.stapes.at_border or not (part.stapes.arched and _is_usual(part.stapes)):
        return
    beyond = chosen.stapes.volume_mm3 - part.stapes.volume_mm3
    raise CtInertiaError(
        Fault(
            "the field of view",
            "larger than the stapes, and to show where it ends",
            f"a body of {chosen.stapes.volume_mm3:.2f} mm3 that the border of the scan crops; "
            f"{beyond:.2f} mm3 of it, before the border, may be another bone grown onto the stapes, such "
            "as the tip of the incus",
            next_step="Export 1 mm more beyond the head, or separate the two with {labels}",
        )
    )


def _grid(sight: CoarseSegmentation) -> CoarseGrid:
    return CoarseGrid(sight.pieces, sight.scan.step, sight.air, sight.bone, sight.between, sight.scan.noise)


def _trial(
    volume: Volume, sight: CoarseSegmentation, way: SplitPiece, rest: Sequence[Piece], options: SearchOptions
) -> CoarseSegmentation | None:
    """Choose the likeliest stapes among the parts of a piece and the rest; None when there is none."""
    trial = replace(
        sight,
        pieces=way.pieces,
        stapes=way.parts[0],
        others=(*way.parts[1:], *rest),
        markers=way.markers,
        method=way.method,
        neck=way.neck,
        cropped=way.cropped,
    )
    return _pick(volume, trial, options, alone=False)


def _at_own_level(
    volume: Volume, sight: CoarseSegmentation, options: SearchOptions
) -> CoarseSegmentation | None:
    """Take the threshold that fits the stapes' own bone, where the body is still a stapes there.

    None where its bone is brighter than the material taken for bone and the body is no stapes at its own
    level: the reading has taken plastic, or the blur around bone, for bone.
    """
    if options.threshold is not None:
        return sight
    trial = segment_at_local_threshold(
        sight, lambda pieces: _correct_border_flags(pieces, sight.scan, volume)
    )
    if trial is None:
        return sight
    best = classify_piece(trial, trial.stapes)
    if _is_usual(best) and best.arched:
        return replace(trial, stapes=best, notices=ambiguity_notices(best))
    return None if trial.between > sight.between else sight


def _shows_more_bone(
    later: CoarseSegmentation, doubtful: tuple[CoarseSegmentation, CoarseSegmentation] | None
) -> bool:
    """Return whether a later reading of the levels shows more of the bone that an earlier one found.

    A body of the usual size and shape that is whole but for the number of its holes stands, unless it is part
    of a larger one: what lies around it is no more than its own blur, and what shows elsewhere is plastic. So
    does a whole body that is only larger than usual, where the later reading cuts off nothing but its rim.
    """
    if doubtful is None:
        return True
    first = doubtful[1]
    before, after = first.pieces == first.stapes.label, later.pieces == later.stapes.label
    halo = max(1, round(_HALO_MM / float(first.scan.spacing_mm.mean())))
    if not _is_usual(first.stapes):
        whole = _complete(first.stapes)
        lost = np.count_nonzero(before & ~dilated(after, halo))
        rim_only = bool(lost <= _LEAST_BEYOND * np.count_nonzero(before))
        return not (whole and first.stapes.oddness < _ODD and rim_only)
    if np.count_nonzero(before & ~after) > _LEAST_BEYOND * np.count_nonzero(before):
        return False
    beyond = np.count_nonzero(after & ~dilated(before, halo))
    return bool(beyond > _LEAST_BEYOND * np.count_nonzero(after))


def _is_usual(piece: Piece) -> bool:
    return piece.possible and piece.oddness < USUAL and piece.surrounds < MOST_SURROUNDED


def _pick(
    volume: Volume, sight: CoarseSegmentation, options: SearchOptions, alone: bool = True
) -> CoarseSegmentation | None:
    if options.seed_mm is None:
        return _choose_piece(volume, sight, alone)
    return _take_seeded(sight, _coarse_index(volume, sight.scan, options.seed_mm))


def _part(volume: Volume, sight: CoarseSegmentation, options: SearchOptions) -> CoarseSegmentation | None:
    """Split the larger pieces where bones touch, and choose the likeliest stapes among the parts.

    A part without a hole, such as a stapes with one crus or a broken one, must be of usual size and shape.
    """
    scan, every = sight.scan, (sight.stapes, *sight.others)
    large = [classify_piece(sight, piece) for piece in every if piece.volume_mm3 > TYPICAL_MM3[0]]
    large.sort(key=lambda piece: piece.surrounds >= MOST_SURROUNDED)
    if options.seed_mm is not None and large:
        seeded = _take_seeded(sight, _coarse_index(volume, scan, options.seed_mm))
        large = [piece for piece in large if seeded is not None and piece.label == seeded.stapes.label]
    sights: list[CoarseSegmentation] = []
    for whole in large[:_MOST_WHOLES]:
        if sights and whole.surrounds >= MOST_SURROUNDED:
            break
        rest = [piece for piece in every if piece.label != whole.label]
        ways = []
        for way in split_piece(volume, _grid(sight), whole):
            if way.doubtful:
                continue
            chosen = _trial(volume, sight, way, rest, options)
            if chosen is None or chosen.stapes.at_border > whole.at_border:
                continue
            part = chosen.stapes
            if _complete(whole) and _cuts_the_stapes(way, chosen):
                continue
            bare = part.holes == 0 and not part.at_border and _is_usual(part)
            if not part.possible or part.oddness > _ODD or not (part.arched or bare):
                continue
            ways.append(chosen)
            if part.arched and _is_usual(part):
                break
        if ways:
            sights.append(max(ways, key=lambda way: way.stapes.score))
    if not sights:
        return None
    sights.sort(key=lambda way: -way.stapes.score)
    best = sights[0]
    if options.seed_mm is None:
        parts = [classify_piece(best, piece) for piece in best.others if piece.possible]
        rivals = [best.stapes, *[way.stapes for way in sights[1:]], *parts]
        refuse_rivals(rivals, _places_mm(volume, scan, rivals))
    return best


def _complete(whole: Piece) -> bool:
    """Return whether a body looks like a whole stapes, be it large or with something grown on."""
    return whole.arched and whole.surrounds < MOST_SURROUNDED


def _cuts_the_stapes(way: SplitPiece, chosen: CoarseSegmentation) -> bool:
    """Return whether a separation of a complete body has cut the stapes itself.

    Beside a body with the arch of a stapes that surrounds no other bone only the incus can be, and it is no
    stapes: the parting has more bones than these two, or two that can be the stapes.
    """
    stapes = chosen.stapes
    bones = [p for p in way.parts if p.label != stapes.label and p.volume_mm3 > MOST_WALL_MM3]
    rivals = (classify_piece(chosen, bone).score > stapes.score - RIVAL for bone in bones if bone.possible)
    return len(bones) > 1 or any(rivals)


def _correct_border_flags(pieces: list[Piece], scan: CoarseScan, volume: Volume) -> list[Piece]:
    """Correct the border flag: the coarse grid may miss the last voxels of the scan."""
    size = volume.size
    kept = []
    for piece in pieces:
        low, high = piece.low * scan.step + scan.step // 2, (piece.high - 1) * scan.step + scan.step // 2
        cut = np.any(low <= scan.step) or np.any(high >= size - 1 - scan.step)
        kept.append(replace(piece, at_border=bool(cut)))
    return kept


def _choose_piece(volume: Volume, sight: CoarseSegmentation, alone: bool = True) -> CoarseSegmentation | None:
    """Choose among the pieces that can be a stapes; None when there is none.

    With ``alone`` a second one that can be it as well is refused.
    """
    every = [sight.stapes, *sight.others]
    possible = [classify_piece(sight, piece) for piece in every if piece.possible]
    if not possible:
        return None
    possible.sort(key=lambda piece: -piece.score)
    best = possible[0]
    if alone:
        refuse_rivals(possible, _places_mm(volume, sight.scan, possible))
    others = tuple(p for p in every if p.label != best.label)
    return replace(sight, stapes=best, others=others, notices=ambiguity_notices(best))


def _take_seeded(sight: CoarseSegmentation, seed: NDArray[np.int64]) -> CoarseSegmentation | None:
    """Take the piece at the seed, or the nearest within a few coarse voxels; None where there is none."""
    reach = 3
    low = np.maximum(seed - reach, 0)
    box = tuple(slice(int(a), int(b) + reach + 1) for a, b in zip(low[::-1], seed[::-1], strict=True))
    near = sight.pieces[box]
    known = {p.label: p for p in (sight.stapes, *sight.others)}
    index = np.stack(np.nonzero(np.isin(near, list(known))), axis=1)
    if len(index) == 0:
        return None
    away = np.linalg.norm(index[:, ::-1] + low - seed, axis=1)
    label = int(near[tuple(index[int(np.argmin(away))])])
    others = tuple(p for p in known.values() if p.label != label)
    piece = classify_piece(replace(sight, stapes=known[label], others=others), known[label])
    return replace(sight, stapes=piece, others=others, notices=ambiguity_notices(piece))


def _places_mm(volume: Volume, scan: CoarseScan, pieces: list[Piece]) -> list[Array]:
    """Return the middle of each piece, scan coordinates, mm."""
    return [volume.scan_points(piece.centre * scan.step + scan.step // 2) for piece in pieces]


def _coarse_index(volume: Volume, scan: CoarseScan, point_mm: Array) -> NDArray[np.int64]:
    index = volume.index_points(point_mm)
    if np.any(index < -0.5) or np.any(index > volume.size - 0.5):
        corners = volume.scan_points(np.array([np.zeros(3), volume.size - 1.0]))
        low, high = corners.min(axis=0), corners.max(axis=0)
        reach = ", ".join(f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise CtInertiaError(
            Fault(
                "{seed}",
                f"inside the scan ({reach} mm)",
                ", ".join(f"{v:g}" for v in np.asarray(point_mm)),
                next_step="Give it in scan coordinates, mm",
            )
        )
    return np.clip(np.round((index - scan.step // 2) / scan.step), 0, None).astype(np.int64)

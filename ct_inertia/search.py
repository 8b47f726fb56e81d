"""Find the stapes and the plate in a coarse view of the scan."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.candidates import (
    MOST_SURROUNDED,
    TYPICAL_MM3,
    Piece,
    count_holes,
    labelled_pieces,
    surrounded,
)
from ct_inertia.coarse import CoarseScan, Glance, calmed, material_levels, take_glance
from ct_inertia.doubts import USUAL, doubts, refuse_rivals
from ct_inertia.errors import CtInertiaError
from ct_inertia.grids import dilated
from ct_inertia.parting import CoarseGrid, Markers, partings
from ct_inertia.volume import Volume
from kinematics.errors import sentence
from kinematics.notices import Notice

Array = NDArray[np.float64]
_ABOVE_PLASTIC = 0.35
_SHOWN = 4
_ODD = 0.3
_THIN_WALL = 0.42
_PLASTIC_MARGIN = 0.12
_MOST_WHOLES = 4


@dataclass(frozen=True)
class SearchOptions:
    """What a user can say about where the stapes is.

    Attributes
    ----------
    threshold : float or None
        Grey value between air and bone.
    seed_mm : ndarray, (3,), or None
        A point inside the stapes, scan coordinates.
    box_mm : ndarray, (6,), or None
        Two corners of the part of the scan to look at: x0, y0, z0, x1, y1, z1.
    labels : Volume or None
        A label volume made elsewhere; it says which voxels are stapes and plate.
    stapes_label, plate_label : int
        Their numbers in ``labels``.
    voxel_size_sd : float or None
        Relative standard uncertainty of the voxel size.
    """

    threshold: float | None = None
    seed_mm: Array | None = None
    box_mm: Array | None = None
    labels: Volume | None = None
    stapes_label: int = 1
    plate_label: int = 2
    voxel_size_sd: float | None = None


@dataclass(frozen=True)
class Sight:
    """What the coarse view shows.

    Attributes
    ----------
    scan : CoarseScan
    pieces : ndarray of int32, [z, y, x]
        Connected pieces of bone, coarse voxels.
    stapes : Piece
        The piece taken for the stapes; its ``label`` numbers it in ``pieces``.
    others : tuple of Piece
    air, bone : float
        First guess of the grey levels.
    plastic : float or None
    between : float
        Grey value above which a voxel counts as bone.
    markers : Markers or None
        Cores of the pieces, when they touch and had to be parted; numbered as in ``pieces``.
    method : str
        How the pieces were told apart.
    notices : tuple of Notice
    at_neck : bool
        They were parted by a plane at a neck.
    """

    scan: CoarseScan
    pieces: NDArray[np.int32]
    stapes: Piece
    others: tuple[Piece, ...]
    air: float
    bone: float
    plastic: float | None
    between: float
    markers: Markers | None = None
    method: str = "connected component"
    notices: tuple[Notice, ...] = field(default=())
    at_neck: bool = False


def look(volume: Volume, options: SearchOptions, glance: Glance | None = None) -> Sight:
    """Find the piece of bone that can be a stapes.

    Parameters
    ----------
    volume : Volume
    options : SearchOptions
    glance : Glance, optional
        The coarse view, when it was taken before.

    Raises
    ------
    CtInertiaError
        None can be one, or several can equally, or the seed lies in no bone; a wrong voxel size and
        inverted grey values are named as such.
    """
    glance = glance or take_glance(volume)
    scan, levels = glance.scan, glance.levels
    tried: list[Sight] = []
    doubtful: tuple[Sight, Sight] | None = None
    for air, plastic, bone in _readings(levels, options.threshold):
        between = options.threshold if options.threshold is not None else _between(air, plastic, bone)
        pieces, found = labelled_pieces(
            calmed(scan.grey, scan.noise / (bone - air)) > between, scan.spacing_mm
        )
        found = _whole(found, scan, volume)
        if not found:
            continue
        sight = Sight(scan, pieces, found[0], tuple(found[1:]), air, bone, plastic, between)
        tried.append(sight)
        chosen = _picked(volume, sight, options, alone=False)
        usual = chosen is not None and _usual(chosen.stapes)
        if not usual:
            parted = _parted(volume, sight, options)
            if parted is not None and (chosen is None or parted.stapes.score > chosen.stapes.score):
                return parted
        if chosen is None:
            continue
        if usual and chosen.stapes.holes == 1:
            return _picked(volume, sight, options) or chosen
        # Bone whose density changes along it can look like two materials: the next reading takes both.
        doubtful = doubtful or (sight, chosen)
    if doubtful is not None:
        return _picked(volume, doubtful[0], options) or doubtful[1]
    raise CtInertiaError(_nothing(scan, tried, options.seed_mm is not None))


def _usual(piece: Piece) -> bool:
    return piece.possible and piece.oddness < USUAL and piece.surrounds < MOST_SURROUNDED


def _picked(volume: Volume, sight: Sight, options: SearchOptions, alone: bool = True) -> Sight | None:
    if options.seed_mm is None:
        return _chosen(volume, sight, alone)
    return _seeded(sight, _coarse_index(volume, sight.scan, options.seed_mm))


def _parted(volume: Volume, sight: Sight, options: SearchOptions) -> Sight | None:
    """Part the larger pieces where they touch, and choose the likeliest stapes among the parts."""
    scan, every = sight.scan, (sight.stapes, *sight.others)
    large = [_judged(sight, piece) for piece in every if piece.volume_mm3 > TYPICAL_MM3[0]]
    large.sort(key=lambda piece: piece.surrounds >= MOST_SURROUNDED)
    if options.seed_mm is not None and large:
        seeded = _seeded(sight, _coarse_index(volume, scan, options.seed_mm)).stapes
        large = [piece for piece in large if piece.label == seeded.label]
    grid = CoarseGrid(sight.pieces, scan.step, sight.air, sight.bone, sight.between, scan.noise)
    found: list[Sight] = []
    for whole in large[:_MOST_WHOLES]:
        if found and whole.surrounds >= MOST_SURROUNDED:
            break
        rest = [piece for piece in every if piece.label != whole.label]
        ways = []
        for way in partings(volume, grid, whole):
            trial = replace(
                sight,
                pieces=way.pieces,
                stapes=way.parts[0],
                others=(*way.parts[1:], *rest),
                markers=way.markers,
                method=way.method,
                at_neck=way.neck_mm2 is not None,
            )
            chosen = _picked(volume, trial, options, alone=False)
            if chosen is None or chosen.stapes.at_border > whole.at_border:
                continue
            if chosen.stapes.holes != 1 or not chosen.stapes.possible or chosen.stapes.oddness > _ODD:
                continue
            ways.append(chosen)
            if chosen.stapes.holes == 1 and _usual(chosen.stapes):
                break
        if ways:
            found.append(max(ways, key=lambda way: way.stapes.score))
    if not found:
        return None
    found.sort(key=lambda way: -way.stapes.score)
    best = found[0]
    if options.seed_mm is None:
        parts = [_judged(best, piece) for piece in best.others if piece.possible]
        rivals = [best.stapes, *[way.stapes for way in found[1:]], *parts]
        refuse_rivals(rivals, _places_mm(volume, scan, rivals))
    return best


def _readings(levels: Array, threshold: float | None) -> list[tuple[float, float | None, float]]:
    """Return (air, plastic, bone) in the order to try: the brightest material is bone, or the next."""
    if threshold is not None:
        below, above = levels[levels < threshold], levels[levels >= threshold]
        if below.size == 0 or above.size == 0:
            raise CtInertiaError(
                sentence(
                    "--threshold",
                    f"between the grey levels of air and bone ({levels[0]:.6g} and {levels[-1]:.6g})",
                    f"{threshold:g}",
                    next_step="Read the two levels off the viewer, or leave --threshold out",
                )
            )
        plastic = float(below[-1]) if below.size > 1 else None
        return [(float(below[0]), plastic, float(above[-1]))]
    readings: list[tuple[float, float | None, float]] = []
    for k in range(len(levels) - 1, 0, -1):
        plastic = float(levels[k - 1]) if k > 1 else None
        readings.append((float(levels[0]), plastic, float(levels[k])))
    return readings


def _between(air: float, plastic: float | None, bone: float) -> float:
    middle = 0.5 * (air + bone)
    return middle if plastic is None else max(middle, plastic + _ABOVE_PLASTIC * (bone - plastic))


def _whole(found: list[Piece], scan: CoarseScan, volume: Volume) -> list[Piece]:
    """Correct the border flag: the coarse grid may miss the last voxels of the scan."""
    size = volume.size
    kept = []
    for piece in found:
        low, high = piece.low * scan.step + scan.step // 2, (piece.high - 1) * scan.step + scan.step // 2
        cut = np.any(low <= scan.step) or np.any(high >= size - 1 - scan.step)
        kept.append(replace(piece, at_border=bool(cut)))
    return kept


def _with_holes(sight: Sight, piece: Piece) -> Piece:
    if piece.holes is not None:
        return piece
    box = tuple(slice(a, b) for a, b in zip(piece.low[::-1], piece.high[::-1], strict=True))
    inside = sight.pieces[box] == piece.label
    holes = count_holes(inside)
    if (
        holes != 1
        and sight.scan.grey.shape == sight.pieces.shape
        and count_holes(_thick(sight, box, inside)) == 1
    ):
        holes = 1
    return replace(piece, holes=holes)


def _thick(sight: Sight, box: tuple[slice, ...], inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a piece with the darker voxels beside it: walls thinner than the blur are darker than bone."""
    contrast = sight.bone - sight.air
    low = sight.air + _THIN_WALL * contrast
    if sight.plastic is not None:
        low = max(low, sight.plastic + _PLASTIC_MARGIN * contrast)
    quiet = calmed(sight.scan.grey[box], sight.scan.noise / contrast)
    return np.asarray(inside | (dilated(inside, 2) & (quiet > low)))


def _judged(sight: Sight, piece: Piece) -> Piece:
    """Count its holes, and see whether it surrounds other bone."""
    holed = _with_holes(sight, piece)
    if holed.holes != 1 or not sight.others or holed.surrounds > 0.0:
        return holed
    return replace(holed, surrounds=surrounded(sight.pieces, holed))


def _chosen(volume: Volume, sight: Sight, alone: bool = True) -> Sight | None:
    """Choose among the pieces that can be a stapes; None when there is none.

    With ``alone`` a second one that can be it as well is refused.
    """
    every = [sight.stapes, *sight.others]
    possible = [_judged(sight, piece) for piece in every if piece.possible]
    if not possible:
        return None
    possible.sort(key=lambda piece: -piece.score)
    best = possible[0]
    if alone:
        refuse_rivals(possible, _places_mm(volume, sight.scan, possible))
    others = tuple(p for p in every if p.label != best.label)
    return replace(sight, stapes=best, others=others, notices=doubts(best))


def _seeded(sight: Sight, seed: NDArray[np.int64]) -> Sight:
    """Take the piece at the seed, or the nearest within a few coarse voxels."""
    reach = 3
    low = np.maximum(seed - reach, 0)
    box = tuple(slice(int(a), int(b) + reach + 1) for a, b in zip(low[::-1], seed[::-1], strict=True))
    near = sight.pieces[box]
    known = {p.label: p for p in (sight.stapes, *sight.others)}
    index = np.stack(np.nonzero(np.isin(near, list(known))), axis=1)
    if len(index) == 0:
        raise CtInertiaError(
            sentence(
                "--seed",
                "a point inside the stapes, scan coordinates in mm",
                "a point without bone around it",
                next_step="Read the coordinates off the viewer (LPS, mm)",
            )
        )
    away = np.linalg.norm(index[:, ::-1] + low - seed, axis=1)
    label = int(near[tuple(index[int(np.argmin(away))])])
    piece = _with_holes(sight, known[label])
    others = tuple(p for p in known.values() if p.label != label)
    return replace(sight, stapes=piece, others=others, notices=doubts(piece))


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
            sentence(
                "--seed",
                f"inside the scan ({reach} mm)",
                ", ".join(f"{v:g}" for v in np.asarray(point_mm)),
                next_step="Give it in scan coordinates, mm",
            )
        )
    return np.clip(np.round((index - scan.step // 2) / scan.step), 0, None).astype(np.int64)


def _nothing(scan: CoarseScan, tried: list[Sight], seeded: bool) -> str:
    """Say why no stapes was found, naming a wrong voxel size or inverted grey values when it is that."""
    wrong_size = _by_size(tried)
    if wrong_size:
        return wrong_size
    if not seeded and _inverted(scan):
        return sentence(
            "the grey values",
            "brighter in bone than in air",
            "a stapes that is darker than what surrounds it: they are inverted",
            next_step="Invert the image where it was exported",
        )
    seen: list[Any] = sorted(
        (p for sight in tried for p in (sight.stapes, *sight.others)), key=lambda p: -p.volume_mm3
    )[:_SHOWN]
    listed = "; ".join(f"{p.volume_mm3:.2f} mm3, {p.length_mm:.1f} mm long" for p in seen) or "no bone"
    return sentence(
        "the scan",
        "one with a body that can be a stapes (0.3 to 6 mm3, 2.2 to 5.8 mm long)",
        listed,
        next_step="Name it with --seed X,Y,Z (scan mm), give --threshold, or correct it with --labels",
    )


def _by_size(tried: list[Sight]) -> str:
    """Recognise a body of the right shape and the wrong size."""
    for sight in tried:
        for piece in (sight.stapes, *sight.others)[:6]:
            scale = piece.length_mm / 3.5
            if 0.6 < scale < 1.7 or piece.at_border:
                continue
            shrunk = replace(
                piece, volume_mm3=piece.volume_mm3 / scale**3, extents_mm=piece.extents_mm / scale
            )
            if shrunk.oddness < 0.2 and _with_holes(sight, piece).holes == 1:
                return sentence(
                    "the voxel spacing",
                    "right: a stapes is 3 to 4 mm high",
                    f"a body of its shape {piece.length_mm:.3g} mm high",
                    next_step=f"Correct it with --spacing (about {1.0 / scale:.3g} times the present one)",
                )
    return ""


def _inverted(scan: CoarseScan) -> bool:
    turned = replace(scan, grey=-scan.grey)
    try:
        levels = material_levels(turned)
    except CtInertiaError:
        return False
    for air, plastic, bone in _readings(levels, None):
        pieces, found = labelled_pieces(turned.grey > _between(air, plastic, bone), scan.spacing_mm)
        for piece in found:
            if piece.possible and piece.oddness < 0.3 and not np.any(piece.low == 0):
                sight = Sight(turned, pieces, piece, (), air, bone, plastic, 0.0)
                if _with_holes(sight, piece).holes == 1:
                    return True
    return False

"""Split one piece of the coarse segmentation where bones touch, on a finer grid, and return its parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.segment.ambiguity import USUAL
from legacy.ct_inertia.segment.candidates import (
    MOST_SURROUNDED,
    TYPICAL_MM3,
    Piece,
    describe,
    with_holes_of,
    within_hull,
)
from legacy.ct_inertia.segment.cropped_neighbours import cropped_separation
from legacy.ct_inertia.segment.necks import MOST_POINTS, Neck, necks
from legacy.ct_inertia.segment.touching_bones import VALLEY, Separation, relabel, separate_bones
from legacy.ct_inertia.volume.coarse_view import smooth_noise
from legacy.ct_inertia.volume.grid_operations import boxes_and_sizes, labelled
from legacy.ct_inertia.volume.mask_statistics import every_nth, look_up
from legacy.ct_inertia.volume.volume import Volume
from legacy.ct_inertia.volume.working_copy import Working, working_box
from legacy.stapeskit.arrays import Array

Index = NDArray[np.int64]

_FINER_MM = calibrated("parting.finer_mm")
# Margin of the box around the bones, the larger of both: room for their blur.
_MARGIN_MM = 0.1
_MARGIN_VOXELS = 3
# Most voxels of that box, 240 MB of float32; a larger box gets a coarser grid.
_MOST_VOXELS = 60_000_000
_LEAST_PART_MM3 = calibrated("parting.least_part_mm3")
_LEAST_UNITED_MM3 = calibrated("parting.least_united_mm3")
# Largest parts that are put together by twos and threes: 56 trials.
_MOST_UNITED = 7
_WHOLE = calibrated("parting.whole")
MOST_WALL_MM3 = calibrated("parting.most_wall_mm3")
# More of a wall of the stapes lies within the hull of the rest than outside, of other bone less.
# Half, by that meaning; not fitted. A loose fragment between the crura lies within it, too: see _contact_mm2.
_WALL_WITHIN = 0.5
_LEAST_CONTACT_MM2 = calibrated("neighbours.least_cut_mm2")
_NECK_ODDNESS = calibrated("parting.neck_oddness")


@dataclass(frozen=True)
class Markers:
    """Voxels that surely belong to one part or another, on a grid of their own.

    Attributes
    ----------
    labels : ndarray of int32, [z, y, x]
        Numbered as the pieces are; 0 where grey values decide.
    first : ndarray of int, (3,)
        Index x, y, z in the scan of the first voxel of the first block.
    step : ndarray of int, (3,)
        Voxels of the scan per block.
    """

    labels: NDArray[np.int32]
    first: Index
    step: Index


@dataclass(frozen=True)
class SplitPiece:
    """The parts of one piece of the coarse view.

    Attributes
    ----------
    pieces : ndarray of int32, [z, y, x]
        The coarse view's pieces, with the parts in place of the whole.
    parts : tuple of Piece
        Numbered as in ``pieces``, in coarse voxels, measured on the finer grid, holes counted.
    markers : Markers
    depth_mm : float
        How far from the narrow gaps the parts still hang together by themselves.
    neck : Neck or None
        The plane cut at a neck, where they were separated by one.
    cropped : bool
        The border of the scan crops the bone that was cut off.
    doubtful : bool
        The bone that was cut off may belong to the stapes.
    """

    pieces: NDArray[np.int32]
    parts: tuple[Piece, ...]
    markers: Markers
    depth_mm: float
    neck: Neck | None = None
    cropped: bool = False
    doubtful: bool = False

    @property
    def method(self) -> str:
        """How the parts were separated, in words."""
        if self.neck is not None:
            return f"parted at the neck of least cross-section ({self.neck.area_mm2:.2f} mm2) near an end"
        if self.cropped:
            return "parted along the darkest sheet before the border of the scan"
        return f"parted at necks: along narrow gaps, across bridges up to {2e3 * self.depth_mm:.0f} um"


@dataclass(frozen=True)
class CoarseGrid:
    """The coarse view's pieces, the voxels of the scan per coarse voxel, and the grey levels.

    ``between`` is the grey value above which a voxel counts as bone.
    """

    pieces: NDArray[np.int32]
    step: Index
    air: float
    bone: float
    between: float
    noise: float


def split_piece(volume: Volume, coarse: CoarseGrid, whole: Piece) -> Iterator[SplitPiece]:
    """Split one piece of the coarse view, on a finer grid, in every way that narrow gaps suggest.

    Parameters
    ----------
    volume : Volume
    coarse : CoarseGrid
    whole : Piece
        In coarse voxels.
    """
    step = coarse.step
    low, high = whole.low * step, np.minimum(whole.high * step, volume.size)
    finer = _FINER_MM
    while float(np.prod((high - low) * volume.spacing_mm + 2.0 * _MARGIN_MM)) / finer**3 > _MOST_VOXELS:
        finer *= 1.25
    working = working_box(volume, low, high, _MARGIN_MM, _MARGIN_VOXELS, finer)
    noise = coarse.noise if working.noise is None else working.noise
    contrast = coarse.bone - coarse.air
    grey = smooth_noise(working.grey, noise / contrast)
    held = [(grey - np.float32(coarse.air)) / np.float32(contrast)]
    spacing = working.volume.spacing_mm
    free = int(coarse.pieces.max())
    bone = _of_the_whole(grey > coarse.between, coarse, whole, working)
    solid = bone & (grey > coarse.air + VALLEY * contrast)
    # What follows looks at shares and masks: grey values on this grid have done their work.
    del grey
    ends = working.at_border(volume) if whole.at_border else None
    empty = np.broadcast_to(np.float32(0.0), working.shape)
    working = replace(working, volume=replace(working.volume, array=empty), single=None)
    for apart in _every_way(held, bone, spacing, whole, ends):
        way = _with_own_walls(apart, solid, spacing)
        # A small part is a part only at the border of the scan, which may have cropped a larger bone.
        placed = [(p, _in_coarse(p, working, volume, step)) for p in way.pieces]
        kept = [(p, q) for p, q in placed if p.volume_mm3 > _LEAST_PART_MM3 or q.at_border]
        counted = ((_count(way.labels, p, spacing) if p.possible else p, q) for p, q in kept)
        parts = tuple(
            replace(q, label=p.label + free, holes=p.holes, perforated=p.perforated) for p, q in counted
        )
        new = np.zeros(int(way.labels.max()) + 1, dtype=np.int32)
        new[[p.label for p, _ in kept]] = [p.label + free for p, _ in kept]
        labels = relabel(way.labels, new)
        pieces = _on_coarse(coarse, whole, labels, working)
        labels *= way.sure
        markers = Markers(labels, working.first, working.block)
        yield SplitPiece(pieces, parts, markers, way.depth_mm, way.neck, way.cropped, way.doubtful)
        del apart, way, labels, markers  # before the next way is looked for


def _of_the_whole(
    bone: NDArray[np.bool_], coarse: CoarseGrid, whole: Piece, working: Working
) -> NDArray[np.bool_]:
    """Leave out bone of other pieces that reaches into the box: its cut ends are nobody's shape."""
    own = working.from_coarse(coarse.pieces == whole.label, coarse.step) & bone
    other = working.from_coarse((coarse.pieces != 0) & (coarse.pieces != whole.label), coarse.step) & bone
    labels, count = labelled(bone)
    mine = np.bincount(labels[own], minlength=count + 1)
    kept = mine > np.bincount(labels[other], minlength=count + 1)
    kept[0] = False
    return look_up(labels, kept)


def _every_way(
    held: list[NDArray[np.float32]],
    bone: NDArray[np.bool_],
    spacing_mm: Array,
    whole: Piece,
    ends: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None,
) -> Iterator[Separation]:
    """Split a likely stapes at a neck near its end, and every piece along narrow gaps."""
    if whole.arched and whole.surrounds < MOST_SURROUNDED:
        cut = None if ends is None else cropped_separation(held[0], bone, spacing_mm, *ends)
        if cut is not None:
            yield cut
        yield from neck_separations(bone, spacing_mm)
    yield from _refine(separate_bones(held, bone, spacing_mm), spacing_mm)


def _cut_at_necks(way: Separation, spacing_mm: Array) -> Iterator[Separation]:
    """Cut the parts that have one hole, the likeliest stapes first, at their necks."""
    for piece in sorted((p for p in way.pieces if p.possible), key=lambda p: p.oddness):
        if piece.oddness > _NECK_ODDNESS or not _count(way.labels, piece, spacing_mm).arched:
            continue
        name = int(way.labels.max()) + 1
        for cut in neck_separations(way.labels == piece.label, spacing_mm):
            stapes, beyond = (
                replace(p, label=k) for p, k in zip(cut.pieces, (piece.label, name), strict=True)
            )
            labels = np.where(cut.labels == 2, np.int32(name), way.labels)
            rest = [p for p in way.pieces if p.label != piece.label]
            yield Separation(way.depth_mm, labels, way.sure, [stapes, beyond, *rest], cut.neck)


def neck_separations(bone: NDArray[np.bool_], spacing_mm: Array) -> Iterator[Separation]:
    """Cut bone by a plane at each of its necks, where what is left can be a stapes."""
    places = every_nth(bone, 1)
    count, some = len(places), places
    if count > MOST_POINTS:
        some = np.random.default_rng(0).choice(places, MOST_POINTS, replace=False)
    points = np.stack(np.unravel_index(some, bone.shape)[::-1], axis=1) * spacing_mm
    del places, some
    z, y, x = (np.arange(n) * h for n, h in zip(bone.shape, spacing_mm[::-1], strict=True))
    least, most = TYPICAL_MM3[0] * np.exp(-USUAL), TYPICAL_MM3[1] * np.exp(USUAL)
    for neck in necks(points, spacing_mm, count):
        labels = bone.astype(np.int32)
        across = neck.normal[0] * x + (neck.normal[1] * y)[:, None]
        left = count
        for layer, inside, height in zip(labels, bone, neck.normal[2] * z, strict=True):
            beyond = inside & (across > neck.height_mm - height)
            layer[beyond] = 2
            left -= int(np.count_nonzero(beyond))
        # Its volume alone makes a piece unusual: the rest need not be known.
        if not least <= left * float(np.prod(spacing_mm)) <= most:
            continue
        boxes, _ = boxes_and_sizes(labels, 2)
        pieces = [describe(labels, k, boxes[k - 1] or (), spacing_mm) for k in (1, 2)]
        if pieces[0].possible and pieces[0].oddness < USUAL:
            yield Separation(0.0, labels, bone, pieces, neck)


def _refine(ways: Iterator[Separation], spacing_mm: Array) -> Iterator[Separation]:
    """Cut a part at its neck, or put two or three together, where none is a stapes by itself and that is.

    A distance from the gaps that parts wide bridges may part the footplate from the crura too.
    """
    for way in ways:
        yield way
        if any(
            p.possible and p.oddness < USUAL and _count(way.labels, p, spacing_mm).arched for p in way.pieces
        ):
            continue
        yield from _cut_at_necks(way, spacing_mm)
        parts = [p for p in way.pieces if p.volume_mm3 > _LEAST_UNITED_MM3][:_MOST_UNITED]
        best: tuple[Piece, NDArray[np.int32]] | None = None
        for count in (2, 3):
            for some in combinations(parts, count):
                united = _unite(way.labels, some, spacing_mm)
                if united is not None and (best is None or united[0].score > best[0].score):
                    best = united
        if best is not None:
            whole, labels = best
            rest = [p for p in way.pieces if np.any(labels == p.label) and p.label != whole.label]
            yield Separation(way.depth_mm, labels, way.sure, [whole, *rest])


def _with_own_walls(way: Separation, solid: NDArray[np.bool_], spacing_mm: Array) -> Separation:
    """Give the stapes back what lies within its own hull and hangs together with it.

    A gutter of a crus is a narrow gap as well, along which its wall is separated from the rest; at its ends
    ``solid`` bone [z, y, x] joins the two. A loose fragment between the crura has a valley all around.
    """
    small = [p for p in way.pieces if _LEAST_PART_MM3 < p.volume_mm3 < MOST_WALL_MM3]
    usual = sorted((p for p in way.pieces if p.possible and p.oddness < USUAL), key=lambda p: p.oddness)
    stapes = next((p for p in usual if _count(way.labels, p, spacing_mm).arched), None)
    if not small or stapes is None or way.neck is not None:
        return way
    walls = [
        p
        for p in small
        if _contact_mm2(way.labels, solid, (stapes, p), spacing_mm) > _LEAST_CONTACT_MM2
        and within_hull(way.labels, stapes, p) > _WALL_WITHIN
    ]
    if not walls:
        return way
    name = np.arange(int(way.labels.max()) + 1)
    name[[p.label for p in walls]] = stapes.label
    labels = relabel(way.labels, name)
    low = np.min([p.low for p in (stapes, *walls)], axis=0)
    high = np.max([p.high for p in (stapes, *walls)], axis=0)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    united = describe(labels, stapes.label, box, spacing_mm)
    if not united.possible or not _count(labels, united, spacing_mm).arched:
        return way
    kept = [p for p in way.pieces if p.label != stapes.label and all(p is not wall for wall in walls)]
    return replace(way, labels=labels, pieces=[united, *kept])


def _contact_mm2(
    labels: NDArray[np.int32], solid: NDArray[np.bool_], both: tuple[Piece, Piece], spacing_mm: Array
) -> float:
    """Return the area over which two parts touch in solid bone; the second is the smaller one."""
    one, other = both
    box = tuple(
        slice(max(0, int(a) - 1), int(b) + 1) for a, b in zip(other.low[::-1], other.high[::-1], strict=True)
    )
    part = labels[box] * solid[box]
    area = 0.0
    for axis, spacing in enumerate(spacing_mm[::-1]):
        moved = np.moveaxis(part, axis, 0)
        low, high = moved[:-1], moved[1:]
        faces = (low == one.label) & (high == other.label) | (low == other.label) & (high == one.label)
        area += int(np.count_nonzero(faces)) * float(np.prod(spacing_mm) / spacing)
    return area


def _unite(
    labels: NDArray[np.int32], some: tuple[Piece, ...], spacing_mm: Array
) -> tuple[Piece, NDArray[np.int32]] | None:
    """Return the union of parts when it hangs together and can be a stapes, and the labels with it."""
    if not TYPICAL_MM3[0] <= sum(p.volume_mm3 for p in some) <= TYPICAL_MM3[1]:
        return None
    low = np.min([p.low for p in some], axis=0)
    high = np.max([p.high for p in some], axis=0)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    mask = np.isin(labels[box], [p.label for p in some])
    if labelled(mask)[1] > 1 and _largest_share(mask) < _WHOLE:
        return None
    name = some[0].label
    joined = labels.copy()
    joined[box][mask] = name
    piece = describe(joined, name, box, spacing_mm)
    if not piece.possible or piece.oddness > USUAL:
        return None
    piece = _count(joined, piece, spacing_mm)
    return (piece, joined) if piece.arched else None


def _largest_share(mask: NDArray[np.bool_]) -> float:
    sizes = boxes_and_sizes(*labelled(mask))[1][1:]
    return float(sizes.max() / sizes.sum())


def _count(labels: NDArray[np.int32], piece: Piece, spacing_mm: Array) -> Piece:
    return with_holes_of(piece, labels[piece.box] == piece.label, spacing_mm)


def _in_coarse(piece: Piece, working: Working, volume: Volume, step: Index) -> Piece:
    """Return the piece with its place in coarse voxels; whether the scan cuts it is found anew."""
    low = working.first + piece.low * working.block
    high = working.first + piece.high * working.block
    centre = working.first + (piece.centre + 0.5) * working.block - 0.5
    cut = np.any(low < working.block) or np.any(high > volume.size - working.block)
    return replace(
        piece,
        low=low // step,
        high=-(-high // step),
        centre=(centre - step // 2) / step,
        at_border=bool(cut),
    )


def _on_coarse(
    coarse: CoarseGrid, whole: Piece, labels: NDArray[np.int32], working: Working
) -> NDArray[np.int32]:
    """Return the coarse pieces with the parts' numbers where the whole was."""
    pieces = coarse.pieces.copy()
    size = np.array(labels.shape[::-1])
    x, y, z = (
        np.clip((np.arange(a, b) * n + n // 2 - first) // block, 0, most - 1)
        for a, b, n, first, block, most in zip(
            whole.low, whole.high, coarse.step, working.first, working.block, size, strict=True
        )
    )
    low, high = whole.low, whole.high
    part = pieces[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    for layer, at in zip(part, z, strict=True):
        own = layer == whole.label
        layer[own] = labels[at][np.ix_(y, x)][own]
    return pieces

"""Segment the chosen body once more at the level half way between air and its own bone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from legacy.ct_inertia.segment.candidates import Piece, labelled_pieces
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation, between_levels
from legacy.ct_inertia.volume.coarse_view import smooth_noise
from legacy.ct_inertia.volume.grid_operations import eroded

# Interior voxels from which a level can be read.
_LEAST_DEEP = 50
# Blur lowers the outer voxels of the interior: its brighter quarter begins at the level of bone.
_INTERIOR_PERCENTILE = 75.0
# A threshold that differs by this share of the contrast moves a surface by an eighth of the blur's width
# (sqrt(2 pi) times the share), less than the coarse view resolves.
_SAME_THRESHOLD = 0.05


def segment_at_local_threshold(
    sight: CoarseSegmentation, find_pieces: Callable[[list[Piece]], list[Piece]]
) -> CoarseSegmentation | None:
    """Return the body that holds the chosen one at the threshold that fits its own bone.

    The brightest class of the histogram may be bone of another density, so the first threshold may be far
    from the middle of the chosen body's edges.

    Parameters
    ----------
    sight : CoarseSegmentation
        With a body that was taken for the stapes.
    find_pieces : callable
        Corrects the border flags of labelled pieces.

    Returns
    -------
    CoarseSegmentation or None
        None where the threshold hardly changes, or where no body holds the chosen one at the other.
    """
    own = sight.pieces == sight.stapes.label
    bone = _bone_of(sight)
    if bone is None:
        return None
    plastic = None if sight.plastic is None or sight.plastic >= bone else sight.plastic
    between = between_levels(sight.air, plastic, bone)
    if not bone > sight.air or abs(between - sight.between) < _SAME_THRESHOLD * (bone - sight.air):
        return None
    quiet = smooth_noise(sight.scan.grey, sight.scan.noise / (bone - sight.air))
    pieces, candidates = labelled_pieces(quiet > between, sight.scan.spacing_mm)
    votes = np.bincount(pieces[own], minlength=1)
    votes[0] = 0
    candidates = find_pieces(candidates)
    same = [piece for piece in candidates if piece.label == int(np.argmax(votes))]
    if not same:
        return None
    others = tuple(piece for piece in candidates if piece is not same[0])
    return replace(
        sight, pieces=pieces, stapes=same[0], others=others, bone=bone, plastic=plastic, between=between
    )


def takes_soft_for_bone(sight: CoarseSegmentation) -> bool:
    """Return whether the material that was taken for bone lies below the middle level of the body's own bone.

    No bone is half as dense as another: the body holds plastic, or fluid that fills its gaps.
    """
    bone = _bone_of(sight)
    return bone is not None and bool(sight.bone < 0.5 * (sight.air + bone))


def _bone_of(sight: CoarseSegmentation) -> float | None:
    """Return the grey level of the chosen body's own bone; None where too little of it is deep."""
    deep = sight.scan.grey[eroded(sight.pieces == sight.stapes.label)]
    return float(np.percentile(deep, _INTERIOR_PERCENTILE)) if deep.size >= _LEAST_DEEP else None

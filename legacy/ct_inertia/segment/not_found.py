"""Why no stapes was found: a wrong voxel size, inverted grey values, or nothing like one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.segment.candidates import Piece, labelled_pieces
from legacy.ct_inertia.segment.coarse_segmentation import (
    CoarseSegmentation,
    between_levels,
    count_piece_holes,
    level_hypotheses,
)
from legacy.ct_inertia.volume.coarse_view import CoarseScan, material_levels
from legacy.stapeskit.faults import Fault

# Bodies that a message lists.
_SHOWN = 4


def not_found_error(scan: CoarseScan, tried: Sequence[CoarseSegmentation], seeded: bool) -> Fault:
    """Return the error that no stapes was found, with its cause: wrong voxel size, inverted grey values."""
    wrong_size = _by_size(tried)
    if wrong_size:
        return wrong_size
    if not seeded and _is_inverted(scan):
        return Fault(
            "the grey values",
            "brighter in bone than in air",
            "a stapes that is darker than what surrounds it: they are inverted",
            next_step="Invert the image where it was exported",
        )
    seen: list[Piece] = sorted(
        (p for sight in tried for p in (sight.stapes, *sight.others)), key=lambda p: -p.volume_mm3
    )[:_SHOWN]
    listed = "; ".join(f"{p.volume_mm3:.2f} mm3, {p.length_mm:.1f} mm long" for p in seen) or "no bone"
    return Fault(
        "the scan",
        "one with a body that can be a stapes (0.3 to 6 mm3, 2.2 to 5.8 mm long)",
        listed,
        next_step="Name it with {seed} X,Y,Z (scan mm), give {threshold}, or correct it with {labels}",
    )


def _by_size(tried: Sequence[CoarseSegmentation]) -> Fault | None:
    """Recognise a body of the right shape and the wrong size."""
    for sight in tried:
        for piece in (sight.stapes, *sight.others)[:6]:
            scale = piece.length_mm / 3.5
            if 0.6 < scale < 1.7 or piece.at_border:
                continue
            shrunk = replace(
                piece, volume_mm3=piece.volume_mm3 / scale**3, extents_mm=piece.extents_mm / scale
            )
            if shrunk.oddness < 0.2 and count_piece_holes(sight, piece).holes == 1:
                return Fault(
                    "the voxel spacing",
                    "right: a stapes is 3 to 4 mm high",
                    f"a body of its shape {piece.length_mm:.3g} mm high",
                    next_step=f"Correct it with {{spacing}} (about {1.0 / scale:.3g} times the present one)",
                )
    return None


def _is_inverted(scan: CoarseScan) -> bool:
    turned = replace(scan, grey=-scan.grey)
    try:
        levels = material_levels(turned)
    except CtInertiaError:
        return False
    for air, plastic, bone in level_hypotheses(levels, None):
        pieces, bodies = labelled_pieces(turned.grey > between_levels(air, plastic, bone), scan.spacing_mm)
        for piece in bodies:
            if piece.possible and piece.oddness < 0.3 and not np.any(piece.low == 0):
                sight = CoarseSegmentation(turned, pieces, piece, (), air, bone, plastic, 0.0)
                if count_piece_holes(sight, piece).holes == 1:
                    return True
    return False

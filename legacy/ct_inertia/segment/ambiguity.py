"""Doubts about which piece of bone is the stapes: two that can be it, and one that is unusual for it."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.segment.candidates import MOST_SURROUNDED, Piece
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Volume and extents of a stapes that nobody would call unusual; see ``Piece.oddness``.
USUAL = calibrated("doubts.usual")
RIVAL = calibrated("doubts.rival")
# Bodies that a message lists.
_SHOWN = 4


def refuse_rivals(possible: list[Piece], places_mm: list[Array]) -> None:
    """Refuse two bodies that can be the stapes equally well; the likeliest comes first.

    A body that was separated in two ways is one: its middles lie within half of its shortest extent.

    Parameters
    ----------
    possible : list of Piece
    places_mm : list of ndarray, (3,)
        The middle of each, scan coordinates.
    """
    one = 0.5 * float(possible[0].extents_mm[-1])
    rivals = [
        f"{piece.volume_mm3:.2f} mm3 around {', '.join(f'{v:.2f}' for v in place)} mm"
        for piece, place in zip(possible, places_mm, strict=True)
        if piece is possible[0]
        or (piece.score > possible[0].score - RIVAL and np.linalg.norm(place - places_mm[0]) > one)
    ]
    if len(rivals) > 1:
        raise CtInertiaError(
            Fault(
                "the scan",
                "a scan with one body that can be the stapes",
                f"{len(rivals)}: {'; '.join(rivals[:_SHOWN])}",
                next_step="Name one with {seed} X,Y,Z (a point inside it, scan mm) or {box}",
            )
        )


def ambiguity_notices(piece: Piece) -> tuple[Notice, ...]:
    """Return what speaks against a piece that was taken for the stapes."""
    notices = []
    if piece.holes != 1:
        text = (
            f"The body taken for the stapes has {piece.holes} holes instead of one between its crura "
            f"({piece.volume_mm3:.2f} mm3, {piece.length_mm:.1f} mm long). Check it in the report."
        )
        notices.append(Notice("stapes_uncertain", text))
    elif piece.surrounds >= MOST_SURROUNDED:
        text = (
            f"The body taken for the stapes ({piece.volume_mm3:.2f} mm3) surrounds other bone, as the bone "
            f"around the oval window does. Check it in the report, or name the stapes with {named('seed')}."
        )
        notices.append(Notice("stapes_uncertain", text))
    elif piece.oddness > USUAL:
        extents = " x ".join(f"{v:.1f}" for v in piece.extents_mm)
        text = (
            f"The body taken for the stapes is unusual for one ({piece.volume_mm3:.2f} mm3, {extents} mm). "
            f"Check it in the report, and the voxel spacing."
        )
        notices.append(Notice("stapes_uncertain", text))
    return tuple(notices)

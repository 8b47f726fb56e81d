"""Why a scan is refused: no stapes, a wrong unit, inverted or set grey values, a body that is cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ct_inertia.bodies import Box, Mask
from ct_inertia.find.levels import material_levels, readings
from ct_inertia.find.overview import Overview, is_set
from ct_inertia.find.pieces import USUAL, Piece, label_pieces, size_score
from ct_inertia.voxels.masks import grown
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError
from stapeskit.warnings import Notice

_PICTURE_MM = 10.0  # width of a picture in which bodies are described to find a wrong unit
_TRIED, _SHOWN = 6, 4  # bodies whose shape is looked at, and that a message lists
_LENGTH_MM = 3.5  # of a stapes
_UNITS = {1e-3: "micrometres", 10.0: "centimetres", 25.4: "inches", 1e3: "metres"}
"""What a spacing may have been given in, by the millimetres of one unit."""

_COLLAR_VOXELS, _MOST_UNMEASURED = 4, 0.5  # around the stapes: its blur, of which half must be measured
_LEAST_SET = 0.05  # share of the air of a box that has one value, which somebody has set


def no_stapes(overview: Overview, tried: Sequence[Piece]) -> StapeskitError:
    """Return the error that no stapes was found, with its cause."""
    grid = overview.grid
    size, voxel = (
        " x ".join(f"{v:.4g}" for v in lengths)
        for lengths in (grid.size * grid.spacing_mm, grid.spacing_mm / grid.block)
    )
    picture = f"a picture of {size} mm with voxels of {voxel} mm"
    fault = _wrong_scale(overview, picture)
    if fault is None and _is_inverted(overview):
        fault = Fault(
            "the grey values",
            "brighter in bone than in air",
            "a stapes that is darker than what surrounds it: they are inverted",
            next_step="Invert the image where it was exported",
        )
    if fault is None:
        seen = sorted(tried, key=lambda p: -p.volume_mm3)[:_SHOWN]
        listed = "; ".join(f"{p.volume_mm3:.3g} mm3, {p.length_mm:.3g} mm long" for p in seen) or "no bone"
        fault = Fault(
            "the scan",
            "one with a body that can be a stapes (0.3 to 6 mm3, 2.2 to 5.8 mm long)",
            f"{picture}, and in it {listed}",
            next_step="Check the voxel size (--spacing); name the body with --seed X,Y,Z (scan mm) or --box, "
            "or correct it with --labels",
        )
    return StapeskitError(fault)


def _wrong_scale(overview: Overview, picture: str) -> Fault | None:
    """Recognise a body of the right shape and the wrong size, or a picture of the wrong size for an ear."""
    grid = overview.grid
    width = float(np.min(grid.spacing_mm * grid.size))
    # In a picture of the size of an ear every body that can be a stapes is described.
    scaled = replace(grid, spacing_mm=grid.spacing_mm * (_PICTURE_MM / width))
    for reading in readings(overview.levels):
        for piece in label_pieces(overview.above(reading.between, reading.contrast), scaled)[:_TRIED]:
            length = piece.length_mm * width / _PICTURE_MM
            scale = length / _LENGTH_MM
            change = _LENGTH_MM / piece.length_mm
            likely = size_score(piece.volume_mm3 * change**3, piece.extents_mm * change) > -USUAL
            if likely and not (0.6 < scale < 1.7 or piece.at_border) and piece.holes == 1:
                unit = next((factor for factor in _UNITS if 0.6 < scale * factor < 1.7), None)
                times = unit or 1.0 / scale
                guess = "" if unit is None else f"; the spacing may be in {_UNITS[unit]}"
                return Fault(
                    "the voxel spacing",
                    "right, in millimetres: a stapes is 3 to 4 mm high",
                    f"{picture} and a body of its shape {length:.3g} mm high{guess}",
                    next_step=f"Correct it with --spacing (about {times:.4g} times the present one)",
                )
    if not 1.0 < float(np.max(grid.spacing_mm * grid.size)) < 500.0:
        return Fault(
            "the voxel spacing",
            "in millimetres: a scan of a stapes is 4 to 100 mm wide",
            picture,
            next_step="State the voxel size in mm with --spacing",
        )
    return None


def _is_inverted(overview: Overview) -> bool:
    """Return whether the grey values, turned over, show a stapes."""
    grey = -overview.grey
    levels = material_levels(grey, overview.noise, overview.grid.voxel_mm3, overview.unmeasured)
    return any(
        piece.possible and piece.whole_stapes
        for reading in (readings(levels) if len(levels) > 1 else ())
        for piece in label_pieces(grey > np.float32(reading.between), overview.grid)
    )


def no_bone_at_seed(seed_mm: Array | None) -> StapeskitError:
    """Return the error that a seed lies in no bone that can hold a stapes."""
    place = "" if seed_mm is None else ", ".join(f"{v:g}" for v in np.asarray(seed_mm))
    return StapeskitError.of(
        "--seed",
        "a point inside the stapes, scan coordinates in mm",
        f"{place}: without bone around it that can be one",
        next_step="Read the coordinates off the viewer (LPS, mm)",
    )


def rivals_fault(equal: Sequence[Piece]) -> Fault:
    """Return the fault that several bodies can be the stapes equally well."""
    listed = "; ".join(
        f"{piece.volume_mm3:.2f} mm3 around {', '.join(f'{v:.2f}' for v in piece.centre_mm)} mm"
        for piece in equal[:_SHOWN]
    )
    return Fault(
        "the scan",
        "one with a single body that can be the stapes",
        f"{len(equal)}: {listed}",
        next_step="Name one with --seed X,Y,Z (a point inside it, scan mm) or --box",
    )


def check_not_open(body: Piece, named: bool) -> None:
    """Refuse a body that the border of the scan crops and that has no size of a stapes.

    Raises
    ------
    StapeskitError
        The field of view ends within the body, and nobody named it.
    """
    if named or not body.at_border or body.usual:
        return
    extents = " x ".join(f"{v:.2g}" for v in body.extents_mm)
    raise StapeskitError.of(
        "the field of view",
        "larger than the stapes, and to show where it ends",
        f"a body of {body.volume_mm3:.2f} mm3 ({extents} mm) that the border of the scan crops",
        next_step="Export 1 mm more around the stapes, or separate it from other bone with --labels",
    )


def unusual_notice(piece: Piece) -> tuple[Notice, ...]:
    """Return what speaks against a piece that was taken for the stapes."""
    extents = " x ".join(f"{v:.1f}" for v in piece.extents_mm)
    size = f"{piece.volume_mm3:.2f} mm3, {extents} mm"
    if not piece.arched:
        text = f"The body taken for the stapes has {piece.holes} holes, not one between its crura ({size})."
    elif not piece.usual:
        text = f"The body taken for the stapes is unusual for one ({size}): check it, and the voxel spacing."
    else:
        return ()
    return (Notice("stapes_uncertain", text + " Look at it in the report; name another one with --seed."),)


def check_background(box: Box, stapes: Mask, bodies: Mask, air: float, bone: float) -> None:
    """Refuse a scan whose background was set to a constant close around the stapes.

    Raises
    ------
    StapeskitError
        The blur of the stapes, or the air around it, is not in the scan.
    """
    collar = stapes
    for _ in range(_COLLAR_VOXELS):
        collar = grown(collar)
    collar = collar & ~bodies
    measured = np.ones(box.shape, dtype=bool) if box.measured is None else box.measured
    lost = 1.0 - float(np.mean(measured[collar])) if collar.any() else 0.0
    got = f"a constant in {100.0 * lost:.0f} % of the voxels next to it"
    if lost <= _MOST_UNMEASURED:
        dark = box.stored[measured & ~bodies & (box.grey < 0.5 * (air + bone))]
        found = is_set(dark.astype(np.float32), bone - air)
        if found is None or found[1] <= _LEAST_SET:
            return
        got = f"{found[0]:g} in {100.0 * found[1]:.0f} % of the voxels around it"
    raise StapeskitError.of(
        "the scan",
        "one that shows the air around the stapes and the blur of its edges",
        f"{got}: a program has set the background, or the field of view is as narrow as the bone",
        next_step="Give the scan as it was reconstructed; --labels takes a segmentation of it",
    )

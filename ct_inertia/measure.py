"""Measure the stapes that was cut out: levels, blur, the voxels that are its own, and its moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Levels, PlateFace
from ct_inertia.cutting import Cut
from ct_inertia.distance import capped_distance
from ct_inertia.levels import Air, Bone, Guess, Surroundings, as_levels, measure_air, measure_bone
from ct_inertia.moments import Moments
from ct_inertia.partial_volume import Share, partial_volume_moments
from ct_inertia.psf import edge_sigma
from ct_inertia.separate import flooded
from ct_inertia.volume import Volume
from kinematics.notices import Notice

Array = NDArray[np.float64]

# The blur of a plane edge beyond 4.2 widths holds 3e-6 of a width.
_TAIL_SIGMAS = 4.2
_DEFAULT_SIGMA_VOXELS = 1.0


@dataclass(frozen=True)
class Measured:
    """What was measured of the stapes.

    Attributes
    ----------
    moments : Moments
    levels : Levels
    sigma_mm : float
    sigma_from : str
    share : ndarray of float32, [z, y, x]
        Share of bone in the cut's box; 0 outside the stapes' own voxels.
    own : ndarray of bool, [z, y, x]
        Voxels over which was integrated.
    plate_face : PlateFace or None
    correlation, air_clipped : float
    notices : tuple of Notice
    """

    moments: Moments
    levels: Levels
    sigma_mm: float
    sigma_from: str
    share: NDArray[np.float32]
    own: NDArray[np.bool_]
    plate_face: PlateFace | None
    correlation: float
    air_clipped: float
    notices: tuple[Notice, ...] = ()


def measure(volume: Volume, cut: Cut, guess: Guess) -> Measured:
    """Measure levels and blur near the stapes and integrate its grey values.

    Raises
    ------
    CtInertiaError
        The grey values of the body sum to no positive volume.
    """
    spacing = volume.spacing_mm
    foreign = cut.others | cut.plate
    stapes = cut.stapes
    sigma, sigma_sd, sigma_from = _blur(cut, stapes, guess.air, guess.bone, spacing)
    reach = _TAIL_SIGMAS * sigma + float(spacing.max())
    outer = reach + 9.5 * float(spacing.max())
    around = Surroundings(cut.grey, stapes, foreign, spacing)
    distance = capped_distance(stapes, spacing, outer)
    air = measure_air(around, distance, reach, guess.air)
    bone = measure_bone(around, air, sigma) or _shallow_bone(cut, stapes, air)
    sigma, sigma_sd, sigma_from = _blur(cut, stapes, air.level, bone.level, spacing)
    own = own_voxels(cut, distance, reach, spacing)
    values = cut.grey[own].astype(float)
    index = np.stack(np.nonzero(own)[::-1], axis=1) + cut.first.astype(float)
    noise = np.where(stapes[own], bone.noise, air.noise)
    share = Share(
        index, values, noise, air.level, bone.level, air.sd, bone.sd, sigma, sigma_sd, air.correlation
    )
    moments = partial_volume_moments(share, volume.scan_from_index)
    field = np.where(own, (cut.grey - air.level) / (bone.level - air.level), 0.0).astype(np.float32)
    return Measured(
        moments,
        as_levels(air, bone, guess.plastic),
        sigma,
        sigma_from,
        field,
        own,
        None,
        air.correlation,
        air.clipped,
        (*bone.notices, *_air_notices(air, bone)),
    )


def own_voxels(
    cut: Cut, distance_mm: NDArray[np.float32], reach_mm: float, spacing_mm: Array
) -> NDArray[np.bool_]:
    """Return the voxels whose grey values belong to the stapes: its basin within reach of its blur.

    Where other bone is within twice that reach, the border is the watershed of the grey values between the
    bodies: there the tails of their blur swap, and what each loses it gets back.
    """
    reach = distance_mm <= reach_mm
    if not np.any(cut.others & (distance_mm < 2.0 * reach_mm)):
        return np.asarray(reach)
    near = capped_distance(cut.others, spacing_mm, reach_mm) <= reach_mm
    markers = cut.stapes.astype(np.int32) + 2 * cut.others.astype(np.int32)
    basins = flooded(cut.grey, markers, (reach & near) | (markers > 0))
    return np.asarray(reach & (~near | (basins == 1)))


def _blur(
    cut: Cut, stapes: NDArray[np.bool_], air: float, bone: float, spacing_mm: Array
) -> tuple[float, float, str]:
    from scipy.ndimage import binary_dilation

    rim = binary_dilation(stapes, iterations=2)
    found = edge_sigma(cut.grey, rim, air, bone, spacing_mm)
    if found is None:
        sigma = _DEFAULT_SIGMA_VOXELS * float(spacing_mm.mean())
        return sigma, 0.5 * sigma, "assumed: one voxel"
    return found[0], found[1], "edges of the stapes"


def _shallow_bone(cut: Cut, stapes: NDArray[np.bool_], air: Air) -> Bone:
    """Fall back on the brightest voxels when the body has no inside deeper than its blur."""
    values = cut.grey[stapes].astype(float)
    level = float(np.percentile(values, 97.0))
    text = (
        "The stapes has hardly a voxel deeper than the blur of the scan: its bone level is a guess from its "
        "brightest voxels, and volume and mass are uncertain by several percent. Scan with smaller voxels."
    )
    return Bone(level, 0.03 * (level - air.level), air.noise, "brightest", (Notice("bone_level_weak", text),))


def _air_notices(air: Air, bone: Bone) -> list[Notice]:
    if air.clipped == 0.0:
        return []
    share = 100.0 * air.clipped
    shift = 30.0 * air.noise / (bone.level - air.level)
    text = (
        f"{share:.0f} % of the air voxels lie at the lowest grey value: the export has clipped the noise, "
        f"which shifts the volume by up to {shift:.1f} %. Export with an offset that keeps air above 0."
    )
    return [Notice("air_clipped", text)]


def border_notices(volume: Volume, cut: Cut) -> list[Notice]:
    """Warn when the stapes reaches the first or last voxel of the scan."""
    index = np.stack(np.nonzero(cut.stapes)[::-1], axis=1)
    low, high = index.min(axis=0) + cut.first, index.max(axis=0) + cut.first
    if np.all(low > 0) and np.all(high < volume.size - 1):
        return []
    text = (
        "The stapes touches the border of the scan: what lies beyond it is missing from volume and mass. "
        "Scan or export a larger field of view."
    )
    return [Notice("touches_border", text)]

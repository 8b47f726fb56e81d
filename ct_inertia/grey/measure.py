"""Measure the stapes that was cut out: levels, blur, the voxels that are its own, and its moments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Levels, PlateFace
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.bone_level import Bone, as_levels, measure_bone
from ct_inertia.grey.coat import (
    USUAL,
    Coat,
    CoatImage,
    coat_image,
    with_coat_sd,
    with_suspected_coat,
)
from ct_inertia.grey.cupping import cupping_notice
from ct_inertia.grey.level_fit import BodyFit, fit_bodies, spread
from ct_inertia.grey.levels import Air, Guess, Surroundings
from ct_inertia.grey.neighbours import Parted, away_from_others, cut_through_bone, part_from_neighbours
from ct_inertia.grey.partial_volume import Share, partial_volume_moments, sensitivity, with_contribution
from ct_inertia.grey.plate_face import FaceFit, displaced_share, face_near, plate_share
from ct_inertia.grey.plate_face_doubt import face_covariance, face_doubt
from ct_inertia.grey.preparation import blur_of, prepare
from ct_inertia.grey.shading import as_shares, by_air, by_cupping, by_slope, unweighted_centre
from ct_inertia.grey.soft import by_soft, soft_notices, taken_off, without_soft
from ct_inertia.grey.thin_bone import thin_bone
from ct_inertia.grey.voids import by_filling, closed_voids, void_notices, without_filling
from ct_inertia.segment.cutting import Cut
from ct_inertia.surface.moments import Moments
from ct_inertia.volume.distance import capped_distance
from ct_inertia.volume.mask_statistics import gathered
from ct_inertia.volume.volume import Volume
from stapeskit.warnings import Notice

Array = NDArray[np.float64]

_REST_SD = calibrated("edges.rest_of_overshoot_sd")
_FITTED_BLUR_SD = calibrated("measure.fitted_blur_sd")
_MOST_BLUR_SD = calibrated("measure.most_blur_sd")
_TAIL_SD = calibrated("measure.tail_sd")
_GOOD_INSIDE = calibrated("measure.good_inside")
_WELL_SEEN = calibrated("measure.well_seen")
_WEAK = calibrated("measure.weak_level")
_SAME_BLUR = calibrated("measure.same_blur")
_OTHER_BLUR = calibrated("measure.other_blur")
_PLATE_DOUBT = calibrated("measure.plate_doubt")


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
    doubt : ndarray of float32, [z, y, x], or None
        By how much the share may be wrong at once, where something soft or the plate was taken off.
    coat_share : float or None
        Volume of the subtracted coat's image over that of the stapes.
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
    doubt: NDArray[np.float32] | None = None
    coat_share: float | None = None


def measure(volume: Volume, cut: Cut, guess: Guess, coat: Coat | None = None) -> Measured:
    """Measure levels and blur near the stapes and integrate its grey values.

    Parameters
    ----------
    volume : Volume
    cut : Cut
    guess : Guess
    coat : Coat, optional
        A soft coat on the bone, to be subtracted.

    Raises
    ------
    CtInertiaError
        The grey values of the body sum to no positive volume.
    """
    spacing = volume.spacing_mm
    rim = spread(spread(cut.stapes))
    ready = prepare(cut, guess, spacing)
    cut, around, air, stored = ready.cut, ready.around, ready.air, ready.stored
    sigma, distance, reach = ready.sigma_mm, ready.distance_mm, ready.reach_mm
    bone, fit = _bone(around, air, sigma, distance, reach)
    rest = _REST_SD * ready.overshoot * (bone.level - air.level)
    bone = replace(bone, sd=float(np.hypot(bone.sd, rest)))
    if stored is not None:
        bone = replace(bone, sd=stored.bone_sd(bone.sd), notices=(*bone.notices, *stored.notices()))
    blur = blur_of(cut, rim, (air.level, bone.level), spacing, air.noise)
    if fit is not None:
        off = 0.5 * abs(blur[0] - fit.sigma_mm)
        sd = max(_FITTED_BLUR_SD * fit.sigma_mm, min(off, _MOST_BLUR_SD * fit.sigma_mm))
        blur = (fit.sigma_mm, sd, "fit of body, level and blur")
    cut, fitted, displaced = _without_plate(
        volume, cut, (distance, reach), (air.level, guess.plastic, blur[0]), bone.level
    )
    face = None if fitted is None else fitted.face
    if face is not None and abs(face.sigma_mm / blur[0] - 1.0) < _SAME_BLUR:
        blur = (face.sigma_mm, 0.01 * face.sigma_mm, "face of the plate")
    coated: CoatImage | None = None
    if coat is not None and coat.thickness_mm > 0.0:
        coated = coat_image(cut, coat, distance < 1.99 * reach, spacing, (air.level, bone.level), blur[0])
        cut = replace(cut, grey=cut.grey - np.float32(bone.level - air.level) * coated.share)
    suspected: CoatImage | None = None
    if coat is None and ready.softened:
        near = distance < 1.99 * reach
        suspected = coat_image(cut, USUAL, near, spacing, (air.level, bone.level), blur[0])
    away = away_from_others(cut, distance, reach, spacing, blur[0])
    # Where blur fills thin walls, they look like something soft: only well seen bone tells the two apart.
    soft = None
    # A plate whose face could not be fitted is taken off like it, and less is known of that.
    touched = fitted is None and bool(np.any(cut.plate & (distance <= reach)))
    voids = closed_voids(cut, spacing, (air, bone.level), blur[:2])
    if voids is not None and voids.filled:
        cut = replace(cut, grey=without_filling(cut, voids, bone.level - air.level))
    if touched:
        soft = taken_off(cut, distance, reach, spacing, (air, bone.level), blur[0])
    elif bone.seen > _WELL_SEEN:
        known = (air, bone.level, guess.between)
        soft = without_soft(cut, (distance, away), reach, spacing, known, blur[0])
    if soft is not None:
        # Edges in something soft are less high and looked blurred otherwise: once more without it.
        clear = blur_of(replace(cut, grey=soft.grey), rim, (air.level, bone.level), spacing, air.noise)
        if fit is None and abs(clear[0] / blur[0] - 1.0) > _OTHER_BLUR:
            blur = clear
            soft = taken_off(cut, distance, reach, spacing, (air, bone.level), blur[0])
        cut = replace(cut, grey=soft.grey)
    parted = part_from_neighbours(cut, (distance, away), reach, spacing, (air.level, bone.level), blur[0])
    share = _share(cut, parted, air, bone, blur[:2])
    moments = partial_volume_moments(share, volume.scan_from_index)
    sloped = np.zeros(10)
    if np.any(bone.slope):
        bone = bone.moved_to(unweighted_centre(moments, bone, air.level, volume, cut))
        share = replace(share, bone=bone.level)
        moments = partial_volume_moments(share, volume.scan_from_index)
        sloped = by_slope(share, bone, volume, moments)
        moments = with_contribution(moments, "inhomogeneity", np.outer(sloped, sloped))
    notices = (*ready.notices, *bone.notices)
    if bone.cupping is not None:
        step = by_cupping(share, bone.cupping, volume, cut, moments)
        moments = with_contribution(moments, "cupping", np.outer(step, step))
        # A slope beside the paraboloid is that of its flank.
        notices = (*notices, cupping_notice(bone.cupping, as_shares(step + sloped, moments)))
    if any(air.slope):
        covariance = moments.contributions["levels"] + by_air(share, air, volume, moments)
        moments = with_contribution(moments, "levels", covariance)
    levels = (air.level, bone.level)
    through = cut_through_bone(cut, parted, levels, volume, moments)
    covariance = through.covariance + _by_tails(parted, cut, volume, moments)
    if np.any(covariance):
        moments = with_contribution(moments, "separation", covariance)
    if soft is not None:
        covariance = by_soft(soft, parted.own, cut, volume, moments, fitted is not None)
        moments = with_contribution(moments, "surroundings", covariance)
        notices = (*notices, *soft_notices(soft, parted.own, volume, moments))
    if voids is not None and voids.sd > 0.0:
        moments = with_contribution(moments, "voids", by_filling(voids, cut, volume, moments))
        notices = (*notices, *void_notices(voids, volume, moments))
    doubt = None if soft is None else soft.doubt * np.float32(_PLATE_DOUBT if touched else 1.0)
    coat_share = None
    if coated is not None:
        moments = with_coat_sd(coated, parted.own, cut, volume, moments)
        doubt = coated.doubt if doubt is None else doubt + coated.doubt
        coat_share = float(coated.share[parted.own].sum(dtype=float)) * volume.voxel_mm3 / moments.volume_mm3
    if suspected is not None:
        moments, notice = with_suspected_coat(suspected, parted.own, cut, volume, moments)
        notices = (*notices, notice)
        doubt = suspected.share if doubt is None else doubt + suspected.share
    if fitted is not None:
        near, contrast = distance <= reach, bone.level - air.level
        covariance = face_covariance(fitted, volume, cut, near, contrast, moments, displaced)
        moments = with_contribution(moments, "plate", covariance)
        unsure = face_doubt(fitted, volume, cut, near, contrast)
        if unsure is not None:
            doubt = unsure if doubt is None else doubt + unsure
    return Measured(
        moments,
        as_levels(air, bone, guess.plastic),
        blur[0],
        blur[2],
        _field(cut, parted, levels),
        parted.own,
        face,
        air.correlation,
        air.clipped,
        (*notices, *_air_notices(air, bone), *through.notices(moments.volume_mm3)),
        None if doubt is None else np.where(parted.own, doubt, np.float32(0.0)),
        coat_share,
    )


def _by_tails(parted: Parted, cut: Cut, volume: Volume, moments: Moments) -> Array:
    """Return the covariance (10, 10) of what blur carries between close bodies, known to a part of itself.

    Each eighth of the border stands for itself.
    """
    covariance = np.zeros((10, 10))
    for share in (parted.foreign, parted.behind):
        if share is None:
            continue
        index = np.argwhere(share > 1e-4)
        if len(index) == 0:
            continue
        away = volume.scan_points(index[:, ::-1] + cut.first) - moments.centroid_mm
        amount = share[tuple(index.T)].astype(float) * volume.voxel_mm3 * _TAIL_SD
        steps = sensitivity(away, moments.volume_mm3, 0.0) * amount[:, None]
        octant = (away > np.median(away, axis=0)) @ np.array([1, 2, 4])
        for part in range(8):
            step = steps[octant == part].sum(axis=0)
            covariance += np.outer(step, step)
    return covariance


def _bone(
    around: Surroundings, air: Air, sigma_mm: float, distance_mm: NDArray[np.float32], reach_mm: float
) -> tuple[Bone, BodyFit | None]:
    """Measure the bone level inside, or fit it with the body and its blur when there is too little inside."""
    inside = measure_bone(around, air, sigma_mm)
    seen = inside is not None and inside.seen > _WELL_SEEN
    if (
        inside is not None
        and seen
        and (inside.notices or inside.sd < _GOOD_INSIDE * (inside.level - air.level))
    ):
        return inside, None
    own = distance_mm <= reach_mm
    if np.any(around.foreign):
        own &= capped_distance(around.foreign, around.spacing_mm, reach_mm) >= 0.999 * reach_mm
    box = tuple(slice(int(k.min()), int(k.max()) + 1) for k in np.nonzero(own))
    start = float(np.percentile(around.grey[around.bone], 90.0)) - air.level
    if inside is not None:
        start = inside.level - air.level
    excess = around.grey[box] - np.float32(air.level)
    fit = fit_bodies(excess, own[box], around.spacing_mm, start, sigma_mm, air.noise)
    thin = thin_bone(fit, around, own[box], box, air)
    if thin is not None and (np.any(thin.slope) or thin.cupping is not None):
        return thin, fit
    sd = fit.relative_sd * fit.contrast * np.sqrt(air.correlation)
    if inside is not None and inside.sd < sd:
        return inside, None
    if thin is not None:
        sd = min(sd, thin.sd)
        fit = replace(fit, contrast=thin.level - air.level)
    noise = air.noise if inside is None else inside.noise
    notices: tuple[Notice, ...] = ()
    if sd > _WEAK * fit.contrast:
        text = (
            f"The stapes has hardly a voxel deeper than the blur of the scan: its bone level comes from a "
            f"fit of body and blur, uncertain by {100.0 * sd / fit.contrast:.1f} %, and so are volume and "
            f"mass. Scan with smaller voxels."
        )
        notices = (Notice("bone_level_weak", text),)
    return Bone(air.level + fit.contrast, float(sd), noise, "fit", notices, seen=0.0), fit


def _without_plate(
    volume: Volume,
    cut: Cut,
    within: tuple[NDArray[np.float32], float],
    start: tuple[float, float | None, float],
    bone: float,
) -> tuple[Cut, FaceFit | None, NDArray[np.float32] | None]:
    """Subtract the plate's blurred face from the grey values within reach of the stapes.

    The third value is what was given back where bone stands in the plastic's place.
    """
    (air, plastic, sigma), (distance_mm, reach_mm) = start, within
    if plastic is None:
        return cut, None, None
    fit = face_near(volume, cut, distance_mm, reach_mm, (air, plastic, sigma))
    if fit is None:
        return cut, None, None
    face = fit.face
    near = distance_mm <= reach_mm
    grey = cut.grey.copy()
    grey[near] -= plate_share(face, volume, cut, near).astype(np.float32)
    missing = displaced_share(face, volume, cut, grey - np.float32(air), bone - air, near)
    if missing is not None:
        grey[near] += missing[near]
    return replace(cut, grey=grey), fit, missing


def _share(cut: Cut, parted: Parted, air: Air, bone: Bone, blur: tuple[float, float]) -> Share:
    """Collect the stapes' grey values: measured on its side, modelled behind the border to other bone."""
    contrast = bone.level - air.level
    index, values, noise = gathered(cut.grey, parted.own, cut.stapes, (air.noise, bone.noise))
    if parted.foreign is not None and parted.behind is not None:
        values -= contrast * parted.foreign[parted.own]
        hidden = parted.behind > 1e-6
        values = np.concatenate([values, air.level + contrast * parted.behind[hidden]])
        noise = np.concatenate([noise, np.zeros(int(hidden.sum()))])
        index = np.vstack([index, np.stack(np.nonzero(hidden)[::-1], axis=1)])
    return Share(
        index + cut.first.astype(float),
        values,
        noise,
        air.level,
        bone.level,
        air.sd,
        bone.sd,
        *blur,
        air.correlation,
    )


def _field(cut: Cut, parted: Parted, levels: tuple[float, float]) -> NDArray[np.float32]:
    """Return the share of bone of the stapes in each voxel of the box, 0 beyond its own."""
    air, bone = levels
    share = (cut.grey - np.float32(air)) / np.float32(bone - air)
    if parted.foreign is not None:
        share -= parted.foreign
    return np.where(parted.own, share, np.float32(0.0))


def _air_notices(air: Air, bone: Bone) -> list[Notice]:
    if air.clipped == 0.0:
        return []
    share = 100.0 * air.clipped
    rest = 3.0 * air.noise / (bone.level - air.level)
    text = (
        f"{share:.0f} % of the air voxels lie at the lowest grey value: the export has clipped the noise. "
        f"That was corrected for; what remains may shift the volume by {rest:.2f} %. Export with an offset "
        f"that keeps air above 0."
    )
    return [Notice("air_clipped", text)]

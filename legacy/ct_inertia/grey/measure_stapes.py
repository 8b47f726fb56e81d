"""Measure the stapes that was cut out: levels, blur, the voxels that are its own, and its moments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import Levels, PlateFace, WindowWall
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air, Guess, Surroundings
from legacy.ct_inertia.grey.bare_bone import Blur, bare_bone
from legacy.ct_inertia.grey.bone_level import Bone, as_levels, measure_bone
from legacy.ct_inertia.grey.cupping import cupping_notice
from legacy.ct_inertia.grey.level_fit import BodyFit, fit_bodies
from legacy.ct_inertia.grey.neighbours import NeighbourSeparation, cut_through_bone, separate_from_neighbours
from legacy.ct_inertia.grey.partial_volume import (
    Share,
    by_octants,
    partial_volume_moments,
    voxel_effects,
    with_contribution,
)
from legacy.ct_inertia.grey.preparation import Prepared, blur_of, prepare
from legacy.ct_inertia.grey.shading import (
    air_slope_covariance,
    as_shares,
    cupping_effect,
    slope_effect,
    unweighted_centre,
)
from legacy.ct_inertia.grey.soft_coat import Coat
from legacy.ct_inertia.grey.thin_bone import thin_bone
from legacy.ct_inertia.grey.window_wall import share_of_bone, window_wall
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.mask_statistics import gather_voxels
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.background import Later
from legacy.stapeskit.warnings import Notice

_REST_SD = calibrated("edges.rest_of_overshoot_sd")
_FITTED_BLUR_SD = calibrated("measure.fitted_blur_sd")
_MOST_BLUR_SD = calibrated("measure.most_blur_sd")
_TAIL_SD = calibrated("measure.tail_sd")
_GOOD_INSIDE = calibrated("measure.good_inside")
_WELL_SEEN = calibrated("measure.well_seen")
_WEAK = calibrated("measure.weak_level")


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
    wall : Later of WindowWall or None
        Surface of other bone in the box, found in the background.
    notices : tuple of Notice
    doubt : ndarray of float32, [z, y, x], or None
        Common error of the share of bone where soft tissue or the plate was subtracted.
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
    wall: Later[WindowWall | None]
    notices: tuple[Notice, ...] = ()
    doubt: NDArray[np.float32] | None = None
    coat_share: float | None = None


def measure_stapes(volume: Volume, cut: Cut, guess: Guess, coat: Coat | None = None) -> Measured:
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
    ready = prepare(cut, guess, volume.spacing_mm)
    air = ready.air
    bone, blur, fitted = _bone_and_blur(ready, volume.spacing_mm)
    bare = bare_bone(volume, ready, bone, blur, fitted, guess, coat)
    cut, distances = bare.cut, (bare.distance_mm, bare.away_mm)
    levels = (air.level, bone.level)
    parted = separate_from_neighbours(cut, distances, bare.reach_mm, volume.spacing_mm, levels, bare.blur[0])
    share = _share(cut, parted, air, bone, bare.blur[:2])
    moments, bone, shading = _integrate(share, bone, air, volume, cut)
    wall = Later(window_wall, cut, parted, (air, bone), bare.blur[0], volume, _TAIL_SD)
    through = cut_through_bone(cut, parted, (air.level, bone.level), volume, moments)
    covariance = through.covariance + _by_tails(parted, cut, volume, moments)
    if np.any(covariance):
        moments = with_contribution(moments, "separation", covariance)
    moments, media = bare.with_budget(moments, parted.own, volume, bone.level - air.level)
    return Measured(
        moments,
        as_levels(air, bone, guess.plastic),
        bare.blur[0],
        bare.blur[2],
        _field(cut, parted, (air.level, bone.level)),
        parted.own,
        None if bare.face is None else bare.face.face,
        air.correlation,
        air.clipped,
        wall,
        (
            *ready.notices,
            *bone.notices,
            *shading,
            *media,
            *_air_notices(air, bone),
            *through.notices(moments.volume_mm3),
        ),
        bare.doubt(parted.own, volume, bone.level - air.level),
        bare.coat_share(parted.own, volume, moments),
    )


def _bone_and_blur(ready: Prepared, spacing_mm: Array) -> tuple[Bone, Blur, bool]:
    """Return the bone level, the blur, and whether both come from a fit of body, level and blur."""
    air = ready.air
    bone, fit = _bone(ready.around, air, ready.sigma_mm, ready.distance_mm, ready.reach_mm)
    rest = _REST_SD * ready.overshoot * (bone.level - air.level)
    bone = replace(bone, sd=float(np.hypot(bone.sd, rest)))
    if ready.stored is not None:
        notices = (*bone.notices, *ready.stored.notices())
        bone = replace(bone, sd=ready.stored.bone_sd(bone.sd), notices=notices)
    blur = blur_of(ready.cut, ready.rim, (air.level, bone.level), spacing_mm, air.noise)
    if fit is not None:
        off = 0.5 * abs(blur[0] - fit.sigma_mm)
        sd = max(_FITTED_BLUR_SD * fit.sigma_mm, min(off, _MOST_BLUR_SD * fit.sigma_mm))
        blur = (fit.sigma_mm, sd, "fit of body, level and blur")
    return bone, blur, fit is not None


def _integrate(
    share: Share, bone: Bone, air: Air, volume: Volume, cut: Cut
) -> tuple[Moments, Bone, list[Notice]]:
    """Integrate grey values, with what their changes across bone and air leave uncertain.

    The bone level that is returned is that at the centre of the body.
    """
    moments = partial_volume_moments(share, volume.scan_from_index)
    sloped = np.zeros(10)
    if np.any(bone.slope):
        bone = bone.moved_to(unweighted_centre(moments, bone, air.level, volume, cut))
        share = replace(share, bone=bone.level)
        moments = partial_volume_moments(share, volume.scan_from_index)
        sloped = slope_effect(share, bone, volume, moments)
        moments = with_contribution(moments, "inhomogeneity", np.outer(sloped, sloped))
    notices: list[Notice] = []
    if bone.cupping is not None:
        step = cupping_effect(share, bone.cupping, volume, cut, moments)
        moments = with_contribution(moments, "cupping", np.outer(step, step))
        # A slope beside the paraboloid is that of its flank.
        notices = [cupping_notice(bone.cupping, as_shares(step + sloped, moments))]
    if any(air.slope):
        covariance = moments.contributions["levels"] + air_slope_covariance(share, air, volume, moments)
        moments = with_contribution(moments, "levels", covariance)
    return moments, bone, notices


def _by_tails(parted: NeighbourSeparation, cut: Cut, volume: Volume, moments: Moments) -> Array:
    """Return the covariance (10, 10) of what blur carries between close bodies: a relative deviation.

    The eighths of the border have independent errors.
    """
    covariance = np.zeros((10, 10))
    for share in (parted.foreign, parted.behind):
        if share is not None and np.any(share > 1e-4):
            covariance += by_octants(*voxel_effects(share, share > 1e-4, cut.first, volume, moments))
    return _TAIL_SD**2 * covariance


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
    beside: NDArray[np.bool_] | None = None
    if np.any(around.foreign):
        clear = capped_distance(around.foreign, around.spacing_mm, reach_mm) >= 0.999 * reach_mm
        beside, own = own & ~clear & ~around.foreign, own & clear
    if beside is not None and not np.any(own):  # nothing is free of plate and other bone
        own, beside = beside, None
    used = own if beside is None else own | beside
    box = tuple(slice(int(k.min()), int(k.max()) + 1) for k in np.nonzero(used))
    start = float(np.percentile(around.grey[around.bone], 90.0)) - air.level
    if inside is not None:
        start = inside.level - air.level
    excess = around.grey[box] - np.float32(air.level)
    next_to = None if beside is None else beside[box]
    shape = (around.spacing_mm, start, sigma_mm, air.noise)
    fit = fit_bodies(excess, own[box], *shape, beside=next_to)
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


def _share(cut: Cut, parted: NeighbourSeparation, air: Air, bone: Bone, blur: tuple[float, float]) -> Share:
    """Collect the stapes' grey values: measured on its side, modelled behind the border to other bone."""
    contrast = bone.level - air.level
    index, values, noise = gather_voxels(cut.grey, parted.own, cut.stapes, (air.noise, bone.noise))
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


def _field(cut: Cut, parted: NeighbourSeparation, levels: tuple[float, float]) -> NDArray[np.float32]:
    """Return the share of bone of the stapes in each voxel of the box, 0 beyond its own."""
    air, bone = levels
    share = share_of_bone(cut.grey, air, bone)
    if parted.foreign is not None:
        share -= parted.foreign
    share[~parted.own] = 0.0
    return share


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

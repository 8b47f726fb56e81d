"""Measure the labelled stapes: one scene, its moments, their covariance by source, its surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ct_inertia.bodies import Box, Grey, Labelled, Mask, MeasuredBody, Moments, Scene
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.bone import BoneLevel, bone_level
from ct_inertia.grey.border import border_contacts, border_covariance, border_notice
from ct_inertia.grey.frame_surface import body_surface, wall_surface
from ct_inertia.grey.media import Coat, Media, coat_notice, coat_sd_share, media_notices
from ct_inertia.grey.misfit import PlaceMisfit, misfit_notice, misfits
from ct_inertia.grey.moments import (
    blur_covariance,
    by_octants,
    common,
    noise_covariance,
    partial_volume_moments,
)
from ct_inertia.grey.scene import SceneFit, fit_scene
from ct_inertia.grey.separation import bone_border, tails_covariance
from ct_inertia.grey.start import Start, start
from ct_inertia.grey.storing import Storing, storing_around, storing_notices
from stapeskit.arrays import Array

_BLUR_SD = calibrated("scene.blur_sd")
_FLUID_SD = calibrated("media.fluid_sd")
_SOFT_SD = calibrated("media.soft_sd")


def measure(labelled: Labelled, coat: Coat | None = None) -> MeasuredBody:
    """Measure the labelled stapes by its grey values, or as a solid of voxels where there are none.

    Parameters
    ----------
    labelled : Labelled
    coat : Coat, optional
        A soft coat on the bone, to be subtracted; None: not stated, bare bone is assumed.

    Raises
    ------
    StapeskitError
        Grey values whose levels storing left open, or that sum to no positive volume.
    """
    if labelled.box.is_mask:
        from ct_inertia.grey.mask import measure_mask

        return measure_mask(labelled)
    begin = start(labelled)
    storing = storing_around(labelled, begin)
    if storing is not None:
        begin = _with_stored_levels(begin, storing)
    fit = fit_scene(begin, Media.around(begin, coat), storing)
    parts = _Parts.of(fit, labelled)
    share = parts.integrand
    moments = partial_volume_moments(share, parts.transform, fit.sigma_mm)
    found = misfits(fit, parts.residual, labelled.box.voxel_mm3, moments)
    moments = _with_sources(moments, parts, found)
    box = labelled.box
    whole = Placed(begin.part, box.shape)
    own = whole.mask(parts.own)
    levels = (begin.air, begin.air + parts.level.contrast)
    through = bone_border(labelled, own, levels, moments)
    if through.covariance.any():
        moments = moments.with_source("separation", through.covariance)
    contacts = border_contacts(labelled.stapes, box)
    notices = [*labelled.notices, *storing_notices(storing), *through.notices(moments.volume_mm3)]
    if contacts:
        moments = moments.with_source("border", border_covariance(contacts, whole.grey(share), box, moments))
        notices.append(border_notice(contacts))
    notices += media_notices(fit, parts.soft_share, moments, parts.transform)
    odd = misfit_notice(found)
    notices += [] if odd is None else [odd]
    surface = body_surface(fit, parts.level, parts.doubt, parts.transform)
    if coat is None:
        notices.append(coat_notice(fit, parts.transform, moments))
    return MeasuredBody(
        labelled=labelled,
        scene=_scene(fit, parts, whole),
        moments=moments,
        surface=surface,
        wall=wall_surface(fit, parts.level, parts.transform),
        border=contacts,
        evidence=_evidence(fit, parts, found),
        notices=tuple(notices),
    )


@dataclass(frozen=True)
class Placed:
    """Where a part lies in its box: puts its arrays back."""

    part: tuple[slice, ...]
    shape: tuple[int, ...]

    def grey(self, array: Grey, outside: float = 0.0) -> Grey:
        """Return an array of the part on the whole box."""
        whole = np.full(self.shape, np.float32(outside))
        whole[self.part] = array
        return whole

    def mask(self, array: Mask) -> Mask:
        """Return a mask of the part on the whole box."""
        whole = np.zeros(self.shape, dtype=bool)
        whole[self.part] = array
        return whole


@dataclass(frozen=True)
class _Parts:
    """What a fitted scene gives the stapes, on its part of the box; shares of the stapes' contrast."""

    fit: SceneFit
    transform: Array
    level: BoneLevel
    own: Mask
    foreign: Grey
    behind: Grey
    excess: Grey
    residual: Grey
    soft_share: Grey
    coat_sd: Grey | None

    @classmethod
    def of(cls, fit: SceneFit, labelled: Labelled) -> _Parts:
        """Subtract everything that is not the stapes, and choose its level."""
        begin = fit.start
        reach = begin.distances["stapes"] <= np.float32(begin.reach_mm)
        own = reach & fit.side("stapes")
        others, media = fit.bones(but="stapes"), fit.media.image((slice(None),) * 3)
        excess = (fit.data - others - media) * np.float32(1.0 / fit.contrasts["stapes"])
        level = bone_level(fit, excess)
        unit = np.float32(1.0 / level.contrast)
        excess *= np.float32(fit.contrasts["stapes"] / level.contrast)
        zero = np.float32(0.0)
        return cls(
            fit,
            _moved(labelled.box, begin.part),
            level,
            own,
            np.where(own, others * unit, zero),
            np.where(reach & ~own, fit.shares["stapes"], zero),
            excess,
            fit.residual * unit,
            np.where(own, fit.media.soft_image(fit.shares) * unit, zero),
            coat_sd_share(fit, own),
        )

    @property
    def integrand(self) -> Grey:
        """The stapes' share: as measured on its side, as modelled behind the border to other bodies."""
        return np.where(self.own, self.excess, self.behind)

    @property
    def doubt(self) -> Grey | None:
        """One standard deviation of what was subtracted around the stapes; None where nothing was."""
        parts = [_SOFT_SD * self.soft_share]
        if self.coat_sd is not None:
            parts.append(self.coat_sd)
        total = np.sqrt(sum(np.square(part) for part in parts))
        return total if total.any() else None


def _moved(box: Box, part: tuple[slice, ...]) -> Array:
    transform = box.scan_from_index.copy()
    start = np.array([along.start for along in part[::-1]], dtype=float)
    transform[:3, 3] += transform[:3, :3] @ start
    return transform


def _with_stored_levels(begin: Start, storing: Storing) -> Start:
    """Take levels and noise from before storing."""
    contrast = storing.bone.level - storing.air.level
    contrasts = {
        name: value if name == "plate" else contrast * value / begin.contrasts["stapes"]
        for name, value in begin.contrasts.items()
    }
    return replace(
        begin,
        air=storing.air.level,
        noise=begin.noise * storing.noise_ratio(begin.noise),
        air_sd=float(np.hypot(begin.air_sd, storing.air_sd)),
        contrasts=contrasts,
    )


def _with_sources(moments: Moments, parts: _Parts, found: list[PlaceMisfit]) -> Moments:
    """Add noise, levels, blur, tails, media and misfit to the covariance."""
    fit, transform = parts.fit, parts.transform
    begin, contrast = fit.start, parts.level.contrast
    stapes = begin.masks["stapes"]
    noise = noise_covariance(begin.noise / contrast, parts.own & ~stapes, transform, moments, fit.sigma_mm)
    inside = noise_covariance(
        parts.level.noise / contrast, parts.own & stapes, transform, moments, fit.sigma_mm
    )
    zero = np.float32(0.0)
    air = np.where(parts.own, (np.float32(1.0) - parts.excess) * np.float32(begin.air_sd / contrast), zero)
    bone_sd = float(np.hypot(parts.level.sd, 0.0 if fit.storing is None else fit.storing.bone_sd))
    bone = np.where(parts.own, parts.excess * np.float32(bone_sd / contrast), zero)
    levels = common(air, transform, moments) + common(bone, transform, moments)
    moments = moments.with_source("noise", begin.correlation * (noise + inside)).with_source("levels", levels)
    moments = moments.with_source("psf", blur_covariance(moments, fit.sigma_mm, _BLUR_SD * fit.sigma_mm))
    if parts.foreign.any():
        moments = moments.with_source(
            "separation", tails_covariance(parts.foreign, parts.behind, transform, moments)
        )
    if parts.soft_share.any():
        soft = 0.5 * (
            common(parts.soft_share, transform, moments) + by_octants(parts.soft_share, transform, moments)
        )
        moments = moments.with_source("surroundings", _SOFT_SD**2 * soft)
    if fit.media.touching is not None:
        wet = np.where(parts.own, fit.shares["plate"], zero) * np.float32(fit.contrasts["plate"] / contrast)
        moments = moments.with_source("surroundings", _FLUID_SD**2 * common(wet, transform, moments))
    if parts.coat_sd is not None:
        moments = moments.with_source("coat", common(parts.coat_sd, transform, moments))
    if fit.media.void_share is not None:
        filled = fit.media.void_share * np.float32(fit.media.void_sd / contrast)
        moments = moments.with_source("voids", common(filled, transform, moments))
    if any(one.stands_out for one in found):
        left = np.where(parts.own, parts.residual, zero)
        moments = moments.with_source("misfit", common(left, transform, moments))
    return moments


def _scene(fit: SceneFit, parts: _Parts, whole: Placed) -> Scene:
    begin = fit.start
    return Scene(
        air=begin.air,
        contrast={**fit.contrasts, "stapes": parts.level.contrast},
        air_sd=begin.air_sd,
        bone_sd=parts.level.sd,
        sigma_mm=fit.sigma_mm,
        sigma_sd_mm=_BLUR_SD * fit.sigma_mm,
        noise=begin.noise,
        correlation=begin.correlation,
        share=whole.grey(fit.shares["stapes"]),
        body=whole.grey(fit.bodies["stapes"]),
        excess=whole.grey(parts.excess),
        own=whole.mask(parts.own),
        bone_from=parts.level.source,
        media=fit.media.as_shares(parts.level.contrast),
    )


def _evidence(fit: SceneFit, parts: _Parts, found: list[PlaceMisfit]) -> Mapping[str, Any]:
    return {
        "air": fit.start.air,
        "bone": fit.start.air + parts.level.contrast,
        "bone_from": parts.level.source,
        "psf_sigma_mm": fit.sigma_mm,
        "noise_share": fit.start.noise / parts.level.contrast,
        "noise_correlation": fit.start.correlation,
        "rounds": len(fit.slopes),
        "residual_share_by_place": {one.place: one.share for one in found},
    }

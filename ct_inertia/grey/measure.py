"""Measure the labelled stapes: one scene, its moments, their covariance by source, its surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ct_inertia.bodies import Labelled, MeasuredBody, Moments, Scene
from ct_inertia.frames.plate import plane_faces
from ct_inertia.frames.plate_frame import facing
from ct_inertia.grey.border import with_border
from ct_inertia.grey.budget import amounts_of, grey_scale_bend, uneven_air, unstated_coat, with_sources
from ct_inertia.grey.frame_surface import body_surface
from ct_inertia.grey.media import Coat, Media, coat_notice, media_notices, usual_coat
from ct_inertia.grey.misfit import gain_over_body, misfit_notice, misfits
from ct_inertia.grey.moments import effect, partial_volume_moments
from ct_inertia.grey.parts import StapesParts
from ct_inertia.grey.plate_plane import plate_surface
from ct_inertia.grey.scene import SceneFit, fit_scene
from ct_inertia.grey.separation import bone_border
from ct_inertia.grey.slice_breaks import with_breaks
from ct_inertia.grey.start import start
from ct_inertia.grey.storing import storing_around
from ct_inertia.voxels.fields import Grey
from stapeskit.arrays import return_memory


def measure(labelled: Labelled, coat: Coat | None = None) -> MeasuredBody:
    """Measure the labelled stapes by its grey values, or as a solid of voxels where there are none.

    Parameters
    ----------
    coat : Coat, optional
        A soft coat on the bone, to be subtracted; None: not stated, bare bone is assumed.

    Raises
    ------
    StapeskitError
        Grey values whose levels storing left open, or that sum to no positive volume.
    """
    plate = plate_surface(labelled)
    faces = () if plate is None else tuple(plane_faces(plate))
    if labelled.box.is_mask:
        from ct_inertia.grey.mask import measure_mask

        return replace(measure_mask(labelled), plate=plate, plate_faces=faces)
    middle = labelled.box.scan_points(np.argwhere(labelled.stapes)[:, ::-1].mean(axis=0)[None])[0]
    begin = start(labelled, facing(faces, middle))
    storing = storing_around(labelled, begin)
    begin = begin if storing is None else storing.corrected(begin)
    return_memory()
    fit = fit_scene(begin, Media.around(begin, coat), storing)
    return_memory()
    parts = StapesParts.of(fit)
    moments = partial_volume_moments(parts.integrand, parts.transform, fit.spread_in_scan_mm2)
    left = misfits(fit, parts.residual, labelled.box.voxel_mm3, moments)
    odd = any(one.stands_out for one in left)
    # A coat leaves grey values beyond the edge of the bone: only then is it worth a second fit.
    brighter = any(one.place == "collar" and one.may_be_soft for one in left)
    unstated = unstated_coat(parts, moments) if brighter and coat is None else None
    bend, gain = grey_scale_bend(fit), gain_over_body(fit, parts.residual, parts.level.contrast)
    moments, around = with_sources(moments, parts, amounts_of(parts, odd, unstated, bend, gain))
    through = bone_border(labelled, begin, parts.own, (begin.air, begin.air + parts.level.contrast), moments)
    if through.covariance.any():
        moments = moments.with_source("separation", through.covariance)
    misfit = moments.contributions["misfit"][0, 0] if odd else 0.0
    moments, cut = with_border(labelled, moments)
    moments, breaks = with_breaks(fit, moments, labelled.box.repeated)

    notices = [*labelled.notices, *([] if storing is None else storing.notices())]
    notices += [*through.notices(moments.volume_mm3), *cut, *breaks]
    soft, hollow, mucosa = (
        _share(amount, parts, moments) for amount in (parts.soft, fit.media.void_share, unstated)
    )
    uneven = float(_share(uneven_air(parts), parts, moments) / np.sqrt(8.0))  # eighths differ independently
    noise = float(np.sqrt(moments.contributions["noise"][0, 0])) / moments.volume_mm3
    notices += [*media_notices(fit, soft, hollow), *misfit_notice(left, mucosa, bend, gain, uneven, noise)]
    notices += [coat_notice(_share(usual_coat(fit), parts, moments))] if coat is None else []
    scene, level = _scene(fit, parts), parts.level
    del parts, unstated, gain  # a third of the memory, before surfaces need theirs
    for done in (fit.bodies, begin.distances):
        done.clear()
    return_memory()
    return MeasuredBody(
        labelled=labelled,
        scene=scene,
        moments=moments,
        surface=body_surface(fit, "stapes", level, around, float(np.sqrt(misfit))),
        wall=body_surface(fit, "other", level) if "other" in fit.names else None,
        plate=plate,
        plate_faces=faces,
        evidence={
            "noise_correlation": begin.correlation,
            "rounds": len(fit.slopes),
            "residual_share_by_place": {one.place: one.share for one in left},
        },
        notices=tuple(notices),
    )


def _share(amount: Grey | None, parts: StapesParts, moments: Moments) -> float:
    """Return an amount on the stapes' side as a share of its volume."""
    if amount is None:
        return 0.0
    return float(effect(parts.where_own(amount), parts.transform, moments)[0] / moments.volume_mm3)


def _scene(fit: SceneFit, parts: StapesParts) -> Scene:
    return Scene(
        air=fit.start.air,
        bone=fit.start.air + parts.level.contrast,
        air_sd=fit.start.air_sd,
        bone_sd=parts.level.sd,
        bone_from=parts.level.source,
        sigma_mm=fit.sigma_mm,
        noise=fit.start.noise,
        even=partial_volume_moments(fit.bodies["stapes"], parts.transform, np.zeros((3, 3))),
        media=fit.media.as_shares(parts.level.contrast),
    )

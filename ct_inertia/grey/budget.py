"""The covariance of the moments by source: noise, blur, and uncertain amounts of bone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from ct_inertia.bodies import Moments
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.cells import mean_by_cells
from ct_inertia.grey.media import USUAL_COAT, Media
from ct_inertia.grey.moments import blur_covariance, by_octants, common, noise_covariance, octants
from ct_inertia.grey.parts import StapesParts
from ct_inertia.grey.scene import SceneFit, fit_scene, free_edges
from ct_inertia.grey.start import AIR_VOXELS
from ct_inertia.voxels.fields import Grey
from stapeskit.arrays import Array

_BLUR_SD = calibrated("scene.blur_sd")
_FLUID_SD = calibrated("media.fluid_sd")
_SOFT_SD = calibrated("media.soft_sd")
_TAIL_SD = calibrated("separation.tail_sd")
_CLEARLY = 12.0  # log-likelihood by which a coat that nobody stated must fit better: 1 in 160 000
_LEAST_BEND, _BEND_Z = 0.03, 5.0  # a sharp picture without noise leaves 0.01; standard deviations
_BENT, _LEAST_EDGE = (1e-3, 0.999), 400  # shares of bone, and voxels of edges that show a bend
_RESOLVED = 0.9  # width of the blur, voxels: at 0.85 sampling leaves a bend of 0.02, at 0.7 one of 0.1
_LEAST_RATIO = 0.1  # of noises: a surface that follows noise takes up to 0.03 of that in bone
_CELL_VOXELS = 6  # edge of the cells whose means show how well the level of plastic is known
_DEEP, _LEAST_DEEP = 0.95, 100  # share of a body, and voxels, that show its level or noise


def unstated_coat(parts: StapesParts, moments: Moments) -> Grey | None:
    """Return the change of the stapes' share by a usual coat; None where a coat does not improve the fit.

    Notes
    -----
    The logarithm of the ratio of likelihoods is half the difference of the sums of squares on the stapes'
    side over the variance of the noise, times the voxels per independent one. A fluid lies on one side: the
    eighths of the space around that speak against a coat must weigh less than half of those for it.
    """
    fit, begin = parts.fit, parts.fit.start
    coated = fit_scene(begin, Media.around(begin, USUAL_COAT), fit.storing)
    better = parts.where_own(np.square(fit.residual) - np.square(coated.residual))
    unit = 2.0 * begin.noise**2 * begin.correlation
    gains = [
        float(better[part].sum(dtype=float)) / unit
        for part in octants(better.shape, parts.transform, moments)
    ]
    against = -sum(gain for gain in gains if gain < 0.0)
    if sum(gains) < max(_CLEARLY, against):
        return None
    return parts.integrand - StapesParts.of(coated).integrand


_AROUND = ("surroundings", "coat", "grey_scale")
"""Sources that shift the surface of the stapes, and the footplate's frame with it."""

Spread = Callable[[Grey, Array, Moments], Array]
"""How an amount errs: everywhere alike (`common`), or each eighth of the space by itself (`by_octants`)."""


Amount = tuple[str, Grey, Spread]
"""Source, a share of bone that may be wrong by its own size, and how it errs."""


def amounts_of(
    parts: StapesParts, misfit: bool, unstated: Grey | None, bend: float, gain: Grey | None
) -> Iterator[Amount]:
    """Yield every uncertain amount of bone.

    ``misfit``: the residual is significant; ``unstated``: what a coat that nobody stated would take off,
    ``gain``: by how much the level of bone departs from its mean, [z, y, x]; ``bend``: of the grey scale.
    """
    fit, media, contrast = parts.fit, parts.fit.media, parts.level.contrast
    bone_sd = float(np.hypot(parts.level.sd, 0.0 if fit.storing is None else fit.storing.bone_sd))
    yield "levels", parts.where_own((1.0 - parts.excess) * np.float32(fit.start.air_sd / contrast)), common
    yield "levels", parts.where_own(parts.excess * np.float32(bone_sd / contrast)), common
    if fit.start.air_uneven:
        yield "levels", uneven_air(parts), by_octants
    if len(fit.names) > 1:
        for tail in (parts.foreign, parts.behind):
            yield "separation", np.float32(_TAIL_SD) * tail, by_octants
    for amount in plate_errors(parts):
        yield "separation", amount, common
    if parts.soft is not None:
        for spread in (common, by_octants):
            yield "surroundings", np.float32(_SOFT_SD / np.sqrt(2.0)) * parts.soft, spread
        yield "surroundings", parts.where_own(fit.media.film_sd(fit) / np.float32(contrast)), common
    if media.wet:
        wet = fit.shares["plate"] * np.float32(_FLUID_SD * fit.contrasts["plate"] / contrast)
        yield "surroundings", parts.where_own(wet), common
    if parts.coat_sd is not None:
        yield "coat", parts.where_own(parts.coat_sd), common
    if unstated is not None:
        yield "coat", parts.where_own(unstated), common
    if media.void_share is not None:
        yield "voids", media.void_share * np.float32(media.void_sd / contrast), common
    if misfit:
        yield "misfit", parts.where_own(parts.residual), common
    if gain is not None:
        yield "grey_scale", parts.where_own(gain * fit.shares["stapes"]), common
    if bend:
        share = fit.shares["stapes"]
        yield "grey_scale", parts.where_own(np.float32(bend) * share * (1.0 - share)), common


def uneven_air(parts: StapesParts) -> Grey:
    """Return one standard deviation of the level of air on the stapes' side, an eighth of it by itself.

    Cells of air differ independently, and so do those that the stapes and its blur fill.
    """
    begin = parts.fit.start
    cells = max(1.0, np.count_nonzero(parts.own) / 8.0 / AIR_VOXELS**3)
    return parts.own * np.float32(begin.air_uneven / parts.level.contrast / np.sqrt(cells))


def plate_errors(parts: StapesParts) -> Iterator[Grey]:
    """Yield one standard deviation of a dry plate's image on the stapes' side: by its height, by its level.

    Notes
    -----
    The height is known to the noise next to the stapes, the level to the scatter of its means over cells
    deep in the plate.
    """
    fit, plane = parts.fit, parts.fit.media.plane
    if plane is None or plane.wets:
        return
    unit = 1.0 / parts.level.contrast
    yield parts.where_own(plane.changes(fit)[0][0] * np.float32(plane.sd_mm * unit))
    deep = fit.start.near & (fit.shares["plate"] > np.float32(_DEEP))
    if np.count_nonzero(deep) > _LEAST_DEEP:
        error = mean_by_cells(fit.residual[deep], deep, _CELL_VOXELS)[1]
        yield parts.where_own(fit.shares["plate"] * np.float32(error * unit))


def grey_scale_bend(fit: SceneFit) -> float:
    """Return the bend b of a grey scale x + b x (1 - x) by what it leaves at edges; 0 where that is noise.

    Notes
    -----
    At a plane edge of the share x = Phi(t) a surface out of place, a wrong blur, a wrong contrast and fringes
    leave phi(t), t phi(t), x and (t^3 - 3 t) phi(t): its derivatives along the normal. The rest of x (1 - x),
    even in t, is the bend's own. Where clipping or coarse steps were undone, it is not looked for; blurs too
    narrow for the voxels, or for blocks of fine ones, leave such a trace as well: there noise shows it.
    """
    from scipy.special import ndtri

    if fit.storing is not None:
        return 0.0
    if np.any(fit.widths_mm < _RESOLVED * fit.start.spacing):
        return _bend_by_noise(fit)
    places = free_edges(fit, _BENT)
    if len(places) < _LEAST_EDGE:
        return 0.0
    share = fit.shares["stapes"].ravel()[places].astype(float)
    t = ndtri(share)
    bell = np.exp(-0.5 * t * t)
    rows = np.stack([bell, t * bell, share, (t**3 - 3.0 * t) * bell, share * (1.0 - share)])
    residual = fit.residual.ravel()[places].astype(float) / fit.contrasts["stapes"]
    inverse = np.linalg.pinv(rows @ rows.T)
    factors = inverse @ (rows @ residual)
    square = float(np.mean((residual - factors @ rows) ** 2)) * max(fit.start.correlation, 1.0)
    bend, sd = float(factors[-1]), float(np.sqrt(max(inverse[-1, -1], 0.0) * square))
    return bend if abs(bend) > max(_LEAST_BEND, _BEND_Z * sd) else 0.0


def _bend_by_noise(fit: SceneFit) -> float:
    """Return the bend where noise in air is more than in bone; less has other causes.

    The slopes of x + b x (1 - x), 1 + b in air and 1 - b in bone, are the ratio of the noises.
    """
    inside = fit.own & (fit.shares["stapes"] > _DEEP)
    count = np.count_nonzero(inside) / fit.start.correlation
    if count < _LEAST_DEEP:
        return 0.0
    ratio = fit.start.noise / max(float(np.std(fit.residual[inside])), 1e-30)
    known = ratio > 1.0 + max(_LEAST_RATIO, 4.0 / np.sqrt(2.0 * count))
    return float((ratio - 1.0) / (ratio + 1.0)) if known else 0.0


def with_sources(
    moments: Moments, parts: StapesParts, amounts: Iterable[Amount]
) -> tuple[Moments, Grey | None]:
    """Add noise, blur and all amounts to the covariance.

    Returns
    -------
    Moments
    ndarray of float32, [z, y, x], or None
        One standard deviation of what may lie around the stapes; None where nothing does.
    """
    fit, level = parts.fit, parts.level
    stapes = fit.start.masks["stapes"]
    for noise, where in ((fit.start.noise, parts.own & ~stapes), (level.noise, parts.own & stapes)):
        part = noise_covariance(noise / level.contrast, where, parts.transform, moments, fit.sigma_mm)
        moments = moments.with_source("noise", fit.start.correlation * part)
    moments = moments.with_source("psf", blur_covariance(moments, fit.sigma_mm, _BLUR_SD))
    around = None
    for source, amount, spread in amounts:
        moments = moments.with_source(source, spread(amount, parts.transform, moments))
        if source in _AROUND:
            around = amount if around is None else np.hypot(around, amount)
    return moments, around

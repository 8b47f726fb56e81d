"""A thin soft coat on the bone (mucosa): subtracted where stated, its effect reported where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.grey.level_fit import blurred, body_share
from legacy.ct_inertia.grey.partial_volume import voxel_effects, with_contribution
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density, normal_quantile
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

BARE = "bare_bone_assumed"

# Mucosa of the middle ear: 20 to 50 um thick, attenuates like water, 10 to 20 % of the contrast of bone and
# air. The effect on an uncleaned stapes is reported for the middle of both.
USUAL_MM, USUAL_GREY = 0.035, 0.15
# A tone curve that brightens the middle, as image programs apply it; the effect is that with air at black.
USUAL_GAMMA = 0.7
# Standard deviation of a stated value without one, as a share of it.
_UNSTATED_SD = 1.0 / 3.0
# No coat is added farther than 5.2 widths of the blur from bone, where its share is Phi(-5.2) = 1e-7.
_NOTHING = 1e-7


@dataclass(frozen=True)
class Coat:
    """A coat of even thickness; ``grey`` is its grey value above air over that of bone above air.

    Attributes
    ----------
    thickness_mm, thickness_sd_mm, grey, grey_sd : float
    """

    thickness_mm: float
    thickness_sd_mm: float
    grey: float
    grey_sd: float


USUAL = Coat(USUAL_MM, 0.0, USUAL_GREY, 0.0)


@dataclass(frozen=True)
class CoatImage:
    """The blurred image of a coat, as shares of the contrast of bone and air.

    Attributes
    ----------
    share : ndarray of float32, [z, y, x]
    by_thickness, by_grey : ndarray of float32, [z, y, x]
        Its change by one standard deviation of the thickness and of the grey value.
    """

    share: NDArray[np.float32]
    by_thickness: NDArray[np.float32]
    by_grey: NDArray[np.float32]

    @property
    def doubt(self) -> NDArray[np.float32]:
        """Return the standard deviation of the share, common to all voxels."""
        return np.hypot(self.by_thickness, self.by_grey)


def stated_coat(
    thickness_um: tuple[float, float | None] | None, grey: tuple[float, float | None]
) -> Coat | None:
    """Return the coat of the options, None where its thickness is not given; a missing sd is a third."""
    if thickness_um is None:
        return None
    (thick, thick_sd), (level, level_sd) = thickness_um, grey
    thick_sd = _UNSTATED_SD * thick if thick_sd is None else thick_sd
    return Coat(thick * 1e-3, thick_sd * 1e-3, level, _UNSTATED_SD * level if level_sd is None else level_sd)


def coat_image(
    cut: Cut,
    coat: Coat,
    near: NDArray[np.bool_],
    spacing_mm: Array,
    levels: tuple[float, float],
    sigma_mm: float,
) -> CoatImage:
    """Return the image of a coat on every bone within a region.

    Parameters
    ----------
    cut : Cut
    coat : Coat
    near : ndarray of bool, [z, y, x]
        The region.
    spacing_mm : ndarray, (3,)
    levels : (air, bone)
    sigma_mm : float
        Standard deviation of the point spread.

    Notes
    -----
    Along the normal x of a plane surface the blurred bone is m = Phi(-x / s), bone and coat together are
    Phi((t - x) / s), so that the coat adds b (Phi(Phi^-1(m) + t / s) - m), and the surface of the bone lies
    where the sum is (1 - b) / 2 + b Phi(t / s). m is the image of the two-valued body with that surface, so
    curvature enters by the distance of the level sets of m. Noise does not enter the quantile: m has none.
    """
    air, bone = levels
    box = tuple(slice(int(k.min()), int(k.max()) + 1) for k in np.nonzero(near))
    share = (cut.grey[box] - np.float32(air)) / np.float32(bone - air)
    thick = coat.thickness_mm / sigma_mm
    surface = 0.5 * (1.0 - coat.grey) + coat.grey * float(normal_cdf(thick))
    calm = gaussian(share, 0.6, truncate=3.0)
    level = np.full(share.shape, surface, dtype=np.float32)
    model = blurred(body_share(calm, level, np.ones(share.shape, dtype=bool)), sigma_mm, spacing_mm[::-1])
    there = near[box] & (model > _NOTHING)
    values = np.minimum(model[there].astype(float), 1.0 - _NOTHING)
    outer = normal_quantile(values) + thick
    shell = normal_cdf(outer) - values
    rise = normal_density(outer) / sigma_mm

    def whole(amount: Array) -> NDArray[np.float32]:
        part, every = np.zeros(share.shape, dtype=np.float32), np.zeros(cut.grey.shape, dtype=np.float32)
        part[there] = amount
        every[box] = part
        return every

    return CoatImage(
        whole(coat.grey * shell),
        whole(coat.grey * rise * coat.thickness_sd_mm),
        whole(shell * coat.grey_sd),
    )


def with_coat_sd(
    image: CoatImage, own: NDArray[np.bool_], cut: Cut, volume: Volume, moments: Moments
) -> Moments:
    """Add the contribution of thickness and grey value of the coat, each common to all of the surface."""
    where = own & (image.share > 0.0)
    covariance = np.zeros((10, 10))
    for part in (image.by_thickness, image.by_grey):
        step = voxel_effects(part, where, cut.first, volume, moments)[0].sum(axis=0)
        covariance += np.outer(step, step)
    return with_contribution(moments, "coat", covariance)


def with_suspected_coat(
    image: CoatImage, own: NDArray[np.bool_], cut: Cut, volume: Volume, moments: Moments
) -> tuple[Moments, Notice]:
    """Add a coat that edges suggest to the budget, as large as a usual one, and name it."""
    where = own & (image.share > 0.0)
    step = voxel_effects(image.share, where, cut.first, volume, moments)[0].sum(axis=0)
    share = float(step[0]) / moments.volume_mm3
    text = (
        f"Edges of the bone fade out more slowly than blur explains: a thin soft coat (mucosa), bone that is "
        f"less dense at its surface, or grey values that are not linear (volume and mass are "
        f"then too small). A usual coat "
        f"({1e3 * USUAL_MM:.0f} um, {100.0 * USUAL_GREY:.0f} % of the contrast) would add "
        f"{100.0 * share:.1f} % to volume and mass; nothing was subtracted, and the budget holds that much "
        f"(coat). State it with {named('coat')} THICKNESS+-SD (um), or clean the bone."
    )
    return with_contribution(moments, "coat", np.outer(step, step)), Notice("coat_suspected", text)


def bare_bone_notice(surface: Surface, volume_mm3: float, blur_mm: float) -> Notice:
    """Report that bare bone on a linear grey scale is assumed, and what a usual departure would add.

    Notes
    -----
    A scale bent by h between air and bone adds 4 h m (1 - m) to a share m. Across a plane edge of blur s the
    integral of m (1 - m) is s / sqrt(pi).
    """
    per_mm = 100.0 * surface.area_mm2 / volume_mm3
    bend = 0.5**USUAL_GAMMA - 0.5
    text = (
        f"Bare bone is assumed, and the budget holds nothing for a soft coat: mucosa of "
        f"{1e3 * USUAL_MM:.0f} um with {100.0 * USUAL_GREY:.0f} % of the contrast of bone would add "
        f"{USUAL_GREY * USUAL_MM * per_mm:.1f} % to volume and mass, and is hard to distinguish from the "
        f"blur of the scan. State it with {named('coat')} THICKNESS+-SD (um), or {named('coat')} 0 for "
        f"cleaned bone. Grey values are taken to be linear in the attenuation: an export with a gamma of "
        f"{USUAL_GAMMA} would add up to {4.0 * bend * blur_mm / np.sqrt(np.pi) * per_mm:.1f} %, its "
        f"inverse take off as much, and neither always shows."
    )
    return Notice(BARE, text)

"""Ligament, fluid or glue in air around the stapes, bubbles in fluid: detected and subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.edge_departure import cells_of
from legacy.ct_inertia.grey.level_fit import blurred, body_share, fit_bodies
from legacy.ct_inertia.grey.neighbours import neighbour_share
from legacy.ct_inertia.grey.partial_volume import by_octants, voxel_effects
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.ct_inertia.volume.mask_statistics import every_nth
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_quantile
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

_MOST_BONE = calibrated("soft.most_bone")
_CELL_MM = calibrated("soft.cell_mm")
_LEAST_CELL = calibrated("soft.least_cell")
_LEAST_SHARE = calibrated("soft.least_share")
_STANDS_OUT = calibrated("soft.stands_out")
_LEAST_PART = calibrated("soft.least_part")
_LEAST_CELLS = calibrated("soft.least_cells")
# Voxels that are looked at, evenly spread: they bound the time.
_MOST_LOOKED_AT = 150_000
_WINDOW_SIGMAS = calibrated("soft.window_sigmas")
# Smoothing, voxels, of the grey values that the surface of the bone is taken from: enough against single
# voxels. Bone alone is fitted with no more, or its thin walls would vanish first and seem to need a medium.
_CALM_VOXELS = 0.6
# Rounds in which body and medium are fitted in turn: a fixed count.
_ROUNDS = 5
_MOST_SOFT = calibrated("soft.densest")
_CLEAR = calibrated("soft.clear_of_bone")
_SD = calibrated("soft.sd")
_LEVEL_SD = calibrated("soft.level_sd")
_FRAME_SD = calibrated("soft.frame_sd")
_MODEL_DOUBT = calibrated("soft.model_doubt")
_TOLD = calibrated("soft.reported_share")


@dataclass(frozen=True)
class SoftTissue:
    """Something soft around the stapes.

    Attributes
    ----------
    grey : ndarray of float32, [z, y, x]
        The box's grey values as they would be with air in its place.
    taken : ndarray of float32, [z, y, x]
        What was subtracted, as a share of the contrast between bone and air.
    level : float
        Its typical grey value, as a share of that contrast.
    """

    grey: NDArray[np.float32]
    taken: NDArray[np.float32]
    level: float

    @property
    def doubt(self) -> NDArray[np.float32]:
        """By how much the share of bone may be wrong all around at once, where the frame is concerned."""
        return self.taken * np.float32(_FRAME_SD)


def subtract_soft_tissue(
    cut: Cut,
    distances_mm: tuple[NDArray[np.float32], NDArray[np.float32] | None],
    reach_mm: float,
    spacing_mm: Array,
    levels: tuple[Air, float, float | None],
    sigma_mm: float,
) -> SoftTissue | None:
    """Detect soft material around the stapes and subtract it from the grey values; None where there is none.

    Parameters
    ----------
    cut : Cut
        The plate's face subtracted.
    distances_mm : (ndarray of float32, [z, y, x], the same or None)
        From the stapes, and from other bone where that is near.
    reach_mm : float
        How far the stapes' blur reaches.
    spacing_mm : ndarray, (3,)
    levels : (Air, bone, between)
        ``between``: the grey value above which voxels were taken for bone; None: half way.
    sigma_mm : float
        Standard deviation of the point spread.

    Notes
    -----
    In a medium of the level b (air 0, bone 1) a body's blurred grey value is b + (1 - b) m, m its share
    blurred in air; its surface lies at (1 + b) / 2. m is modelled as a two-valued body with that surface,
    b = sum G (1 - m) (w - m) / sum G (1 - m)^2 over a Gaussian window G of two widths of the blur, in turn;
    then m = (w - b) / (1 - b) takes the place of w. Inside bone that changes nothing. Where fluid lies around
    the stapes, its level is the 0, and b is negative in bubbles.
    """
    if not _sees_soft_tissue(cut, distances_mm, reach_mm, spacing_mm, levels, sigma_mm):
        return None
    soft = taken_off(cut, distances_mm, reach_mm, spacing_mm, levels[:2], sigma_mm)
    return soft if np.any(soft.taken) else None


def taken_off(
    cut: Cut,
    distances_mm: tuple[NDArray[np.float32], NDArray[np.float32] | None],
    reach_mm: float,
    spacing_mm: Array,
    levels: tuple[Air, float],
    sigma_mm: float,
) -> SoftTissue:
    """Subtract what is soft around the stapes from the grey values; see ``subtract_soft_tissue``.

    Notes
    -----
    Other bone of another density gets the stapes' height: else a medium in the gap would make up for it.

    Bone thinner than the blur (the edges of gutters) stays below half of its contrast and looks like
    something soft. A two-valued body whose surface lies at a fitted level explains it without a medium:
    where that leaves the smaller sum of squares over the window, nothing is subtracted.
    """
    (distance_mm, away_mm), (air, bone) = distances_mm, levels
    contrast = bone - air.level
    near = distance_mm < 1.99 * reach_mm
    box = tuple(slice(int(k.min()), int(k.max()) + 1) for k in np.nonzero(near))
    share = (cut.grey[box] - np.float32(air.level)) / np.float32(contrast)
    height = np.ones_like(share)
    if away_mm is not None:
        height[away_mm[box] < np.minimum(distance_mm[box], reach_mm)] = neighbour_share(
            cut, (air.level, bone)
        )
        share /= height
    spacing = spacing_mm[::-1]
    everywhere = np.ones(share.shape, dtype=bool)
    width = _WINDOW_SIGMAS * sigma_mm / spacing
    noise = air.noise / contrast * np.sqrt(air.correlation)
    least = max(0.5 * _LEAST_SHARE, 3.0 * noise / np.sqrt(float(np.prod(2.0 * np.sqrt(np.pi) * width))))
    medium = np.zeros_like(share)
    calm = gaussian(share, _CALM_VOXELS, truncate=3.0)
    for _ in range(_ROUNDS):
        body = body_share(calm, np.float32(0.5) * (1 + medium), everywhere)
        model = blurred(body, sigma_mm, spacing)
        free = np.where(model < _CLEAR, 1 - model, np.float32(0.0))
        total = gaussian(free * (share - model), width, truncate=3.0)
        weight = gaussian(free * free, width, truncate=3.0)
        medium = total / np.maximum(weight, np.float32(1e-3))
        medium *= np.clip((np.abs(medium) - least) / least, 0.0, 1.0)
        np.clip(medium, np.float32(-_MOST_SOFT), np.float32(_MOST_SOFT), out=medium)
    taken = share - (share - medium) / (1 - medium)
    # Bone itself is left as it is: there the medium is unknown.
    taken *= model < 0.98
    if np.any(taken):
        excess = share * np.float32(contrast)
        start = (contrast, sigma_mm, air.noise, False)
        bone_alone = fit_bodies(excess, everywhere, spacing_mm, *start, most_smoothing=_CALM_VOXELS)
        gain = (share - model - medium * (1 - model)) ** 2
        gain -= (share - blurred(bone_alone.body, sigma_mm, spacing)) ** 2
        taken *= gaussian(np.where(model < _CLEAR, gain, np.float32(0.0)), width, truncate=3.0) < 0
        medium *= taken != 0
    grey, whole = cut.grey.copy(), np.zeros_like(cut.grey)
    whole[box] = taken * height
    grey[box] -= np.float32(contrast) * whole[box]
    collar = (medium > least) & (distance_mm[box] <= reach_mm) & (model < _CLEAR)
    level = float(np.median((medium * height)[collar])) if np.any(collar) else 0.0
    return SoftTissue(grey, whole, level)


def _sees_soft_tissue(
    cut: Cut,
    distances_mm: tuple[NDArray[np.float32], NDArray[np.float32] | None],
    reach_mm: float,
    spacing_mm: Array,
    levels: tuple[Air, float, float | None],
    sigma_mm: float,
) -> bool:
    """Search a collar around the stapes, cell by cell, for grey values that the blur does not explain."""
    (distance_mm, away_mm), (air, bone, between) = distances_mm, levels
    # Distances are from the first voxel above ``between``: the surface at the middle level lies beside it.
    start = 0.5 if between is None else float(np.clip((between - air.level) / (bone - air.level), 0.02, 0.98))
    half = 0.5 * float(spacing_mm.mean()) + sigma_mm * float(normal_quantile(start))
    collar = (distance_mm > np.float32(max(sigma_mm + half, 0.0))) & (distance_mm < np.float32(reach_mm))
    index = every_nth(collar, max(1, int(np.count_nonzero(collar)) // _MOST_LOOKED_AT))
    if len(index) == 0:
        return False
    model = normal_cdf(-(distance_mm.ravel()[index].astype(float) - half) / sigma_mm)
    if away_mm is not None:
        # Bone of another density has its own height, and its first voxels lie at another share of that.
        bright = neighbour_share(cut, (air.level, bone))
        beyond = 0.5 * float(spacing_mm.mean())
        beyond += sigma_mm * float(normal_quantile(min(0.98, start / bright)))
        model = model + bright * normal_cdf(-(away_mm.ravel()[index].astype(float) - beyond) / sigma_mm)
    good = model < _MOST_BONE
    index, model = index[good], model[good]
    if len(index) == 0:
        return False
    rest = (cut.grey.ravel()[index] - air.level) / (bone - air.level) - model
    places = np.stack(np.unravel_index(index, cut.grey.shape), axis=1) * spacing_mm[::-1]
    number = cells_of(places, _CELL_MM)
    count = np.bincount(number)
    used = count >= _LEAST_CELL
    if not np.any(used):
        return False
    mean = np.bincount(number, rest)[used] / count[used]
    expected = np.bincount(number, model)[used] / count[used]
    noise = air.noise / (bone - air.level) * np.sqrt(air.correlation / count[used])
    soft = np.abs(mean) > np.maximum(_LEAST_SHARE + _MODEL_DOUBT * expected, _STANDS_OUT * noise)
    part = count[used][soft].sum() / count[used].sum()
    return bool(np.count_nonzero(soft) >= _LEAST_CELLS and part > _LEAST_PART)


def soft_tissue_covariance(
    soft: SoftTissue, own: NDArray[np.bool_], cut: Cut, volume: Volume, moments: Moments
) -> Array:
    """Return the covariance (10, 10) of the subtracted material, which has a relative standard deviation.

    ``own`` [z, y, x] are the voxels of the stapes. The eighths around the stapes have independent errors, and
    half of it is common to all. The level of something faint has a larger relative deviation.
    """
    sd = float(np.hypot(_SD, _LEVEL_SD / max(soft.level, _LEVEL_SD)))
    where = own & (np.abs(soft.taken) > 1e-4)
    if not np.any(where):
        return np.zeros((10, 10))
    effects, away = voxel_effects(soft.taken, where, cut.first, volume, moments)
    common = effects.sum(axis=0)
    return np.asarray(0.5 * sd**2 * (by_octants(effects, away) + np.outer(common, common)))


def soft_notices(soft: SoftTissue, own: NDArray[np.bool_], volume: Volume, moments: Moments) -> list[Notice]:
    """Report the medium around the stapes, whose voxels are ``own`` [z, y, x], and the share subtracted."""
    share = float(soft.taken[own].sum(dtype=float)) * volume.voxel_mm3 / moments.volume_mm3
    if abs(share) < _TOLD:
        return []
    if share < 0.0:
        text = (
            f"Something darker than what surrounds the stapes elsewhere lies against it, such as bubbles of "
            f"air in fluid: {-100.0 * share:.2g} % of the volume were added for it, and the budget holds "
            f"what is not known of that (surroundings). Scan without bubbles to be sure."
        )
        return [Notice("soft_surroundings", text)]
    text = (
        f"Something neither air nor bone lies against the stapes (ligament, fluid, glue or mucosa, about "
        f"{100.0 * soft.level:.0f} % as bright as bone): {100.0 * share:.2g} % of the volume were subtracted "
        f"for it, and the budget holds what is not known of that (surroundings). Its own mass is left out: "
        f"name it with {named('add_mass')}; dry or clean the sample to be sure."
    )
    return [Notice("soft_surroundings", text)]

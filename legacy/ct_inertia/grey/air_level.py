"""The grey level of air near the stapes, its noise, and what clipping at the lowest grey value did to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.ct_inertia.volume.mask_statistics import Sums, deviation, every_nth, lowest, sums
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density, normal_quantile
from legacy.stapeskit.arrays import Array

# Voxels of air from which a mean is taken: its noise is 5 % of a voxel's; and in an eighth of the box, 7 %.
_LEAST_AIR = 400
# In an eighth of the box: 1 / sqrt(200) = 7 % of the noise of a voxel.
_LEAST_OCTANT = 200
_CLIPPED = calibrated("levels.clipped")
_MOST_CLIPPED = calibrated("levels.most_clipped")
# Pairs of voxels for a correlation, whose error is then 0.003.
_PAIRS = 150_000
# Largest distance of correlated voxels that is looked at: beyond the kernels of scanners.
_MOST_LAG = 8
_STANDS_OUT = calibrated("levels.stands_out")
_UNSEEN_SHADING = calibrated("levels.unseen_shading")
_CLIPPED_SD = calibrated("levels.clipped_sd")
# Edge of the cells, voxels, whose means are compared to find what is no air: about twice the reach of usual
# blur (3 times 1.2 voxels). So many voxels are looked at in all, for time only, and at least 30 of a cell,
# whose mean then has 0.18 of their noise: fluid of one standard deviation shows.
_CELL_VOXELS = 8
_LOOKED_AT = 300_000
_LEAST_CELL = 30
# Standard deviations that 3 of ten million means exceed by chance; a box has some ten thousand cells.
_NO_NOISE = 5.0
# Fewer bright cells are dust or the corner of a plate: of thousands they shift the mean by less than 0.1 % of
# the contrast.
_LEAST_CELLS = 3


@dataclass(frozen=True)
class Surroundings:
    """Masks of a box around the stapes.

    Attributes
    ----------
    grey : ndarray of float32, [z, y, x]
    bone : ndarray of bool
        The stapes at its middle level.
    foreign : ndarray of bool
        Other bodies: bone, plate, dust.
    spacing_mm : ndarray, (3,)
    single : ndarray, [z, y, x], or None
        Where the grey values are means over voxels of the scan: one of those voxels each. Only they show
        whether noise was clipped.
    """

    grey: NDArray[np.float32]
    bone: NDArray[np.bool_]
    foreign: NDArray[np.bool_]
    spacing_mm: Array
    single: NDArray[Any] | None = None


@dataclass(frozen=True)
class Guess:
    """First guess of the grey levels of air, bone and (where there is any) plastic.

    ``between`` is the grey value above which voxels were taken for bone; None: half way.
    """

    air: float
    bone: float
    plastic: float | None = None
    between: float | None = None


@dataclass(frozen=True)
class Air:
    """Air around the stapes.

    Attributes
    ----------
    level, noise, sd : float
        Grey level, noise of a voxel, standard uncertainty of the level.
    correlation : float
        Variance of sums of noise over that of white noise.
    clipped : float
        Share of air voxels at the lowest grey value, 0 when there is no such pile; level and noise are then
        those from before the clipping.
    lowest : float
        Lowest grey value seen.
    single_noise : float
        Noise of one voxel of the scan where the grey values are means over several; 0 otherwise.
    slope : (x, y, z)
        Change of the level per mm along the axes of the box; 0 where noise explains it.
    """

    level: float
    noise: float
    sd: float
    correlation: float
    clipped: float
    lowest: float = 0.0
    single_noise: float = 0.0
    slope: tuple[float, float, float] = (0.0, 0.0, 0.0)


def air_shell(around: Surroundings, distance_mm: NDArray[np.float32], reach_mm: float) -> NDArray[np.bool_]:
    """Return the voxels [z, y, x] outside the reach of the blur of the stapes and of every other body."""
    shell = distance_mm > reach_mm
    if np.any(around.foreign):
        shell &= capped_distance(around.foreign, around.spacing_mm, reach_mm) >= reach_mm * 0.999
    return shell


def measure_air(around: Surroundings, shell: NDArray[np.bool_], guess: float) -> Air:
    """Measure the air of the box.

    Parameters
    ----------
    around : Surroundings
    shell : ndarray of bool, [z, y, x]
        Voxels of air; see ``air_shell``.
    guess : float
        Level to use when no air can be seen.

    Notes
    -----
    The mean is taken, and where noise is clipped at 0 the level from before the clipping. Its uncertainty
    comes from the scatter between the eight octants of the box, so that shading and streaks count, not
    from the noise alone. Fluid that is as faint as the noise of a voxel shows in the means over cells.
    """
    shell = _drop_bright_cells(around.grey, shell)
    seen = int(np.count_nonzero(shell))
    if seen < _LEAST_AIR:
        values = around.grey[shell]
        noise = float(np.std(values, dtype=float)) if values.size > 30 else 0.0
        return Air(guess, noise, max(noise, 1e-6 * abs(guess)), 1.0, 0.0)
    few = around.grey.ravel()[every_nth(shell, max(1, seen // 50_000))].astype(float)
    middle, high = (float(v) for v in np.percentile(few, [50.0, 90.0]))
    air = _is_near_level(around.grey, shell, middle, 5.0 * (high - middle) + 1e-12)
    total, size = sums(around.grey, air), int(np.count_nonzero(air))
    level = total.mean
    noise = deviation(around.grey, air, level)
    filled = total.eighth_count > _LEAST_OCTANT
    count, means = total.eighth_count[filled], total.eighth_total[filled] / total.eighth_count[filled]
    correlation = _correlation(around.grey, shell, every_nth(air, max(1, size // _PAIRS)), level, noise)
    random = noise * np.sqrt(correlation / size)
    scatter = _UNSEEN_SHADING * noise
    if len(means) > 2:
        weight = count / count.sum()
        scatter = float(np.sqrt(weight @ (means - weight @ means) ** 2 / (len(means) - 1.0)))
    sd = max(scatter, random)
    ones = around.grey if around.single is None else around.single
    least, equal = lowest(ones, air)
    pile = equal / size
    if not (_CLIPPED < pile < _MOST_CLIPPED and least <= 0.0):
        slope = _slope(total, around.spacing_mm, noise * float(np.sqrt(correlation)))
        return Air(level, noise, sd, correlation, 0.0, least, slope=slope)
    level, single = _fit_censored(level, pile, least)
    # Clipping takes the same share off the scatter of means as off that of the voxels in them.
    noise = (
        single if around.single is None else noise * single / max(float(ones[air].std(dtype=float)), 1e-12)
    )
    return Air(level, noise, sd + _CLIPPED_SD * pile * single, correlation, pile, least, single)


def _drop_bright_cells(grey: NDArray[np.float32], shell: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Leave out of a shell [z, y, x] the cells that are brighter than air is anywhere by its own scatter.

    The scatter is that of the darker half, which holds no fluid as long as most of the shell is air.
    """
    index = every_nth(shell, max(1, int(np.count_nonzero(shell)) // _LOOKED_AT))
    cells = tuple(-(-n // _CELL_VOXELS) for n in shell.shape)
    place = [k // _CELL_VOXELS for k in np.unravel_index(index, shell.shape)]
    number = np.ravel_multi_index(place, cells)
    count = np.bincount(number, minlength=int(np.prod(cells)))
    used = count >= _LEAST_CELL
    if not np.any(used):
        return shell
    mean = np.bincount(number, grey.ravel()[index], minlength=len(count))[used] / count[used]
    middle = float(np.median(mean))
    scaled = (mean - middle) * np.sqrt(count[used])
    scatter = 1.4826 * float(np.median(-scaled[scaled <= 0.0]))
    bright = np.zeros(cells, dtype=bool)
    bright.ravel()[used] = scaled > _NO_NOISE * scatter
    if np.count_nonzero(bright) < _LEAST_CELLS:
        return shell
    for axis, size in enumerate(shell.shape):
        bright = np.repeat(bright, _CELL_VOXELS, axis=axis).take(range(size), axis=axis)
    return shell & ~bright


def _slope(air: Sums, spacing_mm: Array, noise: float) -> tuple[float, float, float]:
    """Return the change of the level per mm along x, y, z between halves of the box, if significant."""
    slope = [0.0, 0.0, 0.0]
    for axis in range(3):
        count, total = air.count[2 - axis], air.total[2 - axis]
        low = np.arange(len(count)) < len(count) // 2
        parts = count[low].sum(), count[~low].sum()
        if min(parts) < _LEAST_AIR:
            continue
        change = total[~low].sum() / parts[1] - total[low].sum() / parts[0]
        place = count * np.arange(len(count)) * float(spacing_mm[axis])
        length = place[~low].sum() / parts[1] - place[low].sum() / parts[0]
        if abs(change) > _STANDS_OUT * noise * np.sqrt(1.0 / parts[0] + 1.0 / parts[1]):
            slope[axis] = float(change / length)
    return slope[0], slope[1], slope[2]


def _fit_censored(mean: float, pile: float, lowest: float) -> tuple[float, float]:
    """Return level and noise of a normal distribution of which a share ``pile`` was raised to ``lowest``.

    With a = (level - lowest) / noise: pile = Phi(-a), mean - lowest = noise (a Phi(a) + phi(a)).
    """
    a = -float(normal_quantile(pile))
    bell = float(normal_density(a))
    noise = (mean - lowest) / (a * float(normal_cdf(a)) + bell)
    return lowest + a * noise, noise


def unclipped(
    grey: NDArray[np.float32],
    where: NDArray[np.bool_],
    air: Air,
    expected: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Subtract the mean bias of clipping at the lowest grey value.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    where : ndarray of bool, [z, y, x]
        Voxels to correct.
    air : Air
        With the level and noise from before the clipping.
    expected : ndarray of float32, [z, y, x], optional
        Grey values without noise and clipping, from a model of the body; without it they are read from the
        surroundings of each voxel, whose noise biases them.

    Notes
    -----
    A voxel of true grey value m has after clipping the mean m + s (phi(a) - a Phi(-a)) with
    a = (m - lowest) / s; the difference is subtracted. Without ``expected``, the mean is that of the
    surroundings (Gaussian of 0.8 voxels) and the relation is inverted.
    """
    if air.clipped == 0.0:
        return grey
    noise = air.single_noise or air.noise
    result = grey.copy()
    if expected is not None:
        a = (expected[where].astype(float) - air.lowest) / noise
        added = normal_density(a) - a * normal_cdf(-a)
        result[where] -= (noise * added).astype(np.float32)
        return result
    a = np.linspace(-6.0, 6.0, 2401)
    mean = a * normal_cdf(a) + normal_density(a)
    local = (gaussian(grey, 0.8)[where].astype(float) - air.lowest) / noise
    true = np.interp(local, mean, a)
    result[where] -= (noise * np.where(local < mean[-1], local - true, 0.0)).astype(np.float32)
    return result


def _is_near_level(
    grey: NDArray[np.float32], where: NDArray[np.bool_], middle: float, reach: float
) -> NDArray[np.bool_]:
    """Return where grey values lie within ``reach`` of a level, layer by layer."""
    result = np.empty_like(where)
    away = np.empty(grey.shape[1:], dtype=np.float32)
    for layer, source, out in zip(grey, where, result, strict=True):
        np.subtract(layer, np.float32(middle), out=away)
        np.abs(away, out=away)
        np.less_equal(away, np.float32(reach), out=out)
        out &= source
    return result


def _correlation(
    grey: NDArray[np.float32],
    shell: NDArray[np.bool_],
    few: NDArray[np.int64],
    level: float,
    noise: float,
) -> float:
    """Return the variance of sums of noise over that of white noise.

    The correlations between neighbours at one, two, ... voxels along each axis are added up, as long as they
    stand out of their own scatter, and the three axes multiplied: exact for noise that was smoothed axis by
    axis, as reconstruction filters do.
    """
    if noise <= 0.0:
        return 1.0
    flat, inside = grey.ravel(), shell.ravel()
    here = flat[few] - np.float32(level)
    total = 1.0
    for stride in (1, shell.shape[2], shell.shape[1] * shell.shape[2]):
        along = 1.0
        for lag in range(1, _MOST_LAG + 1):
            there = few + lag * stride
            good = there < flat.size
            good[good] &= inside[there[good]]
            count = int(np.count_nonzero(good))
            if count < _LEAST_AIR:
                break
            other = flat[there[good]] - np.float32(level)
            # Streaks and dust are no noise: what lies beyond five deviations is left out.
            mild = (np.abs(here[good]) < 5.0 * noise) & (np.abs(other) < 5.0 * noise)
            r = float(np.mean(here[good][mild] * other[mild], dtype=float)) / noise**2
            if abs(r) < 3.5 / np.sqrt(count):
                break
            along += 2.0 * r
        total *= max(along, 0.2)
    return total

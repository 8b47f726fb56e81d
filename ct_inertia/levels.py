"""Grey levels of air and bone, measured where they are pure and near the stapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Levels
from ct_inertia.distance import capped_distance
from kinematics.notices import Notice

Array = NDArray[np.float64]

_SHELL_VOXELS = 9.0
_LEAST_AIR = 400
_GOOD_BONE_SD = 1e-3
_CLIPPED = 0.01
_MOST_CLIPPED = 0.9


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
    """First guess of the grey levels of air, bone and (where there is any) plastic."""

    air: float
    bone: float
    plastic: float | None = None


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
    """

    level: float
    noise: float
    sd: float
    correlation: float
    clipped: float
    lowest: float = 0.0
    single_noise: float = 0.0


def measure_air(around: Surroundings, distance_mm: NDArray[np.float32], reach_mm: float, guess: float) -> Air:
    """Measure the air in a shell outside the reach of the stapes' blur and of every other body's.

    Parameters
    ----------
    around : Surroundings
    distance_mm : ndarray of float32, [z, y, x]
        From the stapes.
    reach_mm : float
        How far the blur reaches.
    guess : float
        Level to use when no air can be seen.

    Notes
    -----
    The mean is taken, and where noise is clipped at 0 the level from before the clipping. Its uncertainty
    comes from the scatter between the eight octants of the shell, so that shading and streaks count, not
    from the noise alone.
    """
    step = float(np.max(around.spacing_mm))
    outer = reach_mm + _SHELL_VOXELS * step
    shell = (distance_mm > reach_mm) & (distance_mm < outer * 0.999)
    if np.any(around.foreign):
        shell &= capped_distance(around.foreign, around.spacing_mm, reach_mm) >= reach_mm * 0.999
    values = around.grey[shell].astype(float)
    if values.size < _LEAST_AIR:
        noise = float(np.std(values)) if values.size > 30 else 0.0
        return Air(guess, noise, max(noise, 1e-6 * abs(guess)), 1.0, 0.0)
    middle = float(np.median(values))
    high = float(np.percentile(values, 90.0)) - middle
    kept = np.abs(values - middle) <= 5.0 * high + 1e-12
    values = values[kept]
    level, noise = float(values.mean()), float(values.std())
    place = np.stack(np.nonzero(shell), axis=1)[kept]
    half = np.array(shell.shape) / 2.0
    octant = (place > half) @ np.array([1, 2, 4])
    count = np.bincount(octant, minlength=8)
    means = np.bincount(octant, values, minlength=8)[count > 200] / count[count > 200]
    scatter = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 2 else noise / 10.0
    sd = max(scatter, noise / np.sqrt(values.size))
    ones = values if around.single is None else around.single[shell].astype(float)
    lowest = float(ones.min())
    pile = float(np.mean(ones == lowest))
    correlation = _correlation(around.grey, shell, noise)
    if not (_CLIPPED < pile < _MOST_CLIPPED and lowest <= 0.0):
        return Air(level, noise, sd, correlation, 0.0, lowest)
    level, single = _censored(level, pile, lowest)
    # Clipping takes the same share off the scatter of means as off that of the voxels in them.
    noise = single if around.single is None else noise * single / max(float(ones.std()), 1e-12)
    return Air(level, noise, sd + 0.02 * pile * single, correlation, pile, lowest, single)


def _censored(mean: float, pile: float, lowest: float) -> tuple[float, float]:
    """Return level and noise of a normal distribution of which a share ``pile`` was raised to ``lowest``.

    With a = (level - lowest) / noise: pile = Phi(-a), mean - lowest = noise (a Phi(a) + phi(a)).
    """
    from scipy.special import ndtr, ndtri

    a = -float(ndtri(pile))
    bell = float(np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi))
    noise = (mean - lowest) / (a * float(ndtr(a)) + bell)
    return lowest + a * noise, noise


def unclipped(grey: NDArray[np.float32], where: NDArray[np.bool_], air: Air) -> NDArray[np.float32]:
    """Take off what clipping at the lowest grey value added on average.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    where : ndarray of bool, [z, y, x]
        Voxels to correct.
    air : Air
        With the level and noise from before the clipping.

    Notes
    -----
    A voxel of true grey value m has after clipping the mean lowest + s (a Phi(a) + phi(a)) with
    a = (m - lowest) / s. The mean is taken from the voxel's surroundings (Gaussian of 0.8 voxels), the
    relation is inverted, and the difference is subtracted from the voxel itself.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtr

    if air.clipped == 0.0:
        return grey
    noise = air.single_noise or air.noise
    a = np.linspace(-6.0, 6.0, 2401)
    mean = a * ndtr(a) + np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi)
    local = (gaussian_filter(grey, 0.8)[where].astype(float) - air.lowest) / noise
    true = np.interp(local, mean, a)
    result = grey.copy()
    result[where] -= (noise * np.where(local < mean[-1], local - true, 0.0)).astype(np.float32)
    return result


def _correlation(grey: NDArray[np.float32], air: NDArray[np.bool_], noise: float, block: int = 4) -> float:
    """Compare the scatter of block means with that of white noise."""
    nz, ny, nx = (n // block for n in air.shape)
    if noise <= 0.0 or min(nz, ny, nx) == 0:
        return 1.0

    def blocks(array: NDArray[np.floating]) -> Array:
        part = array[: nz * block, : ny * block, : nx * block]
        return np.asarray(
            part.reshape(nz, block, ny, block, nx, block).sum(axis=(1, 3, 5), dtype=float).ravel()
        )

    full = blocks(air.astype(np.float32)) == block**3
    if np.count_nonzero(full) < 50:
        return 1.0
    means = blocks(np.where(air, grey, np.float32(0.0)))[full] / block**3
    middle = np.median(means)
    scale = 1.4826 * np.median(np.abs(means - middle))
    return float(np.clip((scale / noise) ** 2 * block**3, 1.0, block**3))


@dataclass(frozen=True)
class Bone:
    """Pure bone inside the stapes: level, standard uncertainty, noise of a voxel, and how it was found."""

    level: float
    sd: float
    noise: float
    found_by: str
    notices: tuple[Notice, ...] = ()


def measure_bone(around: Surroundings, air: Air, sigma_mm: float) -> Bone | None:
    """Measure the bone level from voxels deeper than three widths of the blur.

    Returns None when the body has too few of them for a level within 0.1 %.

    Notes
    -----
    Depths are between voxel centres and the first centre outside; the surface lies half a voxel nearer.
    What blur is left at depth d under a plane surface, 1 - Phi(d / s), is added back.
    """
    from scipy.special import ndtr

    half = 0.5 * float(np.mean(around.spacing_mm))
    cap = 4.2 * sigma_mm + 2.0 * half
    depth = capped_distance(~around.bone, around.spacing_mm, cap) - half
    for least in (3.2, 3.0, 2.75, 2.5):
        deep = depth > least * sigma_mm
        values = around.grey[deep].astype(float)
        if values.size < 200:
            continue
        share = ndtr(depth[deep] / sigma_mm).astype(float)
        values = air.level + (values - air.level) / share
        noise = float(values.std())
        random = noise / np.sqrt(values.size) * np.sqrt(air.correlation)
        rest = 0.25 * float(np.mean(1.0 - share)) * (float(values.mean()) - air.level)
        sd = float(np.hypot(np.hypot(random, rest), _scatter(values, deep)))
        if random < _GOOD_BONE_SD * (values.mean() - air.level):
            return Bone(float(values.mean()), sd, noise, "interior")
    return None


def _scatter(values: Array, deep: NDArray[np.bool_]) -> float:
    """Return the standard error of a level from its scatter over regions of the body."""
    place = np.stack(np.nonzero(deep), axis=1)
    middle = np.median(place, axis=0)
    octant = (place > middle) @ np.array([1, 2, 4])
    count = np.bincount(octant, minlength=8)
    good = count > 25
    if np.count_nonzero(good) < 3:
        return 0.0
    means = np.bincount(octant, values, minlength=8)[good] / count[good]
    weight = count[good] / count[good].sum()
    random = float(weight @ (values.var() / count[good]))
    spread = float(np.sqrt(max(0.0, weight @ (means - weight @ means) ** 2 - random)))
    return spread / np.sqrt(np.count_nonzero(good) - 1.0)


def as_levels(air: Air, bone: Bone, plastic: float | None) -> Levels:
    """Put the levels together."""
    return Levels(air.level, bone.level, plastic, air.noise, air.sd, bone.sd, bone.found_by)

"""Grey levels of air and bone, measured where they are pure and near the stapes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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
_LEAST_DEEP = 200
_CELL_VOXELS = 6.0
_LEAST_CELL, _LEAST_CELLS = 20, 12
_SIGNIFICANT = 4.0
_TILTED, _SLOPING = 1e-3, 8.0
_UNEVEN = 0.01
# The rim of bone next to the surface is not seen: it may differ from the inside by as much as that varies.
_HIDDEN = 0.5
_CLIPPED = 0.01
_MOST_CLIPPED = 0.9
_PAIRS = 150_000
_MOST_LAG = 8


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
    index = np.flatnonzero(shell)
    values = around.grey.ravel()[index]
    if values.size < _LEAST_AIR:
        noise = float(np.std(values, dtype=float)) if values.size > 30 else 0.0
        return Air(guess, noise, max(noise, 1e-6 * abs(guess)), 1.0, 0.0)
    few = values[:: max(1, values.size // 50_000)].astype(float)
    middle, high = (float(v) for v in np.percentile(few, [50.0, 90.0]))
    kept = np.abs(values - np.float32(middle)) <= np.float32(5.0 * (high - middle) + 1e-12)
    index, values = index[kept], values[kept]
    level, noise = float(values.mean(dtype=float)), float(values.std(dtype=float))
    octant = _octants(index, shell.shape)
    count = np.bincount(octant, minlength=8)
    means = np.bincount(octant, values, minlength=8)[count > 200] / count[count > 200]
    correlation = _correlation(around.grey, shell, index, level, noise)
    random = noise * np.sqrt(correlation / values.size)
    scatter = noise / 10.0
    if len(means) > 2:
        weight = count[count > 200] / count[count > 200].sum()
        scatter = float(np.sqrt(weight @ (means - weight @ means) ** 2 / (len(means) - 1.0)))
    sd = max(scatter, random)
    ones = values if around.single is None else around.single.ravel()[index].astype(np.float32)
    lowest = float(ones.min())
    pile = float(np.mean(ones == lowest))
    if not (_CLIPPED < pile < _MOST_CLIPPED and lowest <= 0.0):
        return Air(level, noise, sd, correlation, 0.0, lowest)
    level, single = _censored(level, pile, lowest)
    # Clipping takes the same share off the scatter of means as off that of the voxels in them.
    noise = single if around.single is None else noise * single / max(float(ones.std(dtype=float)), 1e-12)
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


def unclipped(
    grey: NDArray[np.float32],
    where: NDArray[np.bool_],
    air: Air,
    expected: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Take off what clipping at the lowest grey value added on average.

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
    from scipy.special import ndtr

    if air.clipped == 0.0:
        return grey
    noise = air.single_noise or air.noise
    result = grey.copy()
    if expected is not None:
        a = (expected[where].astype(float) - air.lowest) / noise
        added = np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi) - a * ndtr(-a)
        result[where] -= (noise * added).astype(np.float32)
        return result
    from scipy.ndimage import gaussian_filter

    a = np.linspace(-6.0, 6.0, 2401)
    mean = a * ndtr(a) + np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi)
    local = (gaussian_filter(grey, 0.8)[where].astype(float) - air.lowest) / noise
    true = np.interp(local, mean, a)
    result[where] -= (noise * np.where(local < mean[-1], local - true, 0.0)).astype(np.float32)
    return result


def _octants(index: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return which eighth of a box (0 to 7) each flat index lies in."""
    rows, columns = shape[1] * shape[2], shape[2]
    z, rest = np.divmod(index, rows)
    y, x = np.divmod(rest, columns)
    return np.asarray(
        (z > shape[0] / 2.0) + 2 * (y > shape[1] / 2.0) + 4 * (x > shape[2] / 2.0), dtype=np.int64
    )


def _correlation(
    grey: NDArray[np.float32],
    shell: NDArray[np.bool_],
    index: NDArray[np.int64],
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
    few = index[:: max(1, index.size // _PAIRS)]
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


@dataclass(frozen=True)
class Bone:
    """Pure bone inside the stapes.

    Attributes
    ----------
    level, sd, noise : float
        Grey level, its standard uncertainty, noise of a voxel.
    found_by : str
    notices : tuple of Notice
    slope : ndarray, (3,)
        Change of the level per mm along x, y, z of the box; 0 where noise explains it.
    place_mm : ndarray, (3,)
        Where ``level`` holds, from the box's first voxel along x, y, z.
    """

    level: float
    sd: float
    noise: float
    found_by: str
    notices: tuple[Notice, ...] = ()
    slope: Array = field(default_factory=lambda: np.zeros(3))
    place_mm: Array = field(default_factory=lambda: np.zeros(3))

    def moved_to(self, place_mm: Array) -> Bone:
        """Return the same bone with its level at another place (3,) of the box."""
        return replace(self, level=float(self.level + self.slope @ (place_mm - self.place_mm)))


def measure_bone(around: Surroundings, air: Air, sigma_mm: float) -> Bone | None:
    """Measure the bone level from voxels deeper than three widths of the blur.

    Returns None when the body has too few of them for a level within 0.1 %.

    Notes
    -----
    Depths are between voxel centres and the first centre outside; the surface lies half a voxel nearer.
    What blur is left at depth d under a plane surface, 1 - Phi(d / s), is added back. A level that changes
    linearly through the bone is told by its slope, what varies beyond that by the scatter between cells of
    a few voxels; both only as far as noise does not explain them.
    """
    from scipy.special import ndtr

    box = _box_of(around.bone)
    inside = around.bone[box]
    grey = around.grey[box]
    half = 0.5 * float(np.mean(around.spacing_mm))
    cap = 4.2 * sigma_mm + 2.0 * half
    depth = capped_distance(~inside, around.spacing_mm, cap)
    for least in (3.2, 3.0, 2.75, 2.5):
        index = np.flatnonzero(depth > np.float32(least * sigma_mm + half))
        if index.size < _LEAST_DEEP:
            continue
        share = ndtr((depth.ravel()[index].astype(float) - half) / sigma_mm)
        values = air.level + (grey.ravel()[index] - air.level) / share
        contrast = float(values.mean()) - air.level
        random = float(values.std()) / np.sqrt(values.size) * np.sqrt(air.correlation)
        if random < _GOOD_BONE_SD * contrast:
            rest = 0.25 * float(np.mean(1.0 - share)) * contrast
            start = np.array([s.start for s in reversed(box)])
            zyx = np.stack(np.unravel_index(index, depth.shape), axis=1)
            return _bone_of(values, (zyx[:, ::-1] + start) * around.spacing_mm, air, random, rest, around)
    return None


def _box_of(mask: NDArray[np.bool_]) -> tuple[slice, ...]:
    """Return the slices z, y, x of a mask, one voxel wider where there is room."""
    found = []
    for axis in range(3):
        used = np.flatnonzero(mask.any(axis=tuple(k for k in range(3) if k != axis)))
        found.append(slice(max(0, int(used[0]) - 1), int(used[-1]) + 2))
    return tuple(found)


def _bone_of(
    values: Array, places_mm: Array, air: Air, random: float, rest: float, around: Surroundings
) -> Bone:
    """Put together level, slope and uncertainty from deep voxels (n,) at places (n, 3)."""
    middle = places_mm.mean(axis=0)
    level, contrast = float(values.mean()), float(values.mean()) - air.level
    cell = np.floor((places_mm - places_mm.min(axis=0)) / (_CELL_VOXELS * around.spacing_mm)).astype(np.int64)
    width = cell.max(axis=0) + 1
    number = (cell[:, 0] * width[1] + cell[:, 1]) * width[2] + cell[:, 2]
    count = np.asarray(np.bincount(number), dtype=np.int64)
    used = count >= _LEAST_CELL
    if np.count_nonzero(used) < _LEAST_CELLS:
        sd = float(np.sqrt(random**2 + rest**2 + _scatter(values, places_mm) ** 2))
        return Bone(level, sd, float(values.std()), "interior", (), np.zeros(3), middle)
    weight = count[used].astype(float)
    means = np.bincount(number, values)[used] / weight
    sums = [np.bincount(number, p - m)[used] for p, m in zip(places_mm.T, middle, strict=True)]
    away = np.stack(sums, axis=1) / weight[:, None]
    noise = float(np.sqrt(np.maximum(values.var() - np.average((means - level) ** 2, weights=weight), 0.0)))
    design = np.column_stack([np.ones(len(means)), away])
    normal = (design * weight[:, None]).T @ design
    fitted = np.linalg.lstsq(normal, design.T @ (weight * means), rcond=None)[0]
    left = means - design @ fitted
    freedom = len(means) - 4.0
    excess = float(weight @ left**2) / (noise**2 * air.correlation + 1e-12 * contrast**2) - freedom
    significant = excess > _SIGNIFICANT * np.sqrt(2.0 * freedom)
    uneven = noise * float(np.sqrt(air.correlation * excess / weight.sum())) if significant else 0.0
    explained = float(fitted[1:] @ (normal[1:, 1:] @ fitted[1:]))
    tilt = float(np.sqrt(explained / weight.sum()))
    # Compared with the scatter that is left, over as many cells: F of three degrees of freedom.
    scatter = noise**2 * air.correlation + uneven**2 * float(weight.mean())
    sloping = tilt > _TILTED * contrast and explained > 3.0 * _SLOPING * scatter
    slope = fitted[1:] if sloping else np.zeros(3)
    spread = _scatter(values - (places_mm - middle) @ slope, places_mm)
    sd = float(np.sqrt(random**2 + rest**2 + spread**2))
    notices: tuple[Notice, ...] = ()
    if max(uneven, tilt if sloping else 0.0) > _UNEVEN * contrast:
        sd = float(np.hypot(sd, _HIDDEN * uneven))
        varies = 100.0 * float(np.hypot(uneven, tilt)) / contrast
        text = (
            f"The grey value of bone varies inside the stapes by {varies:.1f} % (standard deviation), more "
            f"than noise: its density is not uniform, or the scan is shaded. The mass matrix weights bone by "
            f"its grey value; the budget holds what uniform density would change."
        )
        notices = (Notice("bone_inhomogeneous", text),)
    return Bone(level, sd, noise, "interior", notices, slope, middle)


def _scatter(values: Array, places_mm: Array) -> float:
    """Return the standard error of a level from its scatter over the eighths of the body."""
    octant = (places_mm > np.median(places_mm, axis=0)) @ np.array([1, 2, 4])
    count = np.bincount(octant, minlength=8)
    good = count > _LEAST_CELL
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

"""Where a scene starts: whose voxel is whose, air, noise, blur and contrasts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Labelled, Mask
from ct_inertia.find.distance import capped_distance, used_box
from stapeskit.arrays import Array

NAMES = ("stapes", "other", "plate")
"""Bodies of a scene, in the order in which they win what they share."""

REACH_SIGMAS = 4.2
"""The blur of a plane edge beyond so many widths holds 3e-6 of a width."""

CLOSE_SIGMAS = 5.0
"""Planes so many widths apart share less than 0.005 of a width in the middle of their gap."""

_LEAST_AIR = 400  # voxels of air from which a mean is taken: its noise is 5 % of a voxel's
_CELL_VOXELS, _LEAST_CELL = 8, 30  # edge of the cells that are compared, and voxels of one that counts
_NO_NOISE = 5.0  # standard deviations that 3 of ten million means exceed by chance
_LEAST_DEEP = 12  # voxels of pure bone whose median is a level
_SAME_BONE = 0.05  # other bone whose contrast is nearer to the stapes' than this counts as the same bone
_NEAR_LAGS, _FAR_LAGS = range(1, 9), range(12, 97, 8)  # voxels: kernels of scanners; rings and streaks
_LEAST_CORRELATION = 0.2  # variance of sums over that of white noise: less is a sharpening filter's
NEAR_REACHES = 1.7  # of the blur around the stapes are modelled: its rim and as much air


@dataclass(frozen=True)
class Start:
    """First values of a scene, on a part of the box around the stapes.

    Attributes
    ----------
    part : tuple of 3 slice
        The part of the box, z, y, x; all arrays below are [z, y, x] on it.
    spacing : ndarray, (3,)
        Along z, y, x, mm.
    grey : ndarray of float32
    masks : mapping of str to ndarray of bool
        Bodies that are near, the stapes first.
    distances : mapping of str to ndarray of float32
        From each body, mm, up to twice the reach.
    reach_mm : float
        How far blur reaches.
    basin : ndarray of int8
        Whose voxel it is: 1 for the first body, 2 for the second, ...; 0 beyond the reach of all.
    near, far : ndarray of bool
        Where the model is compared with the grey values; air beyond all blur.
    air, noise, air_sd, correlation : float
    contrasts : mapping of str to float
    sigma_mm : float
    """

    part: tuple[slice, ...]
    spacing: Array
    grey: Grey
    masks: dict[str, Mask]
    distances: dict[str, Grey]
    reach_mm: float
    basin: NDArray[np.int8]
    near: Mask
    far: Mask
    air: float
    noise: float
    air_sd: float
    correlation: float
    contrasts: dict[str, float]
    sigma_mm: float


def start(labelled: Labelled) -> Start:
    """Measure air, noise and blur around the labelled stapes, and give each voxel to a body."""
    box = labelled.box
    spacing = box.spacing_mm[::-1]
    sigma = first_sigma(labelled)
    reach = REACH_SIGMAS * sigma + float(spacing.max())
    part = _part_around(labelled.stapes, NEAR_REACHES * reach, spacing)
    grey = np.ascontiguousarray(box.grey[part])
    masks = {"stapes": labelled.stapes[part]}
    masks |= {name: mask[part] for name, mask in (("other", labelled.other), ("plate", labelled.plate))}
    masks = {name: np.ascontiguousarray(mask) for name, mask in masks.items() if mask.any()}
    cap = NEAR_REACHES * reach
    distances = {name: capped_distance(mask, box.spacing_mm, cap) for name, mask in masks.items()}
    near = distances["stapes"] < np.float32(cap)
    far = np.logical_and.reduce([away > reach for away in distances.values()])
    if box.measured is not None:
        near &= box.measured[part]
        far &= box.measured[part]
    air, noise = labelled.air, labelled.noise
    air_sd = noise
    far = _air_alone(grey, far, air, noise)
    if np.count_nonzero(far) >= _LEAST_AIR:
        air, noise = robust_mean(grey[far])
        air_sd = mean_by_cells(grey[far], np.argwhere(far), 16)[1]
    beside = {
        name: mask for name, mask in masks.items() if (near & (distances[name] < np.float32(reach))).any()
    }
    calm = far & (np.abs(grey - np.float32(air)) < 5.0 * noise)
    return Start(
        part,
        spacing,
        grey,
        beside,
        {name: distances[name] for name in beside},
        reach,
        _basins(grey, beside, distances, reach, sigma),
        near,
        far,
        air,
        max(noise, 1e-6 * (labelled.bone - labelled.air)),
        air_sd,
        noise_correlation(np.where(far, grey - np.float32(air), np.float32(0.0)), calm),
        _contrasts(labelled, grey, beside, air),
        sigma,
    )


def _air_alone(grey: Grey, far: Mask, air: float, noise: float) -> Mask:
    """Leave out cells that are brighter than air is anywhere by its own scatter: fluid, dust, plastic.

    The scatter is that of the darker half of the cells near the first guess of air.
    """
    index = np.argwhere(far)
    if len(index) < _LEAST_AIR:
        return far
    cells = index // _CELL_VOXELS
    size = cells.max(axis=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    count, total = np.bincount(key), np.bincount(key, grey[far])
    mean = total / np.maximum(count, 1)
    usual = (count >= _LEAST_CELL) & (np.abs(mean - air) < 3.0 * noise)
    if np.count_nonzero(usual) < 8:
        return far
    middle = float(np.median(mean[usual]))
    scaled = (mean - middle) * np.sqrt(count)
    dark = scaled[usual & (scaled <= 0.0)]
    scatter = 1.4826 * float(np.median(-dark))
    bright = (count >= _LEAST_CELL) & (scaled > _NO_NOISE * scatter)
    if np.count_nonzero(bright) < 3:
        return far
    kept = np.zeros_like(far)
    kept[tuple(index[~bright[key]].T)] = True
    return kept


def robust_mean(values: Grey) -> tuple[float, float]:
    """Return mean and standard deviation of what lies within four deviations of the median."""
    some = values[:: max(1, values.size // 100_000)]
    middle = float(np.median(some))
    spread = 1.4826 * float(np.median(np.abs(some - np.float32(middle)))) + 1e-12
    kept = values[np.abs(values - np.float32(middle)) < 4.0 * spread].astype(float)
    return (float(kept.mean()), float(kept.std())) if kept.size else (middle, spread)


def mean_by_cells(values: NDArray[np.floating], index: NDArray[np.intp], edge: int) -> tuple[float, float]:
    """Return the mean of values (n,) at indices (n, 3), and its standard error by the scatter of cells.

    Cells are cubes of so many voxels: noise that neighbours share and unevenness both count.
    """
    count, total = by_cells(values, index, edge)
    used = count >= 4
    if np.count_nonzero(used) < 4:
        return float(np.mean(values)), float(np.std(values))
    weight = count[used].astype(float)
    means = total[used] / weight
    mean = float(np.average(means, weights=weight))
    scatter = float(np.average((means - mean) ** 2, weights=weight))
    return mean, float(np.sqrt(scatter / (np.count_nonzero(used) - 1)))


def by_cells(
    values: NDArray[np.floating], index: NDArray[np.intp], edge: int
) -> tuple[NDArray[np.int64], Array]:
    """Return number and sum of the values (n,) at indices (n, 3) in each cube of so many voxels, (cells,)."""
    cells = index // edge
    size = cells.max(axis=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    return np.bincount(key).astype(np.int64), np.bincount(key, values).astype(float)


def noise_correlation(rest: Grey, inside: Mask) -> float:
    """Return the variance of sums of noise over that of white noise.

    Notes
    -----
    Correlations at one, two, ... voxels along each axis are added up as long as they stand out of their own
    scatter, and the axes multiplied: exact for noise that was smoothed axis by axis, as reconstruction does.
    """
    total = 1.0
    variance = float(np.mean(np.square(rest[inside], dtype=float))) if inside.any() else 0.0
    if variance <= 0.0:
        return total
    for axis in range(3):
        along, before = 1.0, 0
        values, good = np.moveaxis(rest, axis, 0), np.moveaxis(inside, axis, 0)
        for lag in (*_NEAR_LAGS, *_FAR_LAGS):
            if lag >= len(values):
                break
            both = good[lag:] & good[:-lag]
            count = int(np.count_nonzero(both))
            if count < _LEAST_AIR:
                break
            r = float(np.mean(values[lag:][both] * values[:-lag][both], dtype=float)) / variance
            if abs(r) < 3.5 / np.sqrt(count):
                break
            along += 2.0 * r * (lag - before)
            before = lag
        total *= max(along, _LEAST_CORRELATION)
    return total


def first_sigma(labelled: Labelled) -> float:
    """Return a first width of the blur, mm, from the steepest edges of the stapes.

    Notes
    -----
    A plane edge of contrast c has the slope c / (sqrt(2 pi) sigma). Differences over two voxels add the
    variance h^2 / 3 to the blur.
    """
    from scipy.ndimage import gaussian_filter

    spacing = labelled.box.spacing_mm[::-1]
    part = _part_around(labelled.stapes, 4.0 * float(spacing.max()), spacing)
    contrast = labelled.bone - labelled.air
    share = (labelled.box.grey[part] - np.float32(labelled.air)) / np.float32(contrast)
    smooth = 0.8 if labelled.noise > 0.05 * contrast else 0.0
    share = gaussian_filter(share, smooth, truncate=3.0) if smooth else share
    stapes = labelled.stapes[part]
    rim = (np.abs(share - np.float32(0.5)) < 0.15) & grown(stapes) & ~eroded(stapes)
    inner = np.zeros_like(rim)
    inner[1:-1, 1:-1, 1:-1] = rim[1:-1, 1:-1, 1:-1]
    place = np.flatnonzero(inner)
    place = place[:: max(1, place.size // 20_000)]
    flat, slope = share.ravel(), np.zeros(place.size)
    for stride, edge in zip((share.shape[1] * share.shape[2], share.shape[2], 1), spacing, strict=True):
        slope += ((flat[place + stride] - flat[place - stride]) / (2.0 * edge)) ** 2
    mean = float(spacing.mean())
    if place.size < 60:
        return 1.2 * mean
    steep = float(np.percentile(np.sqrt(slope), 70.0))
    square = 1.0 / (2.0 * np.pi * max(steep, 1e-9) ** 2) - mean**2 * (1.0 / 3.0 + smooth**2)
    return float(np.clip(np.sqrt(max(square, 0.0)), 0.6 * mean, 4.0 * mean))


def _part_around(mask: Mask, margin_mm: float, spacing: Array) -> tuple[slice, ...]:
    used = used_box(mask) or (slice(0, 1),) * 3
    wide = np.ceil(margin_mm / spacing).astype(int) + 3
    return tuple(slice(max(0, int(k.start - m)), int(k.stop + m)) for k, m in zip(used, wide, strict=True))


def _basins(
    grey: Grey, masks: dict[str, Mask], distances: dict[str, Grey], reach: float, sigma: float
) -> NDArray[np.int8]:
    """Give each voxel to the nearest body; in gaps of a few blur widths by the watershed."""
    basin = np.zeros(grey.shape, dtype=np.int8)
    nearest = np.full(grey.shape, np.float32(reach))
    second = np.full(grey.shape, np.float32(np.inf))
    for number, away in enumerate((distances[name] for name in masks), 1):
        closer = away < nearest
        np.minimum(second, np.where(closer, nearest, away), out=second)
        basin[closer] = number
        np.copyto(nearest, away, where=closer)
    tight = nearest + second < np.float32(CLOSE_SIGMAS * sigma)
    if len(masks) == 1 or not tight.any():
        return basin
    markers = np.zeros(grey.shape, dtype=np.int32)
    for number, mask in enumerate(masks.values(), 1):
        markers[mask] = number
    flooded = flood(grey, markers, tight | (markers > 0))
    return np.where(tight & (flooded > 0), flooded, basin).astype(np.int8)


def flood(grey: Grey, markers: NDArray[np.int32], mask: Mask) -> NDArray[np.int32]:
    """Give every voxel of a mask to the marker whose flood reaches it first from the bright side.

    Notes
    -----
    Watershed of the negative grey values (Meyer's flooding): the border runs along the darkest line between
    two bodies, where each loses to the other as much of its blur as it gains.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.segmentation import watershed

    result = np.where(mask, markers, 0).astype(np.int32)
    free = mask & (result == 0)
    used = used_box(free)
    if used is None:
        return result
    box = tuple(slice(max(0, part.start - 3), part.stop + 3) for part in used)
    active = mask[box] & grown(free[box])
    relief = -gaussian_filter(grey[box], 0.7, truncate=3.0)
    flooded = watershed(relief, np.where(active, result[box], 0), mask=active)
    part = result[box]
    part[free[box]] = flooded[free[box]]
    return result


def grown(mask: Mask) -> Mask:
    """Return a mask with the voxels that touch it in a face, an edge or a corner."""
    result = mask
    for axis in range(3):
        moved = np.moveaxis(result, axis, 0)
        wider = moved.copy()
        wider[1:] |= moved[:-1]
        wider[:-1] |= moved[1:]
        result = np.moveaxis(wider, 0, axis)
    return np.ascontiguousarray(result)


def eroded(mask: Mask, rounds: int = 1) -> Mask:
    """Return a mask less what is within so many voxels of its outside; the border counts as outside."""
    inner = np.pad(mask, rounds)
    for _ in range(rounds):
        inner = ~grown(~inner)
    return np.ascontiguousarray(inner[(slice(rounds, -rounds),) * 3])


def _contrasts(labelled: Labelled, grey: Grey, masks: dict[str, Mask], air: float) -> dict[str, float]:
    """Return the first contrast of each body; other bone of nearly the stapes' contrast is the same bone."""
    own = labelled.bone - air
    contrasts = {}
    for name, mask in masks.items():
        contrast = own
        if name == "plate" and labelled.plastic is not None:
            contrast = labelled.plastic - air
        elif name == "other":
            deep = grey[eroded(mask, 2)]
            contrast = float(np.median(deep)) - air if deep.size > _LEAST_DEEP else own
            contrast = own if abs(contrast / own - 1.0) < _SAME_BONE else contrast
        contrasts[name] = contrast
    return contrasts

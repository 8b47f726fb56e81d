"""Initial values of a scene: the body of each voxel, air, noise, blur and contrasts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grid, Labelled
from ct_inertia.frames.plate import PlaneFace
from ct_inertia.grey.cells import by_cells, cell_numbers, mean_by_cells, noise_correlation, robust_mean
from ct_inertia.grey.plate_plane import FacePlane
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.fields import Grey, smooth
from ct_inertia.voxels.flood import flood
from ct_inertia.voxels.masks import Mask, Slices, eroded, grown, used_box, widened
from stapeskit.arrays import Array

REACH_SIGMAS = 4.2
"""The blur of a plane edge beyond so many widths holds 3e-6 of a width."""

CLOSE_SIGMAS = 5.0
"""Planes so many widths apart share less than 0.005 of a width in the middle of their gap."""

NEAR_REACHES = 1.7
"""So many reaches of the blur around the stapes are modelled: its rim and as much air."""

# Streaks and shades are as wide, a box holds dozens of such cells, and the noise of their means is 1/64.
AIR_VOXELS = 16
"""Edge of the cells of air whose mean levels are compared, voxels."""

_LEAST_AIR = 400  # voxels of air from which a mean is taken: its noise is 5 % of a voxel's
_CELL_VOXELS, _LEAST_CELL = 8, 30  # edge of the cells that are compared, and voxels of one that counts
_NO_NOISE = 5.0  # standard deviations that 3 of ten million means exceed by chance
_LEAST_DEEP = 12  # voxels of pure bone whose median is a level
_OVER_PLATE_SIGMAS = 2.5  # widths of the blur up to which plastic is only subtracted, whoever is nearer
_SAME_BONE = 0.05  # other bone whose contrast is nearer to the stapes' than this counts as the same bone


@dataclass(frozen=True, eq=False)
class Start:
    """First values of a scene, on a part of the box around the stapes.

    Attributes
    ----------
    part : tuple of 3 slice
        The part of the box, z, y, x; all arrays below are [z, y, x] on it.
    grey : ndarray of float32
    masks : mapping of str to ndarray of bool
        Bodies that are near, the stapes first, in the order in which they win what they share: other bone,
        plate.
    distances : mapping of str to ndarray of float32
        From each body, mm, up to 1.7 times the reach.
    reach_mm : float
        How far blur reaches.
    basin : ndarray of int8
        Whose voxel it is: 1 for the first body, 2 for the second, ...; 0 beyond the reach of all.
    near, far : ndarray of bool
        Where the model is compared with the grey values; air beyond all blur.
    air_uneven : float
        Standard deviation of the level of air from one cell of `AIR_VOXELS` to another, beyond noise.
    face : FacePlane or None
        The face of a plate near the stapes; None without a plate that has one.
    """

    part: Slices
    grid: Grid
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
    air_uneven: float
    correlation: float
    contrasts: dict[str, float]
    sigma_mm: float
    face: FacePlane | None = None

    @property
    def spacing(self) -> Array:
        """Edges of a voxel along z, y, x, mm."""
        return self.grid.spacing_mm[::-1]

    @property
    def within_reach(self) -> Mask:
        """Voxels that the stapes' blur reaches."""
        return np.asarray(self.distances["stapes"] <= np.float32(self.reach_mm))


def start(labelled: Labelled, plate_faces: Sequence[PlaneFace] = ()) -> Start:
    """Measure air, noise and blur around the labelled stapes, and give each voxel to a body.

    Parameters
    ----------
    plate_faces : sequence of PlaneFace
        Those of the plate that look towards the stapes.
    """
    box = labelled.box
    sigma = first_sigma(labelled)
    edge = float(box.spacing_mm.max())
    reach = REACH_SIGMAS * sigma + edge
    cap = NEAR_REACHES * reach
    part = _around(labelled.stapes, cap, box.spacing_mm[::-1])
    grey = box.grey[part]
    named = {"stapes": labelled.stapes, "other": labelled.other, "plate": labelled.plate}
    masks = {name: np.ascontiguousarray(mask[part]) for name, mask in named.items() if mask[part].any()}
    distances = {name: capped_distance(mask, box.spacing_mm, cap) for name, mask in masks.items()}
    measured = np.ones(grey.shape, dtype=bool) if box.measured is None else box.measured[part]
    near = (distances["stapes"] < np.float32(cap)) & measured
    far = np.logical_and.reduce([measured, *(away > reach for away in distances.values())])
    far = _air_alone(grey, far, labelled.air, labelled.noise)
    air, noise, air_sd = labelled.air, labelled.noise, labelled.noise
    if np.count_nonzero(far) >= _LEAST_AIR:
        air, noise = robust_mean(grey[far])
        air_sd = mean_by_cells(grey[far], far, AIR_VOXELS)[1]
    grey = grey if measured.all() else np.where(measured, grey, np.float32(air))
    beside = {name: mask for name, mask in masks.items() if np.any(near & (distances[name] < reach))}
    face = None
    if "plate" in beside:
        under = near & (distances["plate"] < np.float32(reach))
        face = FacePlane.of(plate_faces, masks["stapes"], masks["plate"], under, box.part(part))
    basin = _basins(grey, beside, distances, reach, sigma)
    if face is not None and not face.wets:
        near_plate = basin == 1 + list(beside).index("plate")
        basin[near_plate & (distances["stapes"] < np.float32(_OVER_PLATE_SIGMAS * sigma + edge))] = 1
    calm = far & (np.abs(grey - np.float32(air)) < 5.0 * noise)
    correlation = noise_correlation(np.where(far, grey - np.float32(air), np.float32(0.0)), calm)
    return Start(
        part=part,
        grid=box.part(part),
        grey=grey,
        masks=beside,
        distances={name: distances[name] for name in beside},
        reach_mm=reach,
        basin=basin,
        near=near,
        far=far,
        air=air,
        noise=max(noise, 1e-6 * (labelled.bone - labelled.air)),
        air_sd=air_sd,
        air_uneven=_unevenness(grey, calm, air, noise**2 * correlation),
        correlation=correlation,
        contrasts=_contrasts(labelled, grey, beside, air),
        sigma_mm=sigma,
        face=face,
    )


def _around(mask: Mask, margin_mm: float, spacing: Array) -> Slices:
    return widened(used_box(mask), np.ceil(margin_mm / spacing) + 3)


def _air_alone(grey: Grey, far: Mask, air: float, noise: float) -> Mask:
    """Leave out cells that are brighter than air is anywhere by its own scatter: fluid, dust, plastic.

    The scatter is that of the darker half of the cells near the first guess of air.
    """
    if np.count_nonzero(far) < _LEAST_AIR:
        return far
    key = cell_numbers(far, _CELL_VOXELS)
    count, total = np.bincount(key), np.bincount(key, grey[far])
    mean, full = total / np.maximum(count, 1), count >= _LEAST_CELL
    usual = full & (np.abs(mean - air) < 3.0 * noise)
    if np.count_nonzero(usual) < 8:
        return far
    scaled = (mean - float(np.median(mean[usual]))) * np.sqrt(count)
    scatter = 1.4826 * float(np.median(-scaled[usual & (scaled <= 0.0)]))
    bright = full & (scaled > _NO_NOISE * scatter)
    if np.count_nonzero(bright) < 3:
        return far
    kept = np.zeros_like(far)
    kept[far] = ~bright[key]
    return kept


def _unevenness(grey: Grey, calm: Mask, air: float, variance: float) -> float:
    """Return by how much cells of air differ beyond noise; ``variance``: of a sum over voxels, per voxel.

    0 where noise alone gives the sum of squares, or 5 of its standard deviations more.
    """
    size, total = by_cells(grey[calm] - np.float32(air), calm, AIR_VOXELS)
    size, total = size[size > _LEAST_AIR], total[size > _LEAST_AIR]
    square, count = float(np.sum(total**2 / np.maximum(size, 1.0))), len(size)
    if count < 2 or square < (count + 5.0 * np.sqrt(2.0 * count)) * variance:
        return 0.0
    return float(np.sqrt((square - count * variance) / size.sum()))


def first_sigma(labelled: Labelled) -> float:
    """Return a first width of the blur, mm, from the steepest edges of the stapes.

    Notes
    -----
    A plane edge of contrast c has the slope c / (sqrt(2 pi) sigma). Differences over two voxels add the
    variance h^2 / 3 to the blur.
    """
    spacing = labelled.box.spacing_mm[::-1]
    part = _around(labelled.stapes, 4.0 * float(spacing.max()), spacing)
    contrast = labelled.bone - labelled.air
    share = (labelled.box.grey[part] - np.float32(labelled.air)) / np.float32(contrast)
    calm = 0.8 if labelled.noise > 0.05 * contrast else 0.0
    share = smooth(share, np.full(3, calm)) if calm else share
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
    square = 1.0 / (2.0 * np.pi * max(steep, 1e-9) ** 2) - mean**2 * (1.0 / 3.0 + calm**2)
    return float(np.clip(np.sqrt(max(square, 0.0)), 0.6 * mean, 4.0 * mean))


def _basins(
    grey: Grey, masks: dict[str, Mask], distances: dict[str, Grey], reach: float, sigma: float
) -> NDArray[np.int8]:
    """Give each voxel to the nearest body; in gaps of a few blur widths by the watershed."""
    basin, markers = np.zeros(grey.shape, dtype=np.int8), np.zeros(grey.shape, dtype=np.int32)
    nearest, second = np.full(grey.shape, np.float32(reach)), np.full(grey.shape, np.float32(np.inf))
    for number, (name, mask) in enumerate(masks.items(), 1):
        away = distances[name]
        closer = away < nearest
        np.minimum(second, np.where(closer, nearest, away), out=second)
        basin[closer] = number
        np.copyto(nearest, away, where=closer)
        markers[mask] = number
    tight = nearest + second < np.float32(CLOSE_SIGMAS * sigma)
    if len(masks) == 1 or not tight.any():
        return basin
    flooded = flood(-grey, markers, tight | (markers > 0), smoothing=0.7)
    return np.where(tight & (flooded > 0), flooded, basin).astype(np.int8)


def _contrasts(labelled: Labelled, grey: Grey, masks: dict[str, Mask], air: float) -> dict[str, float]:
    """Return the first contrast of each body; other bone of nearly the stapes' contrast is the same bone."""
    own = labelled.bone - air
    contrasts = dict.fromkeys(masks, own)
    if "plate" in masks and labelled.plastic is not None:
        contrasts["plate"] = labelled.plastic - air
    if "other" in masks:
        deep = grey[eroded(masks["other"], 2)]
        contrast = float(np.median(deep)) - air if deep.size > _LEAST_DEEP else own
        contrasts["other"] = own if abs(contrast / own - 1.0) < _SAME_BONE else contrast
    return contrasts

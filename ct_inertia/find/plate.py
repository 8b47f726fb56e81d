"""The region of the plastic plate in the first look, and its closed surface as a field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Box, PlateRegion
from ct_inertia.calibrated import calibrated
from ct_inertia.find.levels import Reading
from ct_inertia.find.overview import Overview, smooth_noise
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.fields import Grey, smooth
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import Mask, eroded, grown, used_box, widened
from stapeskit.arrays import Array

_LEAST_MM3 = 0.5  # of a plate; one of millimetres has several
_DENSE = 0.85  # of the contrast of plastic, in its inner half: a fluid has less
_RIM_MM = calibrated("plate_region.rim_mm")
_BALL_MM = 0.06  # radius of a ball that a plate holds and a blurred rim does not
_GRID_MM = 0.0625  # voxels of the plate's grid: half of that rim, for a plate of millimetres needs no finer
_LEAST_DEEP, _ENOUGH = 300, 100_000  # voxels of plastic or air for a mean; for the ends of their values
_SMOOTH_VOXELS = 0.7  # about the least that leaves no stairs of voxels in the surface
_COLLAR_MM, _MOST_COVERED = 0.15, 0.7  # a plate covers the footplate and some of what stands beside it


def find_plate(scan: Scan, overview: Overview, reading: Reading, stapes: Mask) -> PlateRegion | None:
    """Find the body of plastic next to the stapes that is no blurred rim of bone; None where there is none.

    ``stapes`` is its mask, [z, y, x] in coarse voxels.

    Notes
    -----
    Voxels within 0.11 mm of bone are left out first: across such a rim the grey values pass through those of
    plastic. What remains is labelled, and grown back by the same distance.
    """
    import cc3d

    if reading.plastic is None:
        return None
    thin = max(1, int(_GRID_MM / float(overview.grid.spacing_mm.mean())))
    some = (slice(thin // 2, None, thin),) * 3
    grey, stapes = overview.grey[some], stapes[some]
    first = overview.grid.block // 2 + (thin // 2) * overview.grid.block
    grid = Grid.of(scan, grey.shape, np.zeros(3, dtype=np.int64), overview.grid.block * thin, first)
    middle = np.float32(0.5 * (reading.air + reading.plastic))
    wide = _RIM_MM + float(grid.spacing_mm.max())
    paired = grey > middle
    paired[1:] &= paired[:-1]  # a bright voxel alone is noise
    bright = widened(used_box(paired), np.ceil(4.0 * wide / grid.spacing_mm[::-1]))
    grey, stapes, grid = np.ascontiguousarray(grey[bright]), stapes[bright], grid.part(bright)
    solid = smooth_noise(grey, overview.noise / reading.contrast) > np.float32(reading.between)
    from_bone = capped_distance(solid, grid.spacing_mm, 2.0 * _RIM_MM)
    soft = smooth(grey, np.full(3, _SMOOTH_VOXELS))
    free = (soft > middle) & (from_bone > np.float32(_RIM_MM))
    if overview.unmeasured is not None:
        free &= ~overview.unmeasured[some][bright]
    labels = cc3d.connected_components(grown(eroded(free)) & free, connectivity=6)
    dense = reading.air + _DENSE * (reading.plastic - reading.air)
    numbers = 1 + np.flatnonzero(np.bincount(labels.ravel())[1:] * grid.voxel_mm3 >= _LEAST_MM3)
    found = [int(k) for k in numbers if np.percentile(soft[labels == k], 75.0) > dense]
    if not found:
        return None
    core = np.asarray(labels == _nearest(labels, found, stapes, grid.spacing_mm))
    away = capped_distance(core, grid.spacing_mm, 3.0 * wide)
    deep = from_bone > np.float32(1.5 * _RIM_MM)
    beside = deep & (away > np.float32(1.5 * wide)) & (away < np.float32(3.0 * wide))
    plastic = _mean_inside(grey[core & deep], reading.plastic)
    air = _mean_inside(grey[beside & (soft < middle)], reading.air)  # or the medium that the plate lies in
    middle = np.float32(0.5 * (air + plastic))
    mask = (away <= np.float32(wide)) & (soft > middle) & ~solid
    box = widened(used_box(mask), 3)
    share = (soft[box] - np.float32(air)) / np.float32(plastic - air)
    inside = grown(grown(mask[box])) & ~grown(solid[box])
    field = np.where(inside, np.clip(share, -1.0, 1.0), np.minimum(share, 0.0)) - np.float32(0.5)
    immersing = _surrounds(mask, solid, stapes, grid.spacing_mm)
    part = grid.part(box)
    return PlateRegion(mask[box], field.astype(np.float32), part, air, plastic, immersing, len(found) > 1)


def _nearest(labels: NDArray[Any], numbers: Sequence[int], stapes: Mask, spacing_mm: Array) -> int:
    """Return the number of the body nearest to the stapes: others may be a tube, a wall or a holder."""
    from scipy.spatial import cKDTree

    if len(numbers) == 1 or not stapes.any():
        return numbers[0]
    own = cKDTree(np.argwhere(stapes) * spacing_mm[::-1])
    away = [own.query(np.argwhere(labels == number) * spacing_mm[::-1])[0].min() for number in numbers]
    return numbers[int(np.argmin(away))]


def plate_mask(region: PlateRegion, box: Box, quiet: Grey, bone: Mask) -> Mask:
    """Return the plate's voxels on the grid of a box: those that an opening by a ball keeps."""
    there = box.taken(grown(region.mask), region.grid, repeat=True)
    there &= (quiet > np.float32(0.5 * (region.air + region.plastic))) & ~bone
    edge = float(box.spacing_mm.max())
    radius = max(_BALL_MM, 1.5 * edge)
    core = there & (capped_distance(~there, box.spacing_mm, 1.2 * radius) > np.float32(radius))
    near = capped_distance(core, box.spacing_mm, radius + 2.0 * edge) <= np.float32(radius + edge)
    return np.asarray(there & near)


def drawn_plate(plate: Mask, grid: Grid) -> PlateRegion | None:
    """Return the region of a plate that labels [z, y, x] on a grid name; None where there is none."""
    used = used_box(plate)
    if used is None:
        return None
    box = widened(used, 3)
    mask = plate[box]
    field = smooth(mask.astype(np.float32), np.full(3, 0.8)) - np.float32(0.5)
    return PlateRegion(mask, field, grid.part(box), 0.0, 1.0, named=True)


def _surrounds(plastic: Mask, bone: Mask, stapes: Mask, spacing_mm: Array) -> bool:
    """Return whether plastic lies on nearly all sides of the stapes that are free of other bone."""
    box = widened(used_box(stapes), np.ceil((_RIM_MM + _COLLAR_MM) / spacing_mm[::-1]) + 1)
    own = stapes[box]
    away = capped_distance(own, spacing_mm, 1.2 * (_RIM_MM + _COLLAR_MM))
    other = capped_distance(bone[box] & ~own, spacing_mm, 2.0 * _RIM_MM) <= np.float32(_RIM_MM)
    collar = (away > np.float32(_RIM_MM)) & (away <= np.float32(_RIM_MM + _COLLAR_MM)) & ~other
    seen = int(np.count_nonzero(collar))
    return bool(seen and np.count_nonzero(plastic[box] & collar) > _MOST_COVERED * seen)


def _mean_inside(values: Grey, guess: float) -> float:
    """Return the mean of deep voxels (n,) without their extremes; the guess where they are few."""
    if values.size < _LEAST_DEEP:
        return guess
    low, high = np.percentile(values[:: max(1, values.size // _ENOUGH)], (1.0, 99.0))
    return float(values[(values >= low) & (values <= high)].mean(dtype=float))

"""The region of the plastic plate in the first look, and its closed surface as a field."""

from __future__ import annotations

import numpy as np

from ct_inertia.bodies import Box, Grey, Mask, PlateRegion
from ct_inertia.calibrated import calibrated
from ct_inertia.find.box import from_coarse
from ct_inertia.find.distance import capped_distance, used_box
from ct_inertia.find.overview import Overview, smooth_noise
from ct_inertia.find.pieces import Piece
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array

_LEAST_MM3 = calibrated("plate_region.least_mm3")
_RIM_MM = calibrated("plate_region.rim_mm")
_BALL_MM = 0.06  # radius of a ball that a plate holds and a blurred rim does not
_GRID_MM = (
    0.0625  # voxels of the plate's grid: half of that rim, for a plate of millimetres needs no finer one
)
_LEAST_DEEP = 300  # voxels of pure plastic or air from which a mean is taken
_SMOOTH_VOXELS = 0.7  # about the least that leaves no stairs of voxels in the surface
_COLLAR_MM, _MOST_COVERED = 0.15, 0.7  # a plate covers the footplate and some of what stands beside it


def find_plate(
    scan: Scan,
    overview: Overview,
    levels: tuple[float, float | None, float],
    between: float,
    stapes: tuple[Mask, Piece],
) -> PlateRegion | None:
    """Find the largest body of plastic grey that is no blurred rim of bone; None where there is none.

    Parameters
    ----------
    scan : Scan
    overview : Overview
    levels : (air, plastic, bone)
    between : float
        Grey value above which a voxel is bone.
    stapes : (ndarray of bool, Piece)
        The stapes in coarse voxels [z, y, x].

    Notes
    -----
    Voxels within 0.11 mm of bone are left out first: across such a rim the grey values pass through those of
    plastic. What remains is labelled, and grown back by the same distance.
    """
    import cc3d

    from ct_inertia.grey.fields import smooth
    from ct_inertia.grey.start import eroded, grown

    air, plastic, bone = levels
    if plastic is None:
        return None
    thin = max(1, int(_GRID_MM / float(overview.spacing_mm.mean())))
    some = (slice(thin // 2, None, thin),) * 3
    spacing, step = overview.spacing_mm * thin, overview.step * thin
    first = overview.step // 2 + (thin // 2) * overview.step
    grey = np.ascontiguousarray(overview.grey[some])
    solid = smooth_noise(grey, overview.noise / (bone - air)) > np.float32(between)
    from_bone = capped_distance(solid, spacing, 2.0 * _RIM_MM)
    soft = smooth(grey, np.full(3, _SMOOTH_VOXELS))
    middle = np.float32(0.5 * (air + plastic))
    free = (soft > middle) & (from_bone > np.float32(_RIM_MM))
    if overview.unmeasured is not None:
        free &= ~overview.unmeasured[some]
    labels = cc3d.connected_components(grown(eroded(free)) & free, connectivity=6)
    sizes = np.bincount(labels.ravel())
    if sizes.size < 2 or sizes[1:].max() * float(np.prod(spacing)) < _LEAST_MM3:
        return None
    core = labels == int(np.argmax(sizes[1:])) + 1
    wide = _RIM_MM + float(spacing.max())
    mask = (capped_distance(core, spacing, 1.5 * wide) <= np.float32(wide)) & (soft > middle) & ~solid
    plastic = _mean_inside(grey, core & (from_bone > np.float32(1.5 * _RIM_MM)), plastic)
    air = _mean_inside(grey, (soft < middle) & (from_bone > np.float32(1.5 * _RIM_MM)), air)
    return _region(
        scan,
        grey,
        (mask, solid),
        (air, plastic),
        (first, step),
        _surrounds(mask, solid, stapes, some, spacing),
    )


def plate_mask(region: PlateRegion, box: Box, quiet: Grey, bone: Mask) -> Mask:
    """Return the plate's voxels on the grid of a box: what a ball fits in, as no blurred rim of bone."""
    from ct_inertia.grey.start import grown

    there = from_coarse(box, grown(region.mask), region.first, region.step)
    there &= (quiet > np.float32(0.5 * (region.air + region.plastic))) & ~bone
    edge = float(box.spacing_mm.max())
    radius = max(_BALL_MM, 1.5 * edge)
    core = there & (capped_distance(~there, box.spacing_mm, 1.2 * radius) > np.float32(radius))
    return np.asarray(
        there & (capped_distance(core, box.spacing_mm, radius + 2.0 * edge) <= np.float32(radius + edge))
    )


def mask_region(scan: Scan, plate: Mask, first: np.ndarray) -> PlateRegion | None:
    """Return the region of a plate that labels name; ``first``: index in the scan of their first voxel."""
    from ct_inertia.grey.fields import smooth

    used = used_box(plate)
    if used is None:
        return None
    wide = tuple(slice(max(0, part.start - 3), part.stop + 3) for part in used)
    mask = plate[wide]
    first = first + np.array([part.start for part in wide[::-1]])
    field = smooth(mask.astype(np.float32), np.full(3, 0.8)) - np.float32(0.5)
    transform = scan.scan_from_index.copy()
    transform[:3, 3] = scan.scan_points(first)
    end = first + np.array(mask.shape[::-1])
    one = np.ones(3, dtype=np.int64)
    return PlateRegion(mask, field, transform, first == 0, end >= scan.size, 0.0, 1.0, first, one)


def _region(
    scan: Scan,
    grey: Grey,
    masks: tuple[Mask, Mask],
    levels: tuple[float, float],
    grid: tuple[np.ndarray, np.ndarray],
    immersing: bool,
) -> PlateRegion | None:
    """Return the plate on the box that holds it, with the field of its surface."""
    from ct_inertia.grey.fields import smooth
    from ct_inertia.grey.start import grown

    (mask, solid), (air, plastic), (first, step) = masks, levels, grid
    used = used_box(mask)
    if used is None:
        return None
    part = tuple(slice(max(0, k.start - 3), k.stop + 3) for k in used)
    share = (
        smooth(np.ascontiguousarray(grey[part]), np.full(3, _SMOOTH_VOXELS)) - np.float32(air)
    ) / np.float32(plastic - air)
    inside = grown(grown(mask[part])) & ~grown(solid[part])
    field = np.where(inside, np.clip(share, -1.0, 1.0), np.minimum(share, 0.0)) - np.float32(0.5)
    start = np.array([k.start for k in part[::-1]])
    end = np.minimum(np.array([k.stop for k in part[::-1]]), np.array(grey.shape[::-1]))
    transform = scan.scan_from_index.copy()
    transform[:3, :3] = transform[:3, :3] * step
    transform[:3, 3] = scan.scan_points(first + start * step)
    begins, ends = np.asarray(start == 0), np.asarray(end == np.array(grey.shape[::-1]))
    cell = first + start * step
    return PlateRegion(
        mask[part], field.astype(np.float32), transform, begins, ends, air, plastic, cell, step, immersing
    )


def _surrounds(
    plastic: Mask, bone: Mask, stapes: tuple[Mask, Piece], some: tuple[slice, ...], spacing: Array
) -> bool:
    """Return whether plastic lies around the stapes on nearly all sides where no other bone does."""
    own = stapes[0][some]
    used = used_box(own)
    if used is None:
        return False
    margin = np.ceil((_RIM_MM + _COLLAR_MM) / spacing[::-1]).astype(int) + 1
    box = tuple(slice(max(0, k.start - m), k.stop + m) for k, m in zip(used, margin, strict=True))
    away = capped_distance(own[box], spacing, 1.2 * (_RIM_MM + _COLLAR_MM))
    other = capped_distance(bone[box] & ~own[box], spacing, 2.0 * _RIM_MM) <= np.float32(_RIM_MM)
    collar = (away > np.float32(_RIM_MM)) & (away <= np.float32(_RIM_MM + _COLLAR_MM)) & ~other
    seen = int(np.count_nonzero(collar))
    return bool(seen and np.count_nonzero(plastic[box] & collar) > _MOST_COVERED * seen)


def _mean_inside(grey: Grey, deep: Mask, guess: float) -> float:
    """Return the mean grey value of deep voxels without their extremes; the guess where they are few."""
    values = grey[deep]
    if values.size < _LEAST_DEEP:
        return guess
    low, high = np.percentile(values, (1.0, 99.0))
    return float(values[(values >= low) & (values <= high)].mean(dtype=float))

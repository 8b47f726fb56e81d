"""The region of the plastic plate in the coarse view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation
from legacy.ct_inertia.volume.coarse_view import smooth_noise
from legacy.ct_inertia.volume.grid_operations import dilated, eroded, gaussian, labelled

_LEAST_MM3 = calibrated("plate_region.least_mm3")
_RIM_MM = calibrated("plate_region.rim_mm")
# Voxels of the plate's view, mm: about half of that rim, for a plate of millimetres needs no finer one.
_GRID_MM = 0.0625
# Voxels of pure plastic or air from which their mean is taken: its noise is 6 % of a voxel's.
_LEAST_DEEP = 300
# Voxels a layer up to which they are noise. Chosen by judgement: only the box of the search follows.
_STRAY = 30
# A plate covers the footplate and some of what stands beside it; the collar is this many coarse voxels wide.
_COLLAR, _MOST_COVERED = 2, 0.7


@dataclass(frozen=True)
class PlateRegion:
    """Where the plate is.

    Attributes
    ----------
    mask : ndarray of bool, [z, y, x]
        Coarse voxels of plastic, grown back to the bone it touches.
    middle : float
        Grey value half way between air and plastic.
    air, plastic : float
    step : ndarray of int, (3,)
        Voxels of the scan per coarse voxel, x, y, z.
    immersing : bool
        It lies around the stapes on nearly all sides, as fluid does and no plate.
    """

    mask: NDArray[np.bool_]
    middle: float
    air: float
    plastic: float
    step: NDArray[np.int64]
    immersing: bool = False


def find_plate(sight: CoarseSegmentation) -> PlateRegion | None:
    """Find the largest body of plastic grey that is no blurred rim of bone.

    Voxels within 0.11 mm of bone are left out first: across such a rim the grey values pass through those
    of plastic. What remains is smoothed, labelled, and grown back by the same distance.
    """
    if sight.plastic is None:
        return None
    scan = sight.scan
    middle = 0.5 * (sight.air + sight.plastic)
    thin = max(1, int(_GRID_MM / float(scan.spacing_mm.mean())))
    rim = max(1, int(np.ceil(_RIM_MM / (thin * float(scan.spacing_mm.mean())))))
    coarse = thinned(scan.grey, thin)
    box = _box_of(coarse > middle, 3 * rim + 4)
    grey = coarse[box]
    bone = smooth_noise(grey, scan.noise / (sight.bone - sight.air)) > sight.between
    near_bone = dilated(bone, rim)
    smooth = gaussian(grey, 0.7)
    free = (smooth > middle) & ~near_bone
    labels, count = labelled(dilated(eroded(free)))
    if count == 0:
        return None
    sizes = np.bincount(labels.ravel())[1:]
    if sizes.max() * scan.voxel_mm3 * thin**3 < _LEAST_MM3:
        return None
    core = labels == int(np.argmax(sizes)) + 1
    grown = dilated(core, rim + 1, (smooth > middle) & ~bone)
    plastic = _mean_inside(grey, core, rim, sight.plastic)
    air = _mean_inside(grey, (smooth < middle) & ~near_bone, rim, sight.air)
    mask = np.zeros(coarse.shape, dtype=bool)
    mask[box] = grown
    around = _surrounds_stapes(mask, sight, thin, rim)
    return PlateRegion(mask, 0.5 * (air + plastic), air, plastic, scan.step * thin, around)


def _surrounds_stapes(plastic: NDArray[np.bool_], sight: CoarseSegmentation, thin: int, rim: int) -> bool:
    """Return whether plastic lies around the stapes on nearly all sides where no other bone does."""
    reach, piece = rim + _COLLAR, sight.stapes
    box = tuple(
        slice(max(0, int(low) // thin - reach), int(high) // thin + reach + 1)
        for low, high in zip(piece.low[::-1], piece.high[::-1], strict=True)
    )
    own = thinned(sight.pieces, thin)[box] == piece.label
    bone = thinned(sight.scan.grey, thin)[box] > sight.between
    collar = dilated(own, reach) & ~dilated(own, rim) & ~dilated(bone, rim)
    seen = int(np.count_nonzero(collar))
    return bool(seen and np.count_nonzero(plastic[box] & collar) > _MOST_COVERED * seen)


def thinned(grey: NDArray[Any], thin: int) -> NDArray[Any]:
    """Return every ``thin``-th voxel along each axis."""
    start = slice(thin // 2, None, thin)
    return grey[start, start, start]


def _box_of(mask: NDArray[np.bool_], margin: int) -> tuple[slice, ...]:
    """Return a box (z, y, x) around the layers that hold more of a mask than stray voxels of noise."""
    flat = np.count_nonzero(mask, axis=0)
    counts = (np.count_nonzero(mask, axis=(1, 2)), flat.sum(axis=1), flat.sum(axis=0))
    box = []
    for count in counts:
        used = np.flatnonzero(count > _STRAY)
        if used.size == 0:
            return tuple(slice(0, n) for n in mask.shape)
        box.append(slice(max(0, int(used[0]) - margin), int(used[-1]) + margin + 1))
    return tuple(box)


def _mean_inside(grey: NDArray[np.floating], region: NDArray[np.bool_], rim: int, guess: float) -> float:
    """Return the mean grey value well inside a region; the guess where little of it lies that deep.

    The levels of the coarse view are peaks of a histogram, 1 % off here and there: that would move the
    face of the plate by a micrometre.
    """
    deep = grey[eroded(region, rim)]
    if len(deep) < _LEAST_DEEP:
        return guess
    low, high = np.percentile(deep, (1.0, 99.0))
    return float(deep[(deep >= low) & (deep <= high)].mean())

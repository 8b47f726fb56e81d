"""The plastic plate: its region in the coarse view and its closed surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.coarse import calmed, finite
from ct_inertia.errors import CtInertiaError
from ct_inertia.isosurface import iso_surface
from ct_inertia.search import Sight
from ct_inertia.surface import Surface
from ct_inertia.volume import Volume

Array = NDArray[np.float64]
_LEAST_MM3 = 0.5
_RIM_MM = 0.11
_SURFACE_MM = 0.025
_MOST_VOXELS = 30_000_000
_LEAST_DEEP = 300
_STRAY = 30


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
    """

    mask: NDArray[np.bool_]
    middle: float
    air: float
    plastic: float
    step: NDArray[np.int64]


def find_plate(sight: Sight) -> PlateRegion | None:
    """Find the largest body of plastic grey that is no blurred rim of bone.

    Voxels within 0.11 mm of bone are left out first: across such a rim the grey values pass through those
    of plastic. What remains is smoothed, labelled, and grown back by the same distance.
    """
    from scipy import ndimage

    if sight.plastic is None:
        return None
    scan = sight.scan
    middle = 0.5 * (sight.air + sight.plastic)
    rim = max(1, int(np.ceil(_RIM_MM / float(scan.spacing_mm.mean()))))
    box = _crowded(scan.grey > middle, 3 * rim + 4)
    grey = scan.grey[box]
    bone = calmed(grey, scan.noise / (sight.bone - sight.air)) > sight.between
    near_bone = ndimage.binary_dilation(bone, iterations=rim)
    smooth = ndimage.gaussian_filter(grey, 0.7)
    free = (smooth > middle) & ~near_bone
    labels, count = ndimage.label(ndimage.binary_opening(free))
    if count == 0:
        return None
    sizes = np.bincount(labels.ravel())[1:]
    if sizes.max() * scan.voxel_mm3 < _LEAST_MM3:
        return None
    core = labels == int(np.argmax(sizes)) + 1
    grown = ndimage.binary_dilation(core, mask=(smooth > middle) & ~bone, iterations=rim + 1)
    plastic = _pure(grey, core, rim, sight.plastic)
    air = _pure(grey, (smooth < middle) & ~near_bone, rim, sight.air)
    mask = np.zeros(scan.grey.shape, dtype=bool)
    mask[box] = grown
    return PlateRegion(mask, 0.5 * (air + plastic), air, plastic, scan.step)


def _crowded(mask: NDArray[np.bool_], margin: int) -> tuple[slice, ...]:
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


def _pure(grey: NDArray[np.floating], region: NDArray[np.bool_], rim: int, guess: float) -> float:
    """Return the mean grey value well inside a region; the guess where little of it lies that deep.

    The levels of the coarse view are peaks of a histogram, 1 % off here and there: that would move the
    face of the plate by a micrometre.
    """
    from scipy import ndimage

    deep = grey[ndimage.binary_erosion(region, iterations=rim)]
    if len(deep) < _LEAST_DEEP:
        return guess
    low, high = np.percentile(deep, (1.0, 99.0))
    return float(deep[(deep >= low) & (deep <= high)].mean())


def plate_surface(volume: Volume, sight: Sight, plate: PlateRegion) -> Surface | None:
    """Return the closed surface of the plate, cut out of the bone glued to it.

    On a grid of about 0.025 mm (means over blocks of voxels when the scan is finer), at the level half way
    between air and plastic; None when nothing closed can be made of it.
    """
    from scipy import ndimage

    rim = np.stack(np.nonzero(plate.mask)[::-1], axis=1)
    low = np.maximum((rim.min(axis=0) - 2) * plate.step, 0)
    high = np.minimum((rim.max(axis=0) + 3) * plate.step, volume.size)
    block = np.maximum(np.floor(_SURFACE_MM / volume.spacing_mm + 0.01), 1).astype(np.int64)
    while np.prod((high - low) // block) > _MOST_VOXELS:
        block = block + 1
    grey = _block_means(volume, low, high, block)
    if sight.scan.noise > 0.12 * (plate.plastic - plate.air):
        grey = ndimage.gaussian_filter(grey, 0.8)
    count = np.array(grey.shape[::-1])
    centre = low + (block - 1) / 2.0
    wide = ndimage.binary_dilation(plate.mask, iterations=2)
    region = _lookup(wide, (centre[None, :] + np.arange(count.max())[:, None] * block), count, plate.step)
    field = np.clip((grey - plate.air) / (plate.plastic - plate.air), -1.0, 1.0)
    bone = ndimage.binary_dilation(grey > sight.between)
    field[~region | bone] = np.minimum(field[~region | bone], 0.0)
    transform = volume.scan_from_index.copy()
    transform[:3, 3] = volume.scan_points(centre)
    transform[:3, :3] = transform[:3, :3] * block
    try:
        return iso_surface(field, 0.5, transform)
    except CtInertiaError:
        return None


def _block_means(
    volume: Volume, low: NDArray[np.int64], high: NDArray[np.int64], block: NDArray[np.int64]
) -> NDArray[np.float32]:
    bx, by, bz = (int(b) for b in block)
    nx, ny, nz = (int(n) for n in (high - low) // block)
    x, y, z = (int(v) for v in low)
    if (bx, by, bz) == (1, 1, 1):
        return finite(volume.array[z : z + nz, y : y + ny, x : x + nx], volume)
    means = np.empty((nz, ny, nx), dtype=np.float32)
    for k in range(nz):
        slab = finite(volume.array[z + k * bz : z + (k + 1) * bz, y : y + ny * by, x : x + nx * bx], volume)
        means[k] = slab.reshape(bz, ny, by, nx, bx).mean(axis=(0, 2, 4))
    return means


def _lookup(
    mask: NDArray[np.bool_], index: Array, count: NDArray[np.int64], step: NDArray[np.int64]
) -> NDArray[np.bool_]:
    places = []
    for axis in range(3):
        k = 2 - axis
        fine = index[: count[k], k]
        places.append(np.clip(np.round((fine - step[k] // 2) / step[k]).astype(int), 0, mask.shape[axis] - 1))
    return np.asarray(mask[np.ix_(*places)])

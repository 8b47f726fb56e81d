"""The labels of everything found, on the smallest box of the scan that holds them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, LabelledVolume
from ct_inertia.coarse import calmed, finite
from ct_inertia.cutting import Cut
from ct_inertia.plate_region import PlateRegion, coarse_to_fine
from ct_inertia.search import Sight
from ct_inertia.volume import Volume

_SLAB = 32


def label_box(volume: Volume, sight: Sight, plate: PlateRegion | None, cut: Cut) -> LabelledVolume:
    """Label stapes, plate and other bone at full resolution, slab by slab, and crop to what is labelled."""
    step = sight.scan.step
    first, last = _extent(sight, plate, cut, step, volume.size)
    shape = tuple(int(n) for n in (last - first)[::-1])
    labels = np.zeros(shape, dtype=np.uint8)
    known = [piece.label for piece in (sight.stapes, *sight.others)]
    wide = _grown(np.isin(sight.pieces, known))
    plastic = None if plate is None else _grown(plate.mask)
    x, y = int(first[0]), int(first[1])
    for start in range(0, shape[0], _SLAB):
        z = int(first[2]) + start
        count = min(_SLAB, shape[0] - start)
        grey = finite(volume.array[z : z + count, y : y + shape[1], x : x + shape[2]], volume)
        grey = calmed(grey, sight.scan.noise / (sight.bone - sight.air))
        corner = np.array([x, y, z])
        slab = labels[start : start + count]
        bone = (grey > sight.between) & coarse_to_fine(wide, step, corner, grey.shape)
        slab[bone] = OTHER_BONE
        if plate is not None and plastic is not None:
            near = coarse_to_fine(plastic, plate.step, corner, grey.shape)
            slab[(grey > plate.middle) & near & ~bone] = PLATE
    own = tuple(
        slice(int(a), int(a) + n) for a, n in zip((cut.first - first)[::-1], cut.stapes.shape, strict=True)
    )
    part = labels[own]
    part[cut.stapes] = STAPES
    return _cropped(labels, first, volume)


def _extent(
    sight: Sight, plate: PlateRegion | None, cut: Cut, step: NDArray[np.int64], size: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first and one past the last index x, y, z of a box that holds all bodies and the cut's box."""
    low = [cut.first]
    high = [cut.first + np.array(cut.stapes.shape[::-1])]
    for piece in (sight.stapes, *sight.others):
        low.append((piece.low - 1) * step)
        high.append((piece.high + 1) * step)
    if plate is not None:
        index = np.nonzero(plate.mask)[::-1]
        low.append((np.array([k.min() for k in index]) - 1) * plate.step)
        high.append((np.array([k.max() for k in index]) + 2) * plate.step)
    first = np.maximum(np.min(low, axis=0), 0).astype(np.int64)
    return first, np.minimum(np.max(high, axis=0), size).astype(np.int64)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(mask, structure=np.ones((3, 3, 3), dtype=bool)))


def _cropped(labels: NDArray[np.uint8], first: NDArray[np.int64], volume: Volume) -> LabelledVolume:
    parts, start = [], []
    for axis in range(3):
        others = tuple(k for k in range(3) if k != axis)
        used = np.flatnonzero(labels.any(axis=others))
        parts.append(slice(int(used[0]), int(used[-1]) + 1))
        start.append(int(used[0]))
    corner = first + np.array(start[::-1])
    return LabelledVolume(np.ascontiguousarray(labels[tuple(parts)]), corner, volume)

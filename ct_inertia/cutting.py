"""Cut the stapes out of the scan at full resolution, inside a box around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.coarse import finite
from ct_inertia.plate_region import PlateRegion, coarse_to_fine
from ct_inertia.search import Sight
from ct_inertia.volume import Volume
from kinematics.notices import Notice

Array = NDArray[np.float64]

_MARGIN_VOXELS = 16
_MARGIN_MM = 0.25
_DUST_VOXELS = 6


@dataclass(frozen=True)
class Cut:
    """The stapes and its neighbours in a box of the scan.

    Attributes
    ----------
    first : ndarray of int, (3,)
        Index x, y, z of the box's first voxel in the scan.
    grey : ndarray of float32, [z, y, x]
    stapes : ndarray of bool
        Its voxels above the level between air and bone.
    others : ndarray of bool
        Voxels of other bone above that level.
    plate : ndarray of bool
        Voxels of the plate.
    method : str
        How the stapes was separated.
    notices : tuple of Notice
    """

    first: NDArray[np.int64]
    grey: NDArray[np.float32]
    stapes: NDArray[np.bool_]
    others: NDArray[np.bool_]
    plate: NDArray[np.bool_]
    method: str
    notices: tuple[Notice, ...] = ()

    def scan_from_box(self, volume: Volume) -> Array:
        """Affine 4x4 from an index x, y, z of the box to scan coordinates, mm."""
        matrix = volume.scan_from_index.copy()
        matrix[:3, 3] = volume.scan_points(self.first)
        return matrix


def box_around(
    volume: Volume, low: NDArray[np.integer], high: NDArray[np.integer]
) -> tuple[NDArray[np.int64], tuple[slice, ...]]:
    """Return the first index and the slices z, y, x of a box with a margin for blur and air."""
    margin = np.maximum(_MARGIN_VOXELS, np.ceil(_MARGIN_MM / volume.spacing_mm)).astype(np.int64)
    first = np.maximum(low.astype(np.int64) - margin, 0)
    last = np.minimum(high.astype(np.int64) + margin, volume.size)
    return first, tuple(slice(int(a), int(b)) for a, b in zip(first[::-1], last[::-1], strict=True))


def cut_out(volume: Volume, sight: Sight, plate: PlateRegion | None) -> Cut:
    """Take the connected piece of bone that the coarse view chose, at full resolution.

    Parameters
    ----------
    volume : Volume
    sight : Sight
    plate : PlateRegion or None
    """
    from scipy import ndimage

    step, piece = sight.scan.step, sight.stapes
    first, box = box_around(volume, piece.low * step, piece.high * step)
    grey = finite(volume.array[box], volume)
    bone = grey > sight.between
    labels, _ = ndimage.label(bone)
    near = tuple(slice(a, b) for a, b in zip(piece.low[::-1], piece.high[::-1], strict=True))
    seeds = np.stack(np.nonzero(sight.pieces[near] == piece.label)[::-1], axis=1) + piece.low
    seeds = seeds * step + step // 2 - first
    votes = np.bincount(labels[tuple(seeds[:, ::-1].T)])
    votes[0] = 0
    own = int(np.argmax(votes))
    sizes = np.bincount(labels.ravel())
    other = sizes >= _DUST_VOXELS
    other[[0, own]] = False
    plastic = np.zeros(grey.shape, dtype=bool)
    if plate is not None:
        plastic = coarse_to_fine(plate.mask, step, first, grey.shape) & (grey > plate.middle) & ~bone
    return Cut(first, grey, labels == own, other[labels], plastic, "connected component")

"""Cut the stapes out of the scan at full resolution, inside a box around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.coarse import calmed, finite
from ct_inertia.plate_region import PlateRegion, coarse_to_fine
from ct_inertia.search import Sight
from ct_inertia.separate import flooded
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
    """Take the piece of bone that the coarse view chose, at full resolution.

    Connected bone that holds other pieces too is flooded from the cores of the pieces.

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
    quiet = calmed(grey, sight.scan.noise / (sight.bone - sight.air))
    bone = quiet > sight.between
    labels, _ = ndimage.label(bone)
    own_cores, other_cores = _cores(sight, first, grey.shape)
    method = sight.method
    votes = np.bincount(labels[own_cores], minlength=labels.max() + 1)
    votes[0] = 0
    own = int(np.argmax(votes))
    stapes = labels == own
    if np.any(stapes[other_cores]):
        stapes, rest = _flooded_apart(quiet, bone, own_cores, other_cores)
        if sight.markers is None:
            method = "flooded by grey value from the cores of the pieces"
    else:
        rest = bone & ~stapes
    plastic = np.zeros(grey.shape, dtype=bool)
    if plate is not None:
        plastic = coarse_to_fine(plate.mask, plate.step, first, grey.shape) & (quiet > plate.middle) & ~bone
    return Cut(first, grey, stapes, _without_dust(rest), plastic, method)


Places = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def _cores(sight: Sight, first: NDArray[np.int64], shape: tuple[int, ...]) -> tuple[Places, Places]:
    """Return voxels z, y, x of the box that surely belong to the stapes, and to other bone."""
    from scipy.ndimage import binary_erosion

    step = sight.scan.step
    low = np.maximum((first // step) - 1, 0)
    high = (first + np.array(shape[::-1])) // step + 2
    part = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    pieces = sight.pieces[part] if sight.markers is None else sight.markers[part]
    own = pieces == sight.stapes.label
    known = np.array([piece.label for piece in sight.others], dtype=np.int64)
    other = np.isin(pieces, known)
    if sight.markers is None:
        thinner = binary_erosion(own)
        own = thinner if np.any(thinner) else own
        other = binary_erosion(other)

    def places(mask: NDArray[np.bool_]) -> Places:
        index = (np.stack(np.nonzero(mask)[::-1], axis=1) + low) * step + step // 2 - first
        index = index[np.all((index >= 0) & (index < np.array(shape[::-1])), axis=1)]
        return index[:, 2], index[:, 1], index[:, 0]

    return places(own), places(other)


def _flooded_apart(
    grey: NDArray[np.float32], bone: NDArray[np.bool_], own: Places, other: Places
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    markers = np.zeros(grey.shape, dtype=np.int32)
    markers[own] = 1
    markers[other] = 2
    labels = flooded(grey, np.where(bone, markers, 0).astype(np.int32), bone)
    return labels == 1, (labels != 1) & bone


def _without_dust(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy import ndimage

    labels, _ = ndimage.label(mask)
    kept = np.bincount(labels.ravel()) >= _DUST_VOXELS
    kept[0] = False
    return np.asarray(kept[labels])

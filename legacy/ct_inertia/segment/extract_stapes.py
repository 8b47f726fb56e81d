"""Cut the stapes out of the scan, inside a box around it, on a grid fine enough to measure on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation
from legacy.ct_inertia.segment.plate_region import PlateRegion
from legacy.ct_inertia.segment.touching_bones import flood_from_markers
from legacy.ct_inertia.volume.coarse_view import smooth_noise
from legacy.ct_inertia.volume.grid_operations import boxes_and_sizes, eroded, labelled
from legacy.ct_inertia.volume.mask_statistics import look_up
from legacy.ct_inertia.volume.volume import Volume
from legacy.ct_inertia.volume.working_copy import PARTING_MM, WORKING_MM, Working, block_for, working_box
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Margin of the box around the stapes, the larger of both: room for its blur and for air beside that.
_MARGIN_VOXELS = 16
_MARGIN_MM = 0.25
_DUST_VOXELS = calibrated("cutting.dust_voxels")


@dataclass(frozen=True)
class Cut:
    """The stapes and its neighbours in a box.

    Attributes
    ----------
    first : ndarray of int, (3,)
        Index x, y, z of the box's first voxel in the volume that it is measured on: the working volume
        when there is one, otherwise the scan.
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
    working : Working or None
        The working volume, which is the whole box; None when the box is a part of the scan itself.
    at_neck : bool
        It was cut off other bone by a plane at a neck.
    immersed : bool
        What was taken for the plate lies all around the stapes.
    """

    first: NDArray[np.int64]
    grey: NDArray[np.float32]
    stapes: NDArray[np.bool_]
    others: NDArray[np.bool_]
    plate: NDArray[np.bool_]
    method: str
    notices: tuple[Notice, ...] = ()
    working: Working | None = None
    at_neck: bool = False
    immersed: bool = False

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


def extract_stapes(volume: Volume, sight: CoarseSegmentation, plate: Callable[[], PlateRegion | None]) -> Cut:
    """Extract the piece of bone that the coarse view chose, on a working grid.

    Connected bone that holds other pieces too is flooded from the cores of the pieces, on a finer grid
    where the scan has one.

    Parameters
    ----------
    volume : Volume
    sight : CoarseSegmentation
    plate : callable
        Returns the plate's region or None; called last, so that it may still be looked for.
    """
    view = _make_view(_box(volume, sight, WORKING_MM if sight.markers is None else PARTING_MM), sight)
    if view.touching and np.any(block_for(volume.spacing_mm, PARTING_MM) < view.working.block):
        view = _make_view(_box(volume, sight, PARTING_MM), sight)
    method, own, bone = sight.method, view.own, view.bone
    rest = view.rest
    if view.touching:
        own, rest = _flood_apart(view)
        rest = _without_dust(rest)
        if sight.markers is None:
            method = "flooded by grey value from the cores of the pieces"
    working = view.working
    plastic = np.zeros(bone.shape, dtype=bool)
    region = plate()
    if region is not None:
        plastic = working.from_coarse(region.mask, region.step) & (view.quiet > region.middle) & ~bone
    first = np.zeros(3, dtype=np.int64)
    immersed = region is not None and region.immersing
    return Cut(first, working.grey, own, rest, plastic, method, (), working, sight.at_neck, immersed)


Places = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class _View:
    """Bone on a working grid: the connected piece with most cores of the stapes, the rest, and the cores."""

    working: Working
    quiet: NDArray[np.float32]
    bone: NDArray[np.bool_]
    own: NDArray[np.bool_]
    rest: NDArray[np.bool_]
    own_cores: Places
    other_cores: Places

    @property
    def touching(self) -> bool:
        """The piece holds cores of other bone too."""
        return bool(np.any(self.own[self.other_cores]))


def _box(volume: Volume, sight: CoarseSegmentation, most_mm: float) -> Working:
    step, piece = sight.scan.step, sight.stapes
    return working_box(volume, piece.low * step, piece.high * step, _MARGIN_MM, _MARGIN_VOXELS, most_mm)


def _make_view(working: Working, sight: CoarseSegmentation) -> _View:
    noise = sight.scan.noise if working.noise is None else working.noise
    quiet = smooth_noise(working.grey, noise / (sight.bone - sight.air))
    bone = quiet > sight.between
    labels, count = labelled(bone)
    own_cores, other_cores = _cores(sight, working)
    votes = np.bincount(labels[own_cores], minlength=count + 1)
    votes[0] = 0
    own = int(np.argmax(votes))
    kept = boxes_and_sizes(labels, count)[1] >= _DUST_VOXELS
    kept[[0, own]] = False
    rest = look_up(labels, kept)
    return _View(working, quiet, bone, labels == own, rest, own_cores, other_cores)


def _cores(sight: CoarseSegmentation, working: Working) -> tuple[Places, Places]:
    """Return blocks z, y, x that surely belong to the stapes, and to other bone."""
    if sight.markers is None:
        first, step = np.zeros(3, dtype=np.int64), sight.scan.step
        low = np.maximum((working.first // step) - 1, 0)
        high = (working.first + working.block * np.array(working.shape[::-1])) // step + 2
        part = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        pieces = sight.pieces[part]
    else:
        first, step, low = sight.markers.first, sight.markers.step, np.zeros(3, dtype=np.int64)
        pieces = sight.markers.labels
    own = pieces == sight.stapes.label
    other = np.isin(pieces, [piece.label for piece in sight.others])
    if sight.markers is None:
        thinner = eroded(own)
        own = thinner if np.any(thinner) else own
        other = eroded(other)

    def places(mask: NDArray[np.bool_]) -> Places:
        cells = np.stack(np.nonzero(mask)[::-1], axis=1) + low
        index = working.blocks_of(first + cells * step + step // 2)
        index = index[np.all((index >= 0) & (index < np.array(working.shape[::-1])), axis=1)]
        return index[:, 2], index[:, 1], index[:, 0]

    return places(own), places(other)


def _flood_apart(view: _View) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    markers = np.zeros(view.bone.shape, dtype=np.int32)
    markers[view.own_cores] = 1
    markers[view.other_cores] = 2
    labels = flood_from_markers(view.quiet, np.where(view.bone, markers, 0).astype(np.int32), view.bone)
    return labels == 1, (labels != 1) & view.bone


def _without_dust(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels, count = labelled(mask)
    kept = boxes_and_sizes(labels, count)[1] >= _DUST_VOXELS
    kept[0] = False
    return look_up(labels, kept)

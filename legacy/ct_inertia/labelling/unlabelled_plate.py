"""Find the plate in the grey values where a label volume holds the stapes only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.grey.air_level import Guess
from legacy.ct_inertia.segment.candidates import describe
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation, between_levels
from legacy.ct_inertia.segment.plate_region import PlateRegion, find_plate
from legacy.ct_inertia.volume.coarse_view import coarse_overview
from legacy.ct_inertia.volume.grid_operations import used_box
from legacy.ct_inertia.volume.volume import Volume


@dataclass(frozen=True)
class FoundPlate:
    """A plate, and the coarse view that shows it."""

    region: PlateRegion
    sight: CoarseSegmentation

    def mask(self, first: NDArray[np.int64], grey: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return its voxels in a part of the scan [z, y, x] that begins at an index x, y, z."""
        cells = []
        for axis in (2, 1, 0):
            index = (first[axis] + np.arange(grey.shape[2 - axis])) // self.region.step[axis]
            cells.append(np.clip(index, 0, self.region.mask.shape[2 - axis] - 1))
        near = self.region.mask[np.ix_(*cells)]
        return np.asarray(near & (grey > self.region.middle) & (grey <= self.sight.between))


def plate_beside(
    volume: Volume, stapes: NDArray[np.bool_], offset: NDArray[np.int64], guess: Guess
) -> FoundPlate | None:
    """Search the grey values for a plate where only the stapes is labelled.

    Parameters
    ----------
    volume : Volume
    stapes : ndarray of bool, [z, y, x]
        The label, on voxels of the scan that begin at ``offset`` (x, y, z).
    guess : Guess
        Levels of air and bone.
    """
    glance = coarse_overview(volume)
    scan = glance.scan
    middle = 0.5 * (guess.air + guess.bone)
    light = [float(v) for v in glance.levels[1:] if guess.air < v <= middle]
    if not light:
        return None
    plastic = light[-1]
    places, kept = [], []
    for axis in (2, 1, 0):
        index = np.arange(scan.grey.shape[2 - axis]) * scan.step[axis] + scan.step[axis] // 2 - offset[axis]
        inside = (index >= 0) & (index < stapes.shape[2 - axis])
        places.append(np.flatnonzero(inside))
        kept.append(index[inside])
    pieces = np.zeros(scan.grey.shape, dtype=np.int32)
    pieces[np.ix_(*places)] = stapes[np.ix_(*kept)]
    box = used_box(pieces == 1)
    if box is None:
        return None
    piece = describe(pieces, 1, box, scan.spacing_mm)
    between = between_levels(guess.air, plastic, guess.bone)
    sight = CoarseSegmentation(scan, pieces, piece, (), guess.air, guess.bone, plastic, between)
    region = find_plate(sight)
    return None if region is None or region.immersing else FoundPlate(region, sight)

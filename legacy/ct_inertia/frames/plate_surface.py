"""The closed surface of the plastic plate, and its plane faces."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation
from legacy.ct_inertia.segment.plate_region import PlateRegion, thinned
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.grid_operations import dilated, gaussian
from legacy.ct_inertia.volume.volume import Volume

if TYPE_CHECKING:
    from legacy.ct_inertia.frames.plane_faces import PlaneFace

# Distance beyond the outermost voxels, in voxels, from which a vertex belongs to the cap that closes the
# surface and not to the plate: rounding of float32 vertices stays below.
_BEYOND = 0.02
# Standard deviation of the smoothing of the coarse view, in voxels: about the least that leaves no stairs of
# voxels in the surface. Planes are fitted to the grey values themselves afterwards.
_SMOOTH_VOXELS = 0.7


@dataclass(frozen=True)
class PlateSurface(Surface):
    """The closed surface of a plate.

    Attributes
    ----------
    on_border : ndarray of bool, (n,)
        Vertices where it is not the plate that ends but the scan.
    """

    on_border: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @cached_property
    def planes(self) -> list[PlaneFace]:
        """Its plane faces of more than a hundredth of its area, the largest first; found on first use."""
        from legacy.ct_inertia.frames.plane_faces import large_faces

        return large_faces(self, self.on_border)


def surface_with_planes(volume: Volume, sight: CoarseSegmentation, plate: PlateRegion) -> PlateSurface | None:
    """Return the closed surface of the plate, its plane faces found already."""
    surface = plate_surface(volume, sight, plate)
    if surface is not None:
        _ = surface.planes
    return surface


def plate_surface(volume: Volume, sight: CoarseSegmentation, plate: PlateRegion) -> PlateSurface | None:
    """Return the closed surface of the plate, cut out of the bone glued to it.

    On the grid of the coarse view, at the level half way between air and plastic; None when nothing closed
    can be made of it.
    """
    index = np.nonzero(plate.mask)
    low = [max(int(k.min()) - 2, 0) for k in index]
    high = [int(k.max()) + 3 for k in index]
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    coarse = thinned(sight.scan.grey, int(plate.step[0] // sight.scan.step[0]))
    grey = gaussian(coarse[box], _SMOOTH_VOXELS, truncate=3.0)
    region = dilated(plate.mask[box], 2)
    share = np.clip((grey - plate.air) / (plate.plastic - plate.air), -1.0, 1.0)
    bone = dilated(grey > sight.between)
    share[~region | bone] = np.minimum(share[~region | bone], 0.0)
    transform = volume.scan_from_index.copy()
    first = _first(sight.scan.step, plate.step)
    transform[:3, :3] = transform[:3, :3] * plate.step
    transform[:3, 3] = volume.scan_points(first + np.array(low[::-1]) * plate.step)
    try:
        surface = iso_surface(share, 0.5, transform)
    except CtInertiaError:
        return None
    # What closes the surface where the scan ends lies beyond the outermost voxels of the view.
    place = (volume.index_points(surface.vertices_mm) - first) / plate.step
    last = np.array(coarse.shape[::-1]) - 1
    capped = np.any((place < -_BEYOND) | (place > last + _BEYOND), axis=1)
    return PlateSurface(surface.vertices_mm, surface.faces, on_border=capped)


def _first(step: NDArray[np.int64], wide: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index x, y, z in the scan of the first voxel of a view thinned from ``step`` to ``wide``."""
    return np.asarray(step // 2 + (wide // step // 2) * step)

"""What segmentation hands on: labels, surfaces, moments, levels, and why it believes in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.background import Later
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.warnings import Notice

# Numbers of the bodies in label volumes, written and read; 0 is the background.
STAPES, PLATE, OTHER_BONE = 1, 2, 3
# Voxels a slab of labels that is read at a time: 4 MB.
_SLAB_VOXELS = 1 << 22


@dataclass(frozen=True)
class LabelledVolume:
    """Labels on a box of the scan's grid: 0 background, 1 stapes, 2 plate, 3 other bone.

    Attributes
    ----------
    first_index, end_index : ndarray of int, (3,)
        Index x, y, z in the scan of the box's first voxel, and one past its last.
    grid : Volume
        The scan, for its spacing, origin and direction.
    read : callable
        Makes the labels, uint8 [z, y, x], between two corners (first, one past the last) of the scan.
    """

    first_index: NDArray[np.int64]
    end_index: NDArray[np.int64]
    grid: Volume
    read: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.uint8]]

    @classmethod
    def of_array(
        cls, labels: NDArray[np.uint8], first_index: NDArray[np.int64], grid: Volume
    ) -> LabelledVolume:
        """Take labels [z, y, x] that are there already."""

        def read(low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.uint8]:
            a, b = low - first_index, high - first_index
            return labels[a[2] : b[2], a[1] : b[1], a[0] : b[0]]

        return cls(first_index, first_index + np.array(labels.shape[::-1]), grid, read)

    @cached_property
    def labels(self) -> NDArray[np.uint8]:
        """All labels, [z, y, x]; as large as the box."""
        return self.read(self.first_index, self.end_index)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels of the box along z, y, x."""
        x, y, z = (int(n) for n in self.end_index - self.first_index)
        return z, y, x

    @property
    def spacing_mm(self) -> Array:
        """Voxel spacing along x, y, z, mm."""
        return self.grid.spacing_mm

    @property
    def direction(self) -> Array:
        """Directions of the array axes in scan coordinates, (3, 3), in columns."""
        return self.grid.direction

    @property
    def origin_mm(self) -> Array:
        """Scan coordinates of the centre of the box's first voxel, (3,), mm."""
        return self.grid.scan_points(self.first_index)

    def mask(self, label: int) -> NDArray[np.bool_]:
        """Return the voxels [z, y, x] of one label."""
        return np.asarray(self.labels == label)

    def slabs(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the labels some layers at a time, about four million voxels each."""
        layers = max(1, _SLAB_VOXELS // max(1, self.shape[1] * self.shape[2]))
        low, high = self.first_index.copy(), self.end_index.copy()
        for start in range(int(self.first_index[2]), int(self.end_index[2]), layers):
            low[2], high[2] = start, min(start + layers, int(self.end_index[2]))
            yield self.read(low, high)

    @cached_property
    def packed(self) -> Later[bytes]:
        """The voxels of the labels as gzip; packed in the background from the first use on."""
        from legacy.ct_inertia.volume.label_file import packed_labels

        return Later(packed_labels, self)

    def write(self, path: Path | str) -> None:
        """Write the labels as NRRD; as a segmentation of 3D Slicer where the name ends in ``.seg.nrrd``."""
        from legacy.ct_inertia.volume.label_file import label_volume, segmentation

        content = segmentation if Path(path).name.endswith(".seg.nrrd") else label_volume
        Path(path).write_bytes(content(self, self.packed.result()))


@dataclass(frozen=True)
class Levels:
    """Grey levels of the materials, measured near the stapes.

    Attributes
    ----------
    air, bone : float
        Grey values of pure air around and of pure bone inside the stapes.
    plastic : float or None
        Grey value of the plate.
    noise : float
        Standard deviation of one voxel in air.
    air_sd, bone_sd : float
        Standard uncertainty of the levels.
    bone_from : str
        How the bone level was found: ``interior`` (voxels deep inside) or ``fit`` (edge profiles).
    """

    air: float
    bone: float
    plastic: float | None
    noise: float
    air_sd: float
    bone_sd: float
    bone_from: str = "interior"

    @property
    def contrast(self) -> float:
        """Bone minus air."""
        return self.bone - self.air


@dataclass(frozen=True)
class PlateFace:
    """A plane face of the plate, fitted to sub-voxel accuracy in the grey values near the stapes.

    Attributes
    ----------
    normal : ndarray, (3,)
        Outward unit normal (from the plastic to the air), scan axes.
    offset_mm : float
        The plane is ``normal . r = offset_mm`` in scan coordinates.
    sigma_mm : float
        Standard deviation of the edge's blur along the normal.
    air, plastic : float
        Grey values on the two sides.
    rms_mm : float
        How far single edge positions scatter about the plane.
    """

    normal: Array
    offset_mm: float
    sigma_mm: float
    air: float
    plastic: float
    rms_mm: float


@dataclass(frozen=True)
class PlateFrame:
    """The frame of the plastic plate.

    Attributes
    ----------
    scan_from_plate : RigidTransform
        mm.
    covariance : ndarray, (6, 6)
        Of the frame's displacement in its own axes, m and rad.
    outline_mm : ndarray, (n, 3)
        Corners of the visible face, scan coordinates; empty when fiducials gave the frame.
    cropped : bool
        The field of view ends the face on at least one side.
    source : str
        ``faces`` or ``fiducials``.
    notices : tuple of Notice
    """

    scan_from_plate: RigidTransform
    covariance: Array
    outline_mm: Array
    cropped: bool
    source: str
    notices: tuple[Notice, ...] = field(default=())


@dataclass(frozen=True)
class WindowWall:
    """The surface of bone that is not the stapes, as seen.

    Attributes
    ----------
    points_mm : ndarray, (n, 3)
        Scan coordinates; where the blurred image has half of that bone's contrast.
    faces : ndarray of int, (m, 3)
        Outward; open where the box around the stapes ends.
    blur_mm : float
        Standard deviation of the blur with which it is seen.
    level_sd : float
        Standard deviation of the half level, as a share of the contrast.
    tail_sd : float
        Standard deviation of what is not known of the tails of close bodies, as a share of them.
    """

    points_mm: Array
    faces: NDArray[np.int64]
    blur_mm: float
    level_sd: float
    tail_sd: float


@dataclass(frozen=True)
class Bodies:
    """Everything found in a scan.

    Attributes
    ----------
    volume : Volume
        The scan itself.
    labels : LabelledVolume
    stapes : Surface
        Iso surface of the stapes whose volume matches ``moments``.
    frame_surface : Surface
        Half level of the grey values of the stapes on a coarse grid, for its frame.
    frame_blur_mm : float
        Standard deviation of the blur with which that surface is seen; 0 when unknown.
    frame_noise_mm4 : float
        Spectral density of its height noise at long waves, as far as neighbouring voxels share noise.
    frame_doubt : Surface or None
        The same surface, with less soft tissue subtracted, by one standard deviation.
    wall : WindowWall or None
        Surface of other bone near the stapes.
    plate : Surface or None
    plate_frame : Later of PlateFrame or None, or None
        The plate's frame, sought in the background; None where it is still to be sought.
    moments : Moments
        Partial-volume moments of the stapes with their covariance by source: the numbers to use.
    mesh_moments : Moments
        Moments of ``stapes``: an independent cross-check.
    levels : Levels or None
        None when the bodies come from labels alone.
    psf_sigma_mm : float
        Standard deviation of the scan's point spread, voxel included; 0 for labels alone.
    plate_face : PlateFace or None
        The plate's plane face nearest to the stapes, where one could be fitted.
    evidence : mapping of str to JSON-able
        Why this body was taken for the stapes, and how it was cut out; for the report.
    notices : tuple of Notice
    """

    volume: Volume
    labels: LabelledVolume
    stapes: Surface
    frame_surface: Surface
    plate: Surface | None
    moments: Moments
    mesh_moments: Moments
    levels: Levels | None
    psf_sigma_mm: float
    frame_blur_mm: float = 0.0
    frame_noise_mm4: float = 0.0
    frame_doubt: Surface | None = None
    wall: WindowWall | None = None
    plate_face: PlateFace | None = None
    plate_frame: Later[PlateFrame | None] | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()

"""Value types of segmentation and measurement: what `find` gives, what `grey` gives, in scan coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.body_moments import VOLUME_PARAMETERS as VOLUME_PARAMETERS
from ct_inertia.body_moments import Moments as Moments
from ct_inertia.voxels.fields import Grey as Grey
from ct_inertia.voxels.grid import Grid as Grid
from ct_inertia.voxels.grid import Index as Index
from ct_inertia.voxels.masks import Mask as Mask
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from ct_inertia.frames.plate import PlaneFace
    from ct_inertia.surface.surface import Surface

STAPES, PLATE, OTHER_BONE = 1, 2, 3
"""Numbers of the bodies in label volumes, read and written; 0 is the background."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Box(Grid):
    """A box of the scan as single-precision grey values.

    Attributes
    ----------
    grey : ndarray of float32, [z, y, x]
        Means over blocks; NaN and infinity replaced.
    measured : ndarray of bool, [z, y, x], or None
        False where a constant fills the outside of a round or box-shaped field of view; None: all measured.
    single : ndarray, [z, y, x], or None
        One voxel of every block as it is stored; None where every block is one voxel.
    is_mask : bool
        The scan holds a few classes, not grey values: ``grey`` is 0 or 1 then.
    repeated : tuple of int
        Slices of the scan that are copies of those before them.
    """

    grey: Grey
    measured: Mask | None = None
    single: NDArray[Any] | None = None
    is_mask: bool = False
    repeated: tuple[int, ...] = ()

    @property
    def stored(self) -> NDArray[Any]:
        """Grey values of single voxels as they are stored, one of every block."""
        return self.grey if self.single is None else self.single

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.shape[::-1]))
        edges = " x ".join(f"{1e3 * h:.4g}" for h in self.spacing_mm)
        return f"Box({size} blocks of {edges} um from voxel {', '.join(map(str, self.first))})"


@dataclass(frozen=True)
class Cells:
    """Labels of the whole scan on the coarse grid of the first look.

    Attributes
    ----------
    labels : ndarray of uint8, [z, y, x]
        0 background, 1 stapes, 2 plate, 3 other bone.
    """

    labels: NDArray[np.uint8]
    grid: Grid


@dataclass(frozen=True)
class PlateRegion:
    """The plastic plate as a mask and a field on a grid coarser than that of the stapes.

    Attributes
    ----------
    mask : ndarray of bool, [z, y, x]
        Voxels of plastic, grown back to the bone that they touch.
    field : ndarray of float32, [z, y, x]
        Positive in plastic, 0 at half of its contrast: its contour is the closed surface of the plate, cut
        out of the bone that is glued to it.
    air, plastic : float
        Grey levels; 0 and 1 for labels.
    immersing : bool
        It lies around the stapes on nearly all sides, as a fluid does and no plate.
    one_of_several : bool
        There are other bodies of plastic, farther from the stapes.
    named : bool
        A person labelled it.
    """

    mask: Mask
    field: Grey
    grid: Grid
    air: float
    plastic: float
    immersing: bool = False
    one_of_several: bool = False
    named: bool = False

    @property
    def scan_from_index(self) -> Array:
        """Index x, y, z of the grid to scan coordinates, mm, (4, 4)."""
        return self.grid.scan_from_index


@dataclass(frozen=True)
class Labelled:
    """Which voxels are stapes, other bone and plate: the result of `ct_inertia.find`.

    Attributes
    ----------
    box : Box
        Around the stapes, with a margin for its blur and for air.
    stapes, other, plate : ndarray of bool, [z, y, x]
        Masks on the grid of the box, disjoint.
    cells : Cells
        The same bodies in the whole scan, coarse.
    plate_region : PlateRegion or None
        The whole plate; None where none was found or a fluid was taken for it.
    air, bone, plastic : float
        First guess of the grey levels; ``plastic`` is None without a plate.
    noise : float
        Standard deviation of the grey value of a block of the box within a material.
    separation : str
        How the stapes was separated from other bone, in words.
    at_neck : bool
        It was by a plane at a neck.
    named : bool
        A person named the body by a seed or by labels: an unusual size is reported, not refused.
    """

    box: Box
    stapes: Mask
    other: Mask
    plate: Mask
    cells: Cells
    plate_region: PlateRegion | None
    air: float
    bone: float
    plastic: float | None
    noise: float
    separation: str
    at_neck: bool = False
    named: bool = False
    notices: tuple[Notice, ...] = ()

    def numbers(self) -> NDArray[np.uint8]:
        """Return the bodies of the box by their numbers in label files, [z, y, x]."""
        numbers = np.zeros(self.box.shape, dtype=np.uint8)
        for mask, number in ((self.other, OTHER_BONE), (self.plate, PLATE), (self.stapes, STAPES)):
            numbers[mask] = number
        return numbers


@dataclass(frozen=True)
class BodySurface:
    """A fitted body as a field whose zero is its closed surface.

    Attributes
    ----------
    field : ndarray of float32, [z, y, x]
        Positive inside; 0 on the surface; nearly linear across it, 1 / (2.5 blur widths) per mm. -1 outside
        of the body's own basin. Contour it at 0 after padding it by one voxel of -1.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the field to scan coordinates, mm.
    blur_mm : float
        Blur that is left in the surface, standard deviation: `surface.blur_left` of what edges are
        seen through for a fitted body; a voxel's width for labels.
    spread_mm2 : ndarray, (3, 3)
        Covariance, in scan axes, of what edges are seen through: blur, smoothing, interpolation.
    noise_mm4 : float
        Spectral density of the height noise at long waves by the noise of the grey values: where neighbours
        share it, more than the surface shows at short ones.
    misfit_sd_mm : ndarray of float32, [z, y, x]
        Standard deviation of the height by place that the misfit of the scene leaves, common over
        ``misfit_mm``; 0 where the scene fits to the noise.
    level_sd_mm : float
        Standard deviation of one shift of the whole surface along its normal: levels of air and bone.
    cuts : tuple of (ndarray (3,), float)
        Middle in the scan, mm, and area, mm2, of where the border of the scan cuts the body.
    one_sd : ndarray of float32, [z, y, x], or None
        The field with what was subtracted around the body (media, neighbours' tails, plate) one standard
        deviation less; None where nothing was.
    """

    field: Grey
    scan_from_index: Array
    blur_mm: float
    spread_mm2: Array
    noise_mm4: float
    misfit_sd_mm: Grey
    misfit_mm: float
    level_sd_mm: float
    one_sd: Grey | None = None
    cuts: tuple[tuple[Array, float], ...] = ()

    @property
    def resolution_mm(self) -> float:
        """Width of what edges are seen through, root mean square of its directions."""
        return float(np.sqrt(np.trace(self.spread_mm2) / 3.0))

    def misfit_at(self, points_mm: Array) -> Array:
        """Return the standard deviation of the height by misfit (n,), mm, at points (n, 3)."""
        back = np.linalg.inv(self.scan_from_index)
        index = np.rint(points_mm @ back[:3, :3].T + back[:3, 3]).astype(int)[:, ::-1]
        z, y, x = np.clip(index, 0, np.array(self.misfit_sd_mm.shape) - 1).T
        return np.asarray(self.misfit_sd_mm[z, y, x], dtype=float)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One model of the grey values in a box: air + sum_k contrast_k (blur * body_k) + media + noise.

    Attributes
    ----------
    air, bone : float
        Grey levels of air (or of the medium far from every body) and of the stapes.
    air_sd, bone_sd : float
        Their standard uncertainties; that of bone is without that of air.
    bone_from : str
        How the stapes' level was found: ``interior`` (voxels deep inside) or ``fit``.
    sigma_mm : float
        Width of the blur, root mean square of its three directions, voxel included.
    noise : float
        Standard deviation of one voxel in air.
    even : Moments
        Those of the fitted body if all of its bone were alike, without covariance.
    media : mapping of str to float
        What else was fitted: ``soft``, ``void``, ``coat_mm``, as shares of the stapes' contrast.
    """

    air: float
    bone: float
    air_sd: float
    bone_sd: float
    bone_from: str
    sigma_mm: float
    noise: float
    even: Moments
    media: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MeasuredBody:
    """The stapes as measured: the result of `ct_inertia.grey`.

    Attributes
    ----------
    scene : Scene or None
        None for labels alone and for a thresholded scan.
    moments : Moments
        Grey-weighted where there are grey values: denser bone counts more.
    surface : BodySurface
        Of the stapes.
    wall : BodySurface or None
        Of other bone near the stapes: what faces the footplate's rim across the ligament.
    plate : Surface or None
    plate_faces : tuple of PlaneFace
        Its plane faces, the largest first.
    evidence : mapping of str to JSON-able
        Levels, blur, noise, correlation, residual by place; for the report.
    notices : tuple of Notice
        Those of ``labelled`` first.
    """

    labelled: Labelled
    scene: Scene | None
    moments: Moments
    surface: BodySurface
    wall: BodySurface | None
    plate: Surface | None = None
    plate_faces: tuple[PlaneFace, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()

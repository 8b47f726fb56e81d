"""The plane face of the plate under the stapes: from the plate's surface, then as the grey values there ask.

Bone that stands on a plate, or sinks into its glue, leaves no air that would show where plastic ends. Its
plane does: plastic is subtracted as a known background there, whoever is nearer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ct_inertia.bodies import Labelled
from ct_inertia.frames.plate import PlaneFace
from ct_inertia.frames.plate_frame import MOST_SUNK
from ct_inertia.surface.contour import contour
from ct_inertia.surface.surface import Surface
from ct_inertia.voxels.fields import Grey, blur
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import EVERYWHERE, Mask, Slices
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from ct_inertia.grey.scene import SceneFit
    from ct_inertia.grey.start import Start

_LEAST_MM2 = 0.5  # of a plate's face: a fluid that is taken for a plate has smaller ones
_ABOUT_SIGMAS = 2.0  # widths of the blur around the plate's mask in which its body follows the plane
_LEAST_VOXELS = 100  # that show the plane next to the stapes
_CLEAR = 0.3  # share of the stapes in a voxel from which it says nothing about the plane


@dataclass(frozen=True)
class FacePlane:
    """A plane face of the plate on the grid of a scene's part.

    Attributes
    ----------
    normal : ndarray, (3,)
        Along z, y, x; unit in mm; from air into plastic.
    offset_mm : float
        The face is ``normal . r = offset``, r from the middle of voxel 0, 0, 0.
    spacing : ndarray, (3,)
        Edges of a voxel along z, y, x, mm.
    wets : bool
        Much of the stapes lies behind it: a fluid.
    sd_mm : float
        Standard deviation of its height by the noise of the grey values.
    """

    normal: Array
    offset_mm: float
    spacing: Array
    wets: bool = False
    sd_mm: float = 0.0

    @classmethod
    def of(
        cls, faces: Sequence[PlaneFace], stapes: Mask, plate: Mask, under: Mask, grid: Grid
    ) -> FacePlane | None:
        """Return the plane of the face that the stapes stands on, on a grid; None without one.

        A holder may have a larger face than that, as a wall beside it: the one is taken behind which most of
        what is plastic near the stapes lies, and least of what is not.

        Parameters
        ----------
        faces : sequence of PlaneFace
            In scan coordinates.
        stapes, plate, under : ndarray of bool, [z, y, x]
            On the grid; the last is near both.
        """
        axes = grid.scan_from_index[:3, :3] / grid.spacing_mm
        planes = []
        for face in faces:
            if face.area_mm2 >= _LEAST_MM2:
                offset = -float(face.normal @ (face.point_mm - grid.scan_from_index[:3, 3]))
                planes.append(cls(-(axes.T @ face.normal)[::-1], offset, grid.spacing_mm[::-1]))
        shown = under & ~stapes
        if not planes or not shown.any():
            return None
        told = [float(np.mean((one.depth(plate.shape) > 0.0)[shown] == plate[shown])) for one in planes]
        plastic = float(np.mean(plate[shown]))
        if max(told) <= max(plastic, 1.0 - plastic):  # no plane says more than one answer for all voxels
            return None
        plane = planes[int(np.argmax(told))]
        sunk = float(np.mean(plane.depth(stapes.shape)[stapes] > 0.0))
        return replace(plane, wets=sunk > MOST_SUNK)

    def depth(self, shape: tuple[int, ...], start: tuple[int, ...] = (0, 0, 0)) -> Grey:
        """Return the depth below the face, mm, positive in plastic, in a window that begins at ``start``."""
        z, y, x = (
            (np.arange(n) + first) * edge * part
            for n, first, edge, part in zip(shape, start, self.spacing, self.normal, strict=True)
        )
        return (z[:, None, None] + y[:, None] + x - self.offset_mm).astype(np.float32)

    def share(self, shape: tuple[int, ...], start: tuple[int, ...]) -> Grey:
        """Return the share of each voxel below the face."""
        depth = self.depth(shape, start) * np.float32(1.0 / self.spacing.mean())
        return np.clip(depth + np.float32(0.5), 0.0, 1.0)

    def refined(self, fit: SceneFit) -> FacePlane:
        """Move and tilt the plane by a step of Gauss and Newton to the least residual next to the stapes."""
        changes, basis, middle = self.changes(fit)
        shown = changes[0] > np.float32(1e-3 * float(changes[0].max()))
        clear = fit.start.near & shown & (fit.shares["stapes"] < np.float32(_CLEAR))
        rows = np.stack([change[clear] for change in changes]).astype(float)
        residual = fit.residual[clear].astype(float)
        squares = rows @ rows.T
        if rows.shape[1] < _LEAST_VOXELS or np.linalg.cond(squares) > 1e12:
            return self
        most = float(self.spacing.min())
        step = np.clip(np.linalg.solve(squares, rows @ residual), -most, most)
        normal = self.normal + basis.T @ step[1:]
        length = float(np.linalg.norm(normal))
        offset = self.offset_mm - step[0] + float(basis.T @ step[1:] @ middle)
        sd = fit.start.noise * float(np.sqrt(fit.start.correlation * np.linalg.inv(squares)[0, 0]))
        return replace(self, normal=normal / length, offset_mm=offset / length, sd_mm=sd)

    def changes(self, fit: SceneFit) -> tuple[list[Grey], Array, Array]:
        """Return how the plate's image changes with height and tilts of the plane.

        Three images [z, y, x], grey values per mm of height and per rad of two tilts; directions z, y, x
        (2, 3) along which the tilted plane rises; the point z, y, x (3,), mm, about which it tilts.

        Notes
        -----
        A height a + b u + c v of the face adds a layer of that thickness where no bone is, blurred.
        """
        edge = float(self.spacing.mean())
        places = np.flatnonzero(beside_stapes(fit.start))
        points = np.stack(np.unravel_index(places, fit.data.shape)) * self.spacing[:, None]
        at_face = np.abs(self.normal @ points - self.offset_mm) < 0.5 * edge
        places, points = places[at_face], points[:, at_face]
        bones = [fit.bodies[name].ravel()[places] for name in fit.names if name != "plate"]
        layer = (1.0 - np.maximum.reduce(bones)) * (fit.contrasts["plate"] / edge)
        basis = np.linalg.svd(self.normal[None])[2][1:]
        middle = points @ layer / max(float(layer.sum()), 1e-30)
        changes = []
        for height in (1.0, *(basis @ (points - middle[:, None]))):
            change = np.zeros(fit.data.shape, dtype=np.float32)
            change.ravel()[places] = layer * height
            changes.append(blur(change, fit.spread_mm2, self.spacing, fit.boxes["plate"]))
        return changes, basis, middle


def plate_surface(labelled: Labelled) -> Surface | None:
    """Return the surface of the plate, half way between plastic and what is around it."""
    region = labelled.plate_region
    if region is None:
        return None
    level = 0.0
    if labelled.plastic is not None and not labelled.box.is_mask and region.plastic != 1.0:
        middle = 0.5 * (region.air + labelled.plastic)
        level = (middle - region.air) / (region.plastic - region.air) - 0.5
    return contour(region.field, region.scan_from_index, level)


def beside_stapes(start: Start, box: Slices = EVERYWHERE) -> Mask:
    """Return where the plate's body follows its plane: near the stapes, and near the plate's own mask."""
    wide = np.float32(_ABOUT_SIGMAS * start.sigma_mm + 2.0 * start.spacing.max())
    return np.asarray(start.within_reach[box] & (start.distances["plate"][box] <= wide))

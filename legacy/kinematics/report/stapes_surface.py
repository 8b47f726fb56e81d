"""The scenery around the points: the surface of the stapes, its footplate, and the names of the axes."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

if TYPE_CHECKING:
    from legacy.kinematics.registration.scan_surfaces import ScanSurfaces
    from legacy.stapeskit.records.mass_record import MassRecord

Faces = NDArray[np.int64]
# Triangles of pictures: more are not seen at 700 pixels.
MOST_FACES = 24000
_OTHER = {"superior": "inferior", "inferior": "superior"}


@dataclass(frozen=True)
class Scenery:
    """A surface in the footplate frame.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray, (m, 3), int
        Outward triangles; both arrays are empty when no surface is known.
    outline_mm : ndarray, (k, 3)
        Outline of the medial face of the footplate; empty when not known.
    z_is : str
        ``superior``, ``inferior``, or empty when the side of the ear was not given.
    anterior_known : bool
        Whether a hint gave the sign of x.
    """

    vertices_mm: Array = field(default_factory=lambda: np.empty((0, 3)))
    faces: Faces = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))
    outline_mm: Array = field(default_factory=lambda: np.empty((0, 3)))
    z_is: str = ""
    anterior_known: bool = True

    @property
    def has_surface(self) -> bool:
        """Whether there is a surface to draw."""
        return len(self.faces) > 0

    def side(self, axis: str) -> str:
        """Return what a signed axis, such as ``+x`` or ``-z``, points to; empty when not known."""
        sign, name = axis[0], axis[1]
        if name == "y":
            return "lateral" if sign == "+" else "medial"
        if name == "x":
            return ("anterior" if sign == "+" else "posterior") if self.anterior_known else ""
        return self.z_is if sign == "+" else _OTHER.get(self.z_is, "")


def scenery_of(
    frames: Mapping[str, Any], frame: Mapping[str, Any], vertices_mm: Array, faces: Faces
) -> Scenery:
    """Build the scenery from parts of a mass.json and a surface in scan coordinates.

    Parameters
    ----------
    frames, frame : mapping
        ``frames`` and ``frame`` of mass.json.
    vertices_mm : ndarray, (n, 3)
        Scan coordinates, mm.
    faces : ndarray, (m, 3), int
        More than MOST_FACES are merged.
    """
    vertices_mm, faces = coarse(
        np.asarray(vertices_mm, dtype=float), np.asarray(faces, dtype=np.int64), MOST_FACES
    )
    matrix = np.asarray(frames["scan_from_footplate"], dtype=float)
    placed = (vertices_mm - matrix[:3, 3]) @ matrix[:3, :3]
    outline = np.asarray(frame.get("footplate_outline_in_footplate_mm") or np.empty((0, 3)), dtype=float)
    z_is = str(frames.get("z_is", ""))
    return Scenery(
        placed,
        faces,
        outline if outline.ndim == 2 and outline.shape[1] == 3 else np.empty((0, 3)),
        z_is if z_is in _OTHER else "",
        bool(frames.get("anterior_from", True)),
    )


def scenery_of_scan(mass: MassRecord, surfaces: ScanSurfaces | None) -> Scenery:
    """Build the scenery from a mass record and the surfaces of its scan, when there are any.

    Raises
    ------
    KinematicsError
        The surface of the stapes cannot be read.
    """
    stapes = None if surfaces is None else surfaces.mesh("stapes")
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    if stapes is not None:
        vertices, faces = stapes.vertices_mm, stapes.faces
    return scenery_of(mass.raw["frames"], mass.raw.get("found", {}), vertices, faces)


def coarse(vertices_mm: Array, faces: Faces, most: int) -> tuple[Array, Faces]:
    """Return a surface of at most ``most`` triangles with the same shape as far as these can show it.

    Notes
    -----
    Vertices that share a cell of a grid become their mean, triangles that lose a corner vanish (Rossignac
    and Borrel 1993, doi:10.1007/978-3-642-78114-8_29); the cell grows until few enough are left.
    """
    if len(faces) <= most:
        return vertices_mm, faces
    low = vertices_mm.min(axis=0)
    edges = vertices_mm[faces[:, 1]] - vertices_mm[faces[:, 0]]
    cell = max(0.8 * float(np.mean(np.linalg.norm(edges, axis=1))) * np.sqrt(len(faces) / most), 1e-9)
    while True:
        index = np.floor((vertices_mm - low) / cell).astype(np.int64)
        size = index.max(axis=0) + 1
        _, owner = np.unique(
            (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], return_inverse=True
        )
        few = owner.reshape(-1)[faces]
        keep = (few[:, 0] != few[:, 1]) & (few[:, 1] != few[:, 2]) & (few[:, 0] != few[:, 2])
        few = np.unique(_turn(few[keep]), axis=0)
        if len(few) <= most:
            number = np.bincount(owner.reshape(-1))
            mean = [np.bincount(owner.reshape(-1), vertices_mm[:, k]) / number for k in range(3)]
            return np.column_stack(mean), few
        cell *= 1.08


def _turn(faces: Faces) -> Faces:
    """Return every triangle with its smallest corner first, in the same sense."""
    first = np.argmin(faces, axis=1)
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)


def packed(values: NDArray[Any]) -> str:
    """Return the bytes of an array as text of a page (base64)."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def packed_mesh(vertices_mm: Array, faces: Faces, most: int) -> dict[str, Any]:
    """Return a surface of at most ``most`` triangles for a page: coordinates in 16 bits of the span."""
    vertices, faces = coarse(vertices_mm, faces, min(most, 60000))
    used, renamed = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    low = vertices.min(axis=0)
    step = float(np.max(np.ptp(vertices, axis=0))) / 32000.0
    return {
        "vertices": packed(np.round((vertices - low) / step).astype("<i2")),
        "faces": packed(renamed.reshape(faces.shape).astype("<u2")),
        "low": np.round(low, 6).tolist(),
        "step": step,
    }

"""A closed surface in scan coordinates: its moments, area and holes, and how it is written."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Moments
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from pyvista import PolyData

Faces = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Cap:
    """What closed a hole of a mesh.

    Attributes
    ----------
    middle_mm : ndarray, (3,)
        Scan coordinates.
    width_mm : float
        Diameter of a disc of its area.
    steep_deg : float
        Mean angle to the surface around it: 0 where that goes on flat, 90 where it is cut off.
    dome_mm3 : float
        What a surface that bends on evenly would add.
    """

    middle_mm: Array
    width_mm: float
    steep_deg: float
    dome_mm3: float

    def __str__(self) -> str:
        place = ", ".join(f"{value:.3f}" for value in self.middle_mm)
        return f"at {place} mm, {self.width_mm:.2g} mm wide, {self.steep_deg:.0f} degrees from flat"


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of a closed surface.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
        Scan coordinates.
    faces : ndarray of int, (m, 3)
        Corners, counter-clockwise seen from outside.
    on_border : ndarray of bool, (n,), or None
        Vertices where it is not the body that ends but the scan; None: nowhere.
    caps : tuple of Cap
        What closed the holes of the file that it came from.
    notices : tuple of Notice
        What was mended in that file.
    """

    vertices_mm: Array
    faces: Faces
    on_border: NDArray[np.bool_] | None = None
    caps: tuple[Cap, ...] = ()
    notices: tuple[Notice, ...] = ()

    def __repr__(self) -> str:
        return f"Surface({len(self.faces)} faces, {self.moments().volume_mm3:.4g} mm3)"

    @cached_property
    def area_vectors_mm2(self) -> Array:
        """Half the cross product of the edges of every face, (m, 3), outward."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @property
    def area_mm2(self) -> float:
        """Area of the surface."""
        return float(np.linalg.norm(self.area_vectors_mm2, axis=1).sum())

    @cached_property
    def centres_mm(self) -> Array:
        """Centres of the faces, (m, 3)."""
        return np.asarray(self.vertices_mm[self.faces].mean(axis=1))

    @property
    def holes(self) -> int:
        """Genus of a surface of one piece: 1 for a stapes."""
        edges = 3 * len(self.faces) // 2
        return (2 - (len(self.vertices_mm) - edges + len(self.faces))) // 2

    def moments(self) -> Moments:
        """Return volume, centroid and second moments of what it encloses; closed holes are in ``border``.

        Raises
        ------
        StapeskitError
            It encloses no positive volume.
        """
        moments = Moments(*enclosed_moments(self.vertices_mm, self.faces))
        for cap in self.caps:
            moments = moments.with_lump("border", cap.middle_mm, cap.dome_mm3)
        return moments

    def mesh(self) -> PolyData:
        """Return the surface as a mesh of pyvista, mm."""
        return as_mesh(self.vertices_mm, self.faces)

    def write(self, path: Path) -> None:
        """Write the surface in mm as STL, PLY, OBJ or GLB, by its suffix."""
        path = Path(path)
        if path.suffix.lower() == ".ply":
            path.write_bytes(_ply(self))
            return
        import trimesh

        mesh = trimesh.Trimesh(self.vertices_mm, self.faces, process=False)
        mesh.units = "mm"
        mesh.export(path)


def as_mesh(points: Array, faces: NDArray[np.integer]) -> PolyData:
    """Return points (n, 3) and triangles (m, 3) as a mesh of pyvista."""
    import pyvista as pv

    corners: Any = faces
    return pv.PolyData.from_regular_faces(points, corners)


def chosen_part(points: Array, faces: Faces, kept: NDArray[np.bool_]) -> tuple[Array, Faces]:
    """Return some of the faces (m, 3), and the points (n, 3) that they use."""
    faces = faces[kept]
    used = np.zeros(len(points), dtype=bool)
    used[faces] = True
    return points[used], np.asarray((np.cumsum(used) - 1)[faces], dtype=np.int64)


def enclosed_moments(vertices: Array, faces: Faces) -> tuple[float, Array, Array]:
    """Return volume, centroid (3,) and second moments about it (3, 3) inside closed faces; any unit.

    Notes
    -----
    Sum over the tetrahedra of each face with a point near the body (Tonon 2004, J. Math. Stat. 1:8,
    doi:10.3844/jmssp.2005.8.11), so that a body far from the origin loses no digits.
    """
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    a, b, c = (vertices[faces[:, k]] - centre for k in range(3))
    six = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = a + b + c
    volume = float(six.sum() / 6.0)
    second = (total * six[:, None]).T @ total
    for corner in (a, b, c):
        second += (corner * six[:, None]).T @ corner
    centroid = six @ total / (24.0 * volume if volume else 1.0)
    return volume, centre + centroid, second / 120.0 - volume * np.outer(centroid, centroid)


def _ply(surface: Surface) -> bytes:
    """Return the surface as PLY in double precision, which trimesh does not write."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment scan coordinates, mm, normals outward\nelement "
        f"vertex {len(surface.vertices_mm)}\nproperty double x\nproperty double y\nproperty double "
        f"z\nelement face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(surface.faces), dtype=[("n", "u1"), ("corner", "<i4", (3,))])
    rows["n"] = 3
    rows["corner"] = surface.faces
    return header.encode() + surface.vertices_mm.astype("<f8").tobytes() + rows.tobytes()

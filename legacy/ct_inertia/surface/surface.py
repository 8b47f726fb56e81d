"""Closed outward triangle surfaces in scan coordinates, their exact moments, and their files."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.surface.glb_checks import check_glb
from legacy.ct_inertia.surface.moments import Moments
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

SURFACE_SUFFIXES = (".stl", ".ply", ".obj", ".glb")


@dataclass(frozen=True)
class Surface:
    """A closed triangle surface whose normals point outward.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
        Corners (x, y, z) in scan coordinates, mm.
    faces : ndarray of int, (m, 3)
        Corners of each triangle, counter-clockwise seen from outside.
    notices : tuple of Notice
        What had to be put right on reading.

    Raises
    ------
    CtInertiaError
        The surface is empty, has an index or a number that does not exist, is open, is inconsistently
        oriented, or encloses a volume that is not positive (inward normals).

    Notes
    -----
    Closed means here what the divergence theorem needs: every edge is walked as often in one direction as
    in the other. A surface that touches itself along an edge is therefore closed.
    """

    vertices_mm: Array
    faces: NDArray[np.int64]
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_mm, dtype=float)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        _check_arrays(vertices, faces)
        object.__setattr__(self, "vertices_mm", vertices)
        object.__setattr__(self, "faces", faces)
        open_edges = count_open_edges(faces)
        if open_edges:
            raise CtInertiaError.of(
                "the surface",
                "closed and consistently oriented",
                f"{open_edges} edges without a partner",
                next_step="Close its holes (for example with a solid fill in the program that made it)",
            )
        volume = self.volume_mm3
        if not volume > 0.0:
            raise CtInertiaError.of(
                "the surface",
                "oriented outward around a positive volume",
                f"{volume:g} mm3",
                next_step="Turn its normals outward",
            )

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume, mm3."""
        return enclosed_volume(self.vertices_mm, self.faces)

    @property
    def area_mm2(self) -> float:
        """Area of the surface, mm2."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @property
    def euler_characteristic(self) -> int:
        """V - E + F; 0 for one body with one hole (a stapes), 2 for one without."""
        used = int(np.count_nonzero(np.bincount(self.faces.ravel())))
        start, end = self.faces.ravel(), self.faces[:, [1, 2, 0]].ravel()
        # Closed: every edge is walked upwards as often as downwards, so that one direction tells all.
        up = start < end
        keys = np.sort(start[up] * np.int64(len(self.vertices_mm)) + end[up])
        edges = 1 + int(np.count_nonzero(keys[1:] != keys[:-1]))
        return used - edges + len(self.faces)

    def moments(self) -> Moments:
        """Return the exact moments of the enclosed polyhedron in scan coordinates.

        Notes
        -----
        Sum over the tetrahedra of each face with a point near the centroid, in the closed form of a
        tetrahedron's moments (Tonon 2004, J. Math. Stat. 1:8, doi:10.3844/jmssp.2005.8.11). The point is
        taken near the body first, so that a body far from the origin loses no digits.
        """
        volume, centroid, second = enclosed_moments(self.vertices_mm, self.faces)
        return Moments(volume, centroid, second)


def enclosed_moments(vertices: Array, faces: NDArray[np.integer]) -> tuple[float, Array, Array]:
    """Return volume, centroid (3,) and second moments about it (3, 3) inside closed faces; any unit."""
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    a, b, c = (vertices[faces[:, k]] - centre for k in range(3))
    six = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = a + b + c
    volume = float(six.sum() / 6.0)
    first = six @ total / 24.0
    second = (total * six[:, None]).T @ total
    for corner in (a, b, c):
        second += (corner * six[:, None]).T @ corner
    second /= 120.0
    centroid = first / volume
    return volume, centre + centroid, second - volume * np.outer(centroid, centroid)


def enclosed_volume(vertices_mm: Array, faces: NDArray[np.integer]) -> float:
    """Return the signed volume inside faces (m, 3) over vertices (n, 3), mm3; negative when inward.

    Notes
    -----
    By the divergence theorem: the area of every face seen along z times its mean height.
    """
    x, y, z = (np.ascontiguousarray(row - 0.5 * (row.min() + row.max())) for row in vertices_mm.T)
    a, b, c = (np.ascontiguousarray(column) for column in faces.T)
    xa, ya = x[a], y[a]
    double = (x[b] - xa) * (y[c] - ya) - (x[c] - xa) * (y[b] - ya)
    return float(double @ (z[a] + z[b] + z[c]) / 6.0)


def count_open_edges(faces: NDArray[np.int64]) -> int:
    """Return how many edges are walked more often in one direction than in the other."""
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    forward = start < end
    size = np.int64(faces.max()) + 1
    ahead, back = start[forward] * size + end[forward], end[~forward] * size + start[~forward]
    if len(ahead) == len(back):
        ahead.sort()
        back.sort()
        if np.array_equal(ahead, back):
            return 0
    keys, sign = np.concatenate([ahead, back]), np.repeat([1, -1], [len(ahead), len(back)])
    _, place = np.unique(keys, return_inverse=True)
    return int(np.count_nonzero(np.bincount(place, sign)))


def read_surface(path: Path | str) -> Surface:
    """Read a closed surface from STL, PLY, OBJ or GLB; its numbers are taken as mm in scan coordinates.

    Corners that coincide exactly are joined (an STL stores each triangle alone), triangles without area
    in the index sense are dropped, and a surface oriented inward is turned, with a notice.

    Raises
    ------
    CtInertiaError
        The file does not exist, is no such file, is empty, or its surface is open.
    """
    path = Path(path)
    if not path.is_file():
        raise CtInertiaError.of("the surface", "an existing file", path, next_step="Check the path")
    if path.suffix.lower() not in SURFACE_SUFFIXES:
        raise CtInertiaError.of(
            "the surface", "a STL, PLY, OBJ or GLB file", path.name, next_step="Use one of these formats"
        )
    vertices, faces = _load(path)
    if len(faces) == 0:
        raise CtInertiaError.of(
            "the surface",
            "a mesh with triangles",
            f"{len(vertices)} points without any",
            path.name,
            next_step="Export the surface again, as triangles",
        )
    notices: list[Notice] = []
    try:
        _check_arrays(vertices, faces)
        vertices, faces = _join(vertices, faces)
        if len(faces) and count_open_edges(faces) == 0 and enclosed_volume(vertices, faces) < 0.0:
            faces = np.ascontiguousarray(faces[:, ::-1])
            notices.append(
                Notice("surface_turned", f"{path.name} was oriented inward; its faces were turned outward.")
            )
        return Surface(vertices, faces, tuple(notices))
    except CtInertiaError as fault:
        raise CtInertiaError(
            *(replace(part, where=part.where or path.name) for part in fault.faults)
        ) from None


def write_surface(path: Path | str, surface: Surface) -> None:
    """Write a surface in mm; PLY in double precision, other formats (STL, OBJ, GLB) by trimesh.

    Raises
    ------
    CtInertiaError
        The suffix is none of STL, PLY, OBJ, GLB.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SURFACE_SUFFIXES:
        raise CtInertiaError.of(
            "the surface file", "a STL, PLY, OBJ or GLB file", path.name, next_step="Use one of these formats"
        )
    if suffix == ".ply":
        path.write_bytes(_ply_bytes(surface))
        return
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices_mm, surface.faces, process=False)
    mesh.units = "mm"
    mesh.export(path)


def _check_arrays(vertices: Array, faces: NDArray[np.int64]) -> None:
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
        raise CtInertiaError.of(
            "the surface",
            "vertices (n, 3) and faces (m, 3)",
            f"{vertices.shape} and {faces.shape}",
            next_step="Export the surface again, as triangles",
        )
    if len(vertices) == 0 or len(faces) == 0:
        raise CtInertiaError.of(
            "the surface",
            "a mesh with triangles",
            f"{len(vertices)} points, {len(faces)} faces",
            next_step="Export the surface again, as triangles",
        )
    if not np.all(np.isfinite(vertices)):
        raise CtInertiaError.of(
            "the corners of the surface", "finite", "NaN or infinity", next_step="Export the surface again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise CtInertiaError.of(
            "the faces of the surface",
            f"indices below {len(vertices)}",
            int(faces.max()),
            next_step="Export the surface again",
        )


def _load(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """Read corners and triangles; files that a mesh names (materials, textures, buffers) stay closed."""
    import trimesh

    kind = path.suffix[1:].lower()
    try:
        content = path.read_bytes()
        if kind == "glb":
            check_glb(content)
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
        faces = np.asarray(getattr(mesh, "faces", []), dtype=np.int64).reshape(-1, 3)
    except Exception as fault:
        why = f"{type(fault).__name__}: {fault}"
        raise CtInertiaError.of(
            "the surface",
            f"a readable {kind.upper()} file with triangles",
            why if len(why) <= 200 else f"{why[:200]}...",
            path.name,
            "Export it again",
        ) from fault
    return vertices, faces


def _join(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    unique, place = np.unique(vertices, axis=0, return_inverse=True)
    faces = place.reshape(-1)[faces]
    a, b, c = faces.T
    return unique, np.ascontiguousarray(faces[(a != b) & (b != c) & (c != a)])


def _ply_bytes(surface: Surface) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment scan coordinates, mm, normals outward\n"
        f"element vertex {len(surface.vertices_mm)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(surface.faces), dtype=[("n", "u1"), ("corner", "<i4", (3,))])
    rows["n"] = 3
    rows["corner"] = surface.faces
    return header.encode() + surface.vertices_mm.astype("<f8").tobytes() + rows.tobytes()

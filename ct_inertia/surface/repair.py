"""Read meshes that people bring, in a child process; mend them, and close their holes on request.

What is mended is reported; a hole is closed only when that is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError
from stapeskit.sandbox import memory_limit, read_apart
from stapeskit.warnings import Notice

MESH_SUFFIXES = (".stl", ".ply", ".obj", ".glb")

Faces = NDArray[np.int64]

_SAME_CORNER = 1e-6  # of the mesh's diagonal: single precision of an STL far from its origin
_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes of a binary STL file
_MEMORY = 2 << 30  # bytes for the child: pymeshlab and its copies of a mesh of some million faces


@dataclass(frozen=True)
class MendedMesh:
    """A closed mesh with outward faces.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray of int, (m, 3)
        Corners, counter-clockwise seen from outside.
    notices : tuple of Notice
        What was mended.
    """

    vertices_mm: Array
    faces: Faces
    notices: tuple[Notice, ...] = ()


def read_mesh(path: Path | str, close: bool = False) -> MendedMesh:
    """Read a closed mesh from STL, PLY, OBJ or GLB; its numbers are taken as mm in scan coordinates.

    Parameters
    ----------
    path : Path or str
    close : bool
        Close its holes; a mesh of open pieces is replaced by where its winding number passes one half.

    Raises
    ------
    StapeskitError
        The file is missing, no such mesh or empty, or the mesh is open and ``close`` was not asked for.
    """
    path = Path(path)
    if not path.is_file():
        raise StapeskitError.of("the surface", "an existing file", path, next_step="Check the path")
    if path.suffix.lower() not in MESH_SUFFIXES:
        step = "Use one of these formats"
        raise StapeskitError.of("the surface", "a STL, PLY, OBJ or GLB file", path.name, next_step=step)

    def read() -> MendedMesh:
        vertices, faces = _load(path)
        return mend(vertices, faces, path.name, close)

    memory = max(memory_limit(path), _MEMORY)
    limit_s = 30.0 + (200.0 if close else 10.0) * path.stat().st_size / 1e8
    return read_apart(read, path, "the surface", limit_s, memory, ("trimesh", "scipy.spatial"))


def _load(path: Path) -> tuple[Array, Faces]:
    """Return corners and triangles as the file has them; scenes are joined with their transformations."""
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False, maintain_order=True)
        if not len(mesh.faces):
            _check_stl_count(path)
        return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    except (MemoryError, StapeskitError):
        raise
    except Exception as fault:
        got = "one that trimesh cannot read"
        raise StapeskitError.of(
            "the surface", "a mesh with triangles", got, path.name, "Export it again"
        ) from fault


def _check_stl_count(path: Path) -> None:
    """Refuse a binary STL file whose header counts other triangles than the file holds.

    Raises
    ------
    StapeskitError
        Both numbers.
    """
    size = path.stat().st_size
    if path.suffix.lower() != ".stl" or size < _STL_HEADER + _STL_TRIANGLE:
        return
    with path.open("rb") as stream:
        counted = int.from_bytes(stream.read(_STL_HEADER)[80:], "little")
    held = (size - _STL_HEADER) / _STL_TRIANGLE
    if held != counted:
        wanted, got = f"one with the {counted} triangles that its header counts", f"{held:.6g} of them"
        raise StapeskitError.of("the STL file", wanted, got, path.name, "Copy or export it again")


def mend(vertices: Array, faces: Faces, name: str, close: bool = False) -> MendedMesh:
    """Join corners, drop doubled faces, turn faces that are wound the other way, and close holes when asked.

    Parameters
    ----------
    vertices : ndarray, (n, 3)
        mm.
    faces : ndarray of int, (m, 3)
    name : str
        Of the file.
    close : bool

    Raises
    ------
    StapeskitError
        No triangles, corners that are no numbers, or an open mesh.
    """
    _check_arrays(vertices, faces, name)
    vertices, faces, notices = _joined(vertices, faces, name)
    faces, doubled = _without_doubles(faces)
    if doubled:
        notices.append(
            Notice("file_read", f"{doubled} faces of {name} were there twice; one of each is kept.")
        )
    holes = boundary_edges(faces)
    if len(holes) and not close:
        raise StapeskitError(_open_fault(vertices, holes, faces, name))
    if len(holes):
        vertices, faces, how = _closed(vertices, faces, name)
        text = f"{name} was open at {len(holes)} edges, and {how} (--close). Look at the surface."
        notices.append(Notice("holes_closed", text))
    faces, turned = _oriented(vertices, faces, name)
    if turned:
        text = f"{turned} of {len(faces)} faces of {name} were wound the other way; they were turned outward."
        notices.append(Notice("file_read", text))
    solid = [piece for piece in pieces(faces) if signed_volume(vertices, faces[piece]) > 0.0]
    if len(solid) > 1:
        text = (
            f"{name} holds {len(solid)} separate bodies: they are added, and count twice where they overlap."
        )
        notices.append(Notice("mesh_in_pieces", text))
    return MendedMesh(vertices, faces, tuple(notices))


def _check_arrays(vertices: Array, faces: Faces, name: str) -> None:
    good = vertices.ndim == 2 and vertices.shape[1:] == (3,) and faces.ndim == 2 and faces.shape[1:] == (3,)
    if not good or not len(vertices) or not len(faces):
        got = f"{len(vertices)} points and {len(faces)} faces"
        step = "Export the surface again, as triangles"
        raise StapeskitError.of("the surface", "a mesh with triangles", got, name, step)
    if not np.all(np.isfinite(vertices)) or faces.min() < 0 or faces.max() >= len(vertices):
        got = "NaN, infinity or a corner that does not exist"
        raise StapeskitError.of("the corners of the surface", "finite numbers", got, name, "Export it again")


def _joined(vertices: Array, faces: Faces, name: str) -> tuple[Array, Faces, list[Notice]]:
    """Join corners that coincide, and those that differ by rounding, and drop faces without three corners."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    vertices, place = np.unique(vertices, axis=0, return_inverse=True)
    faces = place.reshape(-1)[faces]
    notices = []
    reach = _SAME_CORNER * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    pairs = cKDTree(vertices).query_pairs(reach, output_type="ndarray")
    if len(pairs):
        count = len(vertices)
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        joined, group = connected_components(links, directed=False)
        share = np.bincount(group)
        vertices = np.column_stack([np.bincount(group, column) / share for column in vertices.T])
        faces = group[faces].astype(np.int64)
        text = f"{count - joined} corners of {name} lay within {reach:.3g} mm of others and were joined."
        notices.append(Notice("file_read", text))
    three = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices, np.asarray(faces[three], dtype=np.int64), notices


def _without_doubles(faces: Faces) -> tuple[Faces, int]:
    """Drop doubled faces; keep one of each, unless the mesh is as closed without both of a pair.

    Notes
    -----
    Two bodies that touch share faces of opposite sense, which cancel; one of them would close a hole that is
    none.
    """
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    if np.all(count == 1):
        return faces, 0
    kept = faces[np.sort(first)]
    alone = faces[np.sort(first[count % 2 == 1])]
    if len(alone) and len(boundary_edges(alone)) < len(boundary_edges(kept)):
        kept = alone
    return kept, len(faces) - len(kept)


def boundary_edges(faces: Faces) -> Faces:
    """Return the edges (k, 2), as their face walks them, that an odd number of faces have: rims of holes."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(edges[first[count % 2 == 1]])


def _open_fault(vertices: Array, holes: Faces, faces: Faces, name: str) -> Fault:
    """Return the fault of an open mesh: how many holes, and where the largest lie."""
    loops = _split(_groups(holes, len(vertices))[holes[:, 0]])
    places = []
    for loop in loops[:3]:
        corners = vertices[np.unique(holes[loop])]
        centre, width = corners.mean(axis=0), float(np.linalg.norm(np.ptp(corners, axis=0)))
        places.append(f"{width:.3g} mm wide at {', '.join(f'{value:.3f}' for value in centre)} mm")
    more = f" and {len(loops) - 3} more" if len(loops) > 3 else ""
    holes_in_words = f"{len(loops)} hole{'s' if len(loops) > 1 else ''} ({'; '.join(places)}{more})"
    step = "Close them in the program that made the surface (a solid fill), or let --close do it"
    return Fault("the surface", "closed", f"{holes_in_words} in {len(faces)} faces", name, step)


def _groups(edges: Faces, count: int) -> NDArray[np.intp]:
    """Return for each of so many corners the number of the connected piece that edges (k, 2) join it to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.intp)


def _split(group: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the places of each value, the most frequent first."""
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    return sorted(parts, key=len, reverse=True)


def pieces(faces: Faces) -> list[NDArray[np.intp]]:
    """Return the faces of each connected piece, the largest first."""
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    return _split(_groups(edges, int(faces.max()) + 1)[faces[:, 0]])


def _closed(vertices: Array, faces: Faces, name: str) -> tuple[Array, Faces, str]:
    """Close an open mesh, and say how: holes of one piece are filled, several open pieces wound around."""
    from ct_inertia.surface.meshlab import filled
    from ct_inertia.surface.winding import winding_surface

    if sum(len(boundary_edges(faces[piece])) > 0 for piece in pieces(faces)) == 1:
        mesh = filled(vertices, faces)
        if mesh is not None and not len(boundary_edges(mesh[1])):
            return *mesh, "its holes were filled"
    vertices, faces, step_mm = winding_surface(vertices, faces, name)
    grid = f"a grid of {step_mm:.2g} mm"
    how = f"its open pieces were replaced by the surface of winding number one half on {grid}"
    return vertices, faces, how


def _oriented(vertices: Array, faces: Faces, name: str) -> tuple[Faces, int]:
    """Wind all faces of a closed mesh alike, each piece as most of its faces were, and the whole outward."""
    turned = np.zeros(len(faces), dtype=bool)
    if open_walks(faces):
        coherent = _coherent(vertices, faces)
        turned = np.any(coherent != faces, axis=1)
        for piece in pieces(faces):
            if 2 * np.count_nonzero(turned[piece]) > len(piece):
                turned[piece] = ~turned[piece]
        faces = np.where(turned[:, None], faces[:, ::-1], faces)
        if open_walks(faces):
            got = f"{open_walks(faces)} edges at which faces cannot be wound alike"
            step = "Export it again as one closed surface (a solid fill)"
            raise StapeskitError.of("the surface", "closed and orientable", got, name, step)
    volume = signed_volume(vertices, faces)
    if volume < 0.0:
        faces, turned = faces[:, ::-1], ~turned
    if not abs(volume) > 0.0:
        raise StapeskitError.of("the surface", "one that encloses a volume", "0 mm3", name, "Export it again")
    return np.ascontiguousarray(faces), int(np.count_nonzero(turned))


def _coherent(vertices: Array, faces: Faces) -> Faces:
    """Return the faces with neighbours wound alike, by a walk over each piece."""
    from ct_inertia.surface.surface import as_mesh

    mesh = as_mesh(vertices, faces).compute_normals(
        cell_normals=True, point_normals=False, split_vertices=False, consistent_normals=True
    )
    found = np.asarray(mesh.regular_faces, dtype=np.int64)
    # A turned face may begin at another corner: only the sense counts.
    first = np.argmax(found == faces[:, :1], axis=1)
    same = np.take_along_axis(found, (first[:, None] + 1) % 3, axis=1)[:, 0] == faces[:, 1]
    return np.where(same[:, None], faces, faces[:, ::-1])


def open_walks(faces: Faces) -> int:
    """Return how many edges are walked more often in one direction: 0 for a closed surface."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    sense = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(place.reshape(-1), sense)))


def signed_volume(vertices: Array, faces: Faces) -> float:
    """Return the volume inside faces, mm3, negative when wound inward (divergence theorem)."""
    centred = vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    a, b, c = (centred[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

"""Read meshes that people bring, in a child process; mend them, and close their holes on request.

What is mended is reported; a hole is closed only when that is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.surface.fields import unit
from ct_inertia.surface.surface import Cap, Faces, Surface, as_mesh, enclosed_moments
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.sandbox import memory_limit, read_apart
from stapeskit.warnings import Notice

MESH_SUFFIXES = (".stl", ".ply", ".obj", ".glb")

_SAME_CORNER = 1e-6  # of the mesh's diagonal: single precision of an STL far from its origin
_MEMORY = 2 << 30  # bytes for the child: pymeshlab and its copies of a mesh of some million faces
_LARGEST_HOLE = 1 << 20  # edges: every hole
_STEEPEST_DEG = 60.0  # at the rim of a hole: the dome of a sphere over it is then .58 of its radius high
_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes of a binary STL, which counts its triangles in the last four


def read_mesh(path: Path | str, close: bool = False) -> Surface:
    """Read a closed mesh from STL, PLY, OBJ or GLB; its numbers are taken as mm in scan coordinates.

    ``close`` fills holes, and replaces several open pieces by where their winding number passes one half.

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

    def read() -> Surface:
        import trimesh

        try:
            mesh: Any = trimesh.load(path, force="mesh", process=False, maintain_order=True)
            vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
            if not len(faces):
                _check_stl_count(path)
        except (MemoryError, StapeskitError):
            raise
        except Exception as fault:
            raise _not_read("one that trimesh cannot read", path.name) from fault
        return mend(vertices, faces, path.name, close)

    memory = max(memory_limit(path), _MEMORY)
    limit_s = 30.0 + (200.0 if close else 10.0) * path.stat().st_size / 1e8
    return read_apart(read, path, "the surface", limit_s, memory, ("trimesh", "scipy.spatial"))


def _not_read(got: str, name: str) -> StapeskitError:
    step = "Copy or export it again, as triangles"
    return StapeskitError.of("the surface", "a mesh with triangles", got, name, step)


def _check_stl_count(path: Path) -> None:
    """Refuse a binary STL whose header counts other triangles than it holds; trimesh finds none in it."""
    size = path.stat().st_size
    if path.suffix.lower() != ".stl" or size < _STL_HEADER + _STL_TRIANGLE:
        return
    with path.open("rb") as stream:
        counted = int.from_bytes(stream.read(_STL_HEADER)[80:], "little")
    held = (size - _STL_HEADER) / _STL_TRIANGLE
    if held != counted < 1 << 24:  # beyond, it is text
        wanted, got = f"one with the {counted} triangles that its header counts", f"{held:.6g} of them"
        raise StapeskitError.of("the STL file", wanted, got, path.name, "Copy or export it again")


def mend(vertices: Array, faces: Faces, name: str, close: bool = False) -> Surface:
    """Join corners, drop doubled faces, turn faces that are wound the other way, and close holes when asked.

    Takes vertices (n, 3), mm, and faces (m, 3) of a file; notices of the surface say what was mended.

    Raises
    ------
    StapeskitError
        No triangles, corners that are no numbers, or an open mesh.
    """
    if not len(faces):
        raise _not_read(f"{len(vertices)} points and no faces", name)
    if not np.all(np.isfinite(vertices)) or faces.min() < 0 or faces.max() >= len(vertices):
        raise _not_read("NaN, infinity or a corner that does not exist", name)
    texts = []
    vertices, faces, joined = _joined(vertices, faces)
    if joined:
        texts.append(f"{joined} corners of {name} lay next to others and were joined.")
    faces, doubled = _without_doubles(faces)
    if doubled:
        texts.append(f"{doubled} faces of {name} were there twice; one of each is kept.")
    caps: tuple[Cap, ...] = ()
    if len(boundary_edges(faces)):
        where = _holes(vertices, faces)
        if not close:
            step = "Close them in the program that made the surface (a solid fill), or let --close do it"
            raise StapeskitError.of("the surface", "closed", f"{where} in {len(faces)} faces", name, step)
        vertices, faces, caps, how = _closed(vertices, faces, name)
        texts.append(
            f"{name} had {where}; {how} (--close). The budget holds what may be missing: look at the surface."
        )
    faces, turned = _oriented(vertices, faces, name)
    if turned:
        texts.append(f"{turned} of {len(faces)} faces of {name} were wound the other way; they were turned.")
    notices = (Notice("file_read", " ".join(texts)),) if texts else ()
    return Surface(vertices, faces, caps=caps, notices=notices)


def _joined(vertices: Array, faces: Faces) -> tuple[Array, Faces, int]:
    """Join corners that coincide and those that differ by rounding, which are counted; drop empty faces.

    Corners without a face are left out: they would count to the size of the body.
    """
    from scipy.spatial import cKDTree

    used, numbers = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], numbers.reshape(-1, 3)
    vertices, place = np.unique(vertices, axis=0, return_inverse=True)
    reach = _SAME_CORNER * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    group = _groups(cKDTree(vertices).query_pairs(reach, output_type="ndarray"), len(vertices))
    share = np.bincount(group)
    faces = group[place.reshape(-1)[faces]].astype(np.int64)
    joined = np.column_stack([np.bincount(group, column) / share for column in vertices.T])
    three = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return joined, faces[three], len(vertices) - len(joined)


def _without_doubles(faces: Faces) -> tuple[Faces, int]:
    """Drop doubled faces; keep one of each, unless the mesh is as closed without both of a pair.

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
    edges = _edges(faces)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(edges[first[count % 2 == 1]])


def _edges(faces: Faces) -> Faces:
    """Return the three edges of each face as it walks them, (3 m, 2)."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _closed(vertices: Array, faces: Faces, name: str) -> tuple[Array, Faces, tuple[Cap, ...], str]:
    """Close an open mesh and say how; refuse where nothing shows how much of the body is missing.

    Open pieces that are filled one by one would count twice where they overlap.
    """
    from ct_inertia.surface.winding import winding_surface

    step = "Close it in the program that made it, where what is missing is known"
    if sum(len(boundary_edges(faces[piece])) > 0 for piece in pieces(faces)) > 1:
        made = winding_surface(vertices, faces, name)
        how = "its pieces were replaced by the surface of winding number one half"
        return made.vertices_mm, made.faces, made.caps, how
    vertices, faces, new = _filled(vertices, faces)
    if not new.any() or len(boundary_edges(faces)):
        got = "holes that pymeshlab cannot fill"
        raise StapeskitError.of("the surface", "one that --close can close", got, name, step)
    caps = tuple(_caps(vertices, _oriented(vertices, faces, name)[0], new))
    cut = [str(cap) for cap in caps if cap.steep_deg > _STEEPEST_DEG]
    if cut:
        expected = f"within {_STEEPEST_DEG:g} degrees of flat where --close closes a hole"
        raise StapeskitError.of("the surface", expected, f"a body cut off {' and '.join(cut)}", name, step)
    return vertices, faces, caps, "they were filled"


def _filled(vertices: Array, faces: Faces) -> tuple[Array, Faces, NDArray[np.bool_]]:
    """Fill the holes of a mesh as far as pymeshlab can; return which faces (m,) are new, too."""
    try:  # on some machines it has no wheel or misses a graphics library
        import pymeshlab
    except (ImportError, OSError) as fault:
        step = "Run pip install pymeshlab (on Debian also apt-get install libgl1 libopengl0)"
        raise StapeskitError.of("--close", "used where pymeshlab works", fault, next_step=step) from fault
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    try:
        meshes.meshing_repair_non_manifold_edges()
        meshes.meshing_re_orient_faces_coherently()
        meshes.meshing_close_holes(maxholesize=_LARGEST_HOLE, selfintersection=False, newfaceselected=True)
    except pymeshlab.PyMeshLabException:  # it cannot be oriented
        return vertices, faces, np.zeros(len(faces), dtype=bool)
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64), mesh.face_selection_array()


def _caps(vertices: Array, faces: Faces, new: NDArray[np.bool_]) -> Iterator[Cap]:
    """Yield what closes each hole of a closed mesh with outward faces, of which some are new.

    Across a hole of area pi a^2 where the surface meets a flat cap at the angle t, a sphere would go on as a
    dome of height h = a tan(t / 2) and volume pi h (3 a^2 + h^2) / 6.
    """
    vectors = Surface(vertices, faces).area_vectors_mm2
    normals = unit(vectors)
    edges = np.sort(_edges(faces), axis=1) @ [len(vertices), 1]
    owner = np.repeat(np.arange(len(faces)), 3)
    place = np.flatnonzero(new)
    for part in pieces(faces[place]):
        cap = place[part]
        rim = np.sort(boundary_edges(faces[cap]), axis=1)
        around = np.isin(edges, rim @ [len(vertices), 1]) & ~new[owner]
        length = np.linalg.norm(vertices[rim[:, 0]] - vertices[rim[:, 1]], axis=1)
        across = vectors[cap].sum(axis=0)
        area = max(float(np.linalg.norm(across)), 1e-30)
        cosine = float(np.mean(normals[owner[around]] @ (across / area)))
        angle, radius = float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(np.sqrt(area / np.pi))
        height = radius * float(np.tan(0.5 * min(angle, 0.5 * np.pi)))
        volume = np.pi * height * (3.0 * radius**2 + height**2) / 6.0
        middle = length @ vertices[rim].mean(axis=1) / length.sum()
        yield Cap(middle, 2.0 * radius, float(np.degrees(angle)), float(volume))


def _holes(vertices: Array, faces: Faces) -> str:
    """Say how many holes an open mesh has, and where the largest lie."""
    holes = boundary_edges(faces)
    loops = _split(_groups(holes, len(vertices))[holes[:, 0]])
    places = []
    for loop in loops[:3]:
        corners = vertices[np.unique(holes[loop])]
        centre, width = corners.mean(axis=0), float(np.linalg.norm(np.ptp(corners, axis=0)))
        places.append(f"{width:.3g} mm wide at {', '.join(f'{value:.3f}' for value in centre)} mm")
    more = f" and {len(loops) - 3} more" if len(loops) > 3 else ""
    return f"{len(loops)} hole{'s' if len(loops) > 1 else ''} ({'; '.join(places)}{more})"


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


def _oriented(vertices: Array, faces: Faces, name: str) -> tuple[Faces, int]:
    """Wind all faces of a closed mesh alike, each piece as most of its faces were, and the whole outward."""
    turned = np.zeros(len(faces), dtype=bool)
    if open_walks(faces):
        turned = _against_neighbours(vertices, faces)
        for piece in pieces(faces):
            if 2 * np.count_nonzero(turned[piece]) > len(piece):
                turned[piece] = ~turned[piece]
        faces = np.where(turned[:, None], faces[:, ::-1], faces)
        if open_walks(faces):
            got = f"{open_walks(faces)} edges at which faces cannot be wound alike"
            step = "Export it again as one closed surface (a solid fill)"
            raise StapeskitError.of("the surface", "closed and orientable", got, name, step)
    volume = enclosed_moments(vertices, faces)[0]
    if volume == 0.0:
        raise StapeskitError.of("the surface", "one that encloses a volume", "0 mm3", name, "Export it again")
    if volume < 0.0:
        faces, turned = faces[:, ::-1], ~turned
    return np.ascontiguousarray(faces), int(np.count_nonzero(turned))


def _against_neighbours(vertices: Array, faces: Faces) -> NDArray[np.bool_]:
    """Return which faces a walk over each piece turns so that neighbours are wound alike."""
    mesh = as_mesh(vertices, faces).compute_normals(
        cell_normals=True, point_normals=False, split_vertices=False, consistent_normals=True
    )
    found = np.asarray(mesh.regular_faces, dtype=np.int64)
    # A turned face may begin at another corner: only the sense counts.
    first = np.argmax(found == faces[:, :1], axis=1)
    following = np.take_along_axis(found, (first[:, None] + 1) % 3, axis=1)[:, 0]
    return np.asarray(following != faces[:, 1])


def open_walks(faces: Faces) -> int:
    """Return how many edges are walked more often in one direction: 0 for a closed surface."""
    edges = _edges(faces)
    sense = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(place.reshape(-1), sense)))

"""Fields on a triangulated surface: refinement, diffusion on a fixed physical scale, the set above a level.

Everything here depends on the surface and not on its triangles: edges are bisected to a given length,
normals are diffused over a given length in mm, and sets are cut inside the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.volume.mesh_graphs import graph_pieces, solver
from legacy.stapeskit.arrays import Array

Indices = NDArray[np.intp]

# Twice the area of a triangle over the square of its longest edge (0.87 if equilateral) below which it is a
# sliver, whose stiffness would grow without bound.
_LEAST_SINE = 0.1


@dataclass(frozen=True)
class Mesh:
    """Triangles in mm: ``points`` (n, 3) and ``faces`` (m, 3); may be open."""

    points: Array
    faces: Indices

    @property
    def area_vectors(self) -> Array:
        """Half the cross product of every face's edges, (m, 3), mm2, outward."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    def part(self, keep: NDArray[np.bool_]) -> Mesh:
        """Return the faces whose three vertices are kept, with the vertices they use."""
        return self.with_faces(np.all(keep[self.faces], axis=1))[0]

    def with_faces(self, keep: NDArray[np.bool_]) -> tuple[Mesh, Indices]:
        """Return some of the faces, with the vertices they use, and which vertices (n,) these are."""
        faces = self.faces[keep]
        mask = np.zeros(len(self.points), dtype=bool)
        mask[faces] = True
        used = np.flatnonzero(mask)
        place = np.zeros(len(self.points), dtype=np.intp)
        place[used] = np.arange(len(used))
        return Mesh(self.points[used], place[faces]), used


def refine_edges(mesh: Mesh, edge_mm: float, most_faces: int = 2_000_000) -> Mesh:
    """Bisect edges longer than ``edge_mm`` until none is left; the surface itself does not change.

    Notes
    -----
    An edge is bisected for both of its faces at once, so the mesh stays conforming.
    """
    points, faces = mesh.points, mesh.faces
    while len(faces) < most_faces:
        pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        keys = pairs[:, 0].astype(np.int64) * len(points) + pairs[:, 1]
        _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        edges = pairs[first]
        long = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) > edge_mm
        if not np.any(long):
            break
        middle = np.full(len(edges), -1, dtype=np.intp)
        middle[long] = len(points) + np.arange(int(np.count_nonzero(long)))
        points = np.vstack([points, 0.5 * (points[edges[long, 0]] + points[edges[long, 1]])])
        faces = _split(faces, middle[inverse].reshape(-1, 3))
    return Mesh(points, faces)


def _split(faces: Indices, middle: Indices) -> Indices:
    """Split every face by the midpoints (m, 3) of its edges 01, 12, 20; -1 where an edge stays whole."""
    count = np.count_nonzero(middle >= 0, axis=1)
    parts = [faces[count == 0]]
    for number in (1, 2):
        chosen = count == number
        # Turn the corners so that edge 01 is the bisected one (one cut) or the whole one (two cuts).
        odd = (middle[chosen] >= 0) if number == 1 else (middle[chosen] < 0)
        turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[chosen], turn, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[chosen], turn, axis=1).T
        pieces = [(a, ab, c), (ab, b, c)] if number == 1 else [(a, b, bc), (a, bc, ca), (ca, bc, c)]
        parts += [np.column_stack(piece) for piece in pieces]
    a, b, c = faces[count == 3].T
    ab, bc, ca = middle[count == 3].T
    parts += [np.column_stack(piece) for piece in [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]]
    return np.vstack(parts)


class Diffusion:
    """Diffusion of fields over a surface, with linear elements and implicit steps.

    Notes
    -----
    Stiffness by cotangents (Pinkall and Polthier 1993), lumped mass. One step multiplies a field of
    surface wave number k by 1 / (1 + sigma^2 k^2 / 4); two of them are close to a Gaussian of standard
    deviation sigma. Slivers have their stiffness limited, which keeps it positive semidefinite.
    """

    def __init__(self, mesh: Mesh, sigma_mm: float) -> None:
        self.mesh = mesh
        self.sigma_mm = sigma_mm
        vectors = mesh.area_vectors
        areas = np.linalg.norm(vectors, axis=1)
        corners = mesh.points[mesh.faces]
        n = len(mesh.points)
        longest = np.max(np.sum((corners - np.roll(corners, -1, axis=1)) ** 2, axis=-1), axis=1)
        double = np.maximum(2.0 * areas, _LEAST_SINE * longest + 1e-30)
        rows, columns, weights = [], [], []
        for k in range(3):
            p = corners[:, k]
            u, v = corners[:, (k + 1) % 3] - p, corners[:, (k + 2) % 3] - p
            i, j = mesh.faces[:, (k + 1) % 3], mesh.faces[:, (k + 2) % 3]
            half = 0.125 * sigma_mm**2 * np.einsum("ij,ij->i", u, v) / double
            rows += [i, j, i, j]
            columns += [j, i, i, j]
            weights += [-half, -half, half, half]
        third = np.repeat(areas / 3.0, 3)
        self.mass = np.asarray(1e-15 + np.bincount(mesh.faces.ravel(), third, minlength=n), dtype=np.float64)
        self._solve = solver(
            np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), self.mass
        )

    def step(self, field: Array) -> Array:
        """Diffuse a field (n, k) by one step."""
        return self._solve(self.mass[:, None] * field)

    @cached_property
    def diffused_points(self) -> Array:
        """The vertices (n, 3) after one step, mm."""
        return self.step(self.mesh.points)

    def normals(self, points: Array | None = None) -> Array:
        """Return outward normals (n, 3) at the vertices after two steps; not yet of unit length.

        Parameters
        ----------
        points : ndarray, (n, 3), optional
            Vertices a little displaced, the position of the surface, on which fields are not diffused.
        """
        mesh = self.mesh if points is None else Mesh(points, self.mesh.faces)
        vectors = mesh.area_vectors / 3.0
        flat = mesh.faces.ravel()
        at_vertices = np.stack(
            [np.bincount(flat, np.repeat(vectors[:, k], 3), minlength=len(mesh.points)) for k in range(3)],
            axis=1,
        )
        return self.step(self._solve(np.asarray(at_vertices, dtype=np.float64)))


def unit(vectors: Array) -> Array:
    """Return vectors (n, 3) at unit length."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def step_response(wave_number: Array, sigma_mm: float) -> Array:
    """Return the factor by which one step multiplies a surface wave of that number (rad/mm)."""
    return np.asarray(1.0 / (1.0 + 0.25 * sigma_mm**2 * np.square(wave_number)))


@dataclass(frozen=True)
class Patch:
    """The connected set where a vertex field is positive, cut inside the triangles.

    Attributes
    ----------
    triangles : ndarray, (k, 3, 3)
        Corners, mm.
    areas : ndarray, (k,)
        Their areas on the mesh that was cut, mm2.
    vertices : ndarray, (i,)
        Vertices of the mesh inside it.
    segments : ndarray, (s, 2, 3)
        Pieces of its boundary, mm.
    segment_keys : ndarray, (s, 2)
        Names of their end points: equal names, equal points.
    segment_slope : ndarray, (s,)
        Length of the surface gradient of the field across each piece, 1/mm.
    reaches_border : bool
        The patch ends at a border of the mesh too, not only where the field is zero: its segments form no
        closed line.
    """

    triangles: Array
    areas: Array
    vertices: Indices
    segments: Array
    segment_keys: Indices
    segment_slope: Array
    reaches_border: bool = False


def positive_patch(mesh: Mesh, field: Array, areas: Array, points: Array | None = None) -> Patch | None:
    """Return the largest connected set of ``field > 0``; None when there is none.

    Parameters
    ----------
    mesh : Mesh
    field : ndarray, (n,)
        Linear inside each triangle.
    areas : ndarray, (n,)
        Area of every vertex, mm2: says which set is the largest.
    points : ndarray, (n, 3), optional
        Positions of the vertices in the result, where they differ from those of the mesh.
    """
    inside = _largest_component(mesh, field > 0.0, areas)
    if inside is None:
        return None
    signs = inside[mesh.faces]
    count = np.count_nonzero(signs, axis=1)
    cut = _Cut(mesh, field)
    corners, keys, slopes = [mesh.faces[count == 3]], [], []
    for number in (1, 2):
        chosen = count == number
        odd = signs[chosen] if number == 1 else ~signs[chosen]
        turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
        corner = np.take_along_axis(mesh.faces[chosen], turn, axis=1)
        a, b, c = corner.T
        ab, ac = cut.crossing(a, b), cut.crossing(a, c)
        corners += [np.column_stack(t) for t in ([(a, ab, ac)] if number == 1 else [(ab, b, c), (ab, c, ac)])]
        keys.append(np.column_stack([ab, ac] if number == 1 else [ac, ab]))
        slopes.append(cut.slope(a, b, c))
    triangles, segments = np.vstack(corners), np.vstack(keys)
    seen = cut.points(mesh.points)
    stands = seen if points is None else cut.points(points)
    p, q, r = (seen[triangles[:, k]] for k in range(3))
    return Patch(
        stands[triangles],
        0.5 * np.linalg.norm(np.cross(q - p, r - p), axis=1),
        np.flatnonzero(inside),
        stands[segments],
        segments,
        np.concatenate(slopes),
        _has_open_chain(segments),
    )


def _has_open_chain(segments: Indices) -> bool:
    """Return whether lines of segments (s, 2), named by their end points, have ends."""
    _, uses = np.unique(segments.ravel(), return_counts=True)
    return bool(np.any(uses % 2))


class _Cut:
    """The points where a field changes sign along edges of a mesh, numbered after its vertices."""

    def __init__(self, mesh: Mesh, field: Array) -> None:
        self._mesh, self._field = mesh, field
        n, faces, sign = len(mesh.points), mesh.faces, field > 0.0
        pairs = [
            faces[sign[faces[:, k]] != sign[faces[:, (k + 1) % 3]]][:, [k, (k + 1) % 3]] for k in range(3)
        ]
        edges = np.sort(np.vstack(pairs), axis=1)
        self._known = np.unique(edges[:, 0] * n + edges[:, 1])
        self._low, self._high = self._known // n, self._known % n
        start, end = self._field[self._low], self._field[self._high]
        difference = start - end
        safe = np.where(np.abs(difference) > 1e-300, difference, 1.0)
        share = np.where(np.abs(difference) > 1e-300, start / safe, 0.5)
        self._share = np.clip(share, 0.0, 1.0)[:, None]

    def crossing(self, a: Indices, b: Indices) -> Indices:
        """Return the numbers of the points between vertices a (m,) and b (m,)."""
        key = np.minimum(a, b) * len(self._mesh.points) + np.maximum(a, b)
        return np.asarray(len(self._mesh.points) + np.searchsorted(self._known, key))

    def points(self, places: Array) -> Array:
        """Return vertices and crossing points together, where ``places`` (n, 3) has the vertices."""
        start, end = places[self._low], places[self._high]
        return np.vstack([places, start + self._share * (end - start)])

    def slope(self, a: Indices, b: Indices, c: Indices) -> Array:
        """Return the length of the field's gradient in triangles, 1/mm."""
        f, p = self._field, self._mesh.points
        around = f[a, None] * (p[c] - p[b]) + f[b, None] * (p[a] - p[c]) + f[c, None] * (p[b] - p[a])
        double = np.linalg.norm(np.cross(p[b] - p[a], p[c] - p[a]), axis=1)
        return np.asarray(np.linalg.norm(around, axis=1) / np.maximum(double, 1e-12))


def _largest_component(mesh: Mesh, inside: NDArray[np.bool_], areas: Array) -> NDArray[np.bool_] | None:
    if not np.any(inside):
        return None
    pairs = np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    _, label = graph_pieces(len(mesh.points), pairs[inside[pairs[:, 0]] & inside[pairs[:, 1]]])
    size = np.bincount(label, np.where(inside, areas, 0.0))
    return np.asarray(inside & (label == int(np.argmax(size))))


def outer_loop(patch: Patch) -> Array:
    """Return the longest closed boundary line of a patch, (n, 3), mm, in order; open end not repeated."""
    if len(patch.segments) == 0:
        return np.zeros((0, 3))
    names, place = np.unique(patch.segment_keys, return_inverse=True)
    ends = place.reshape(-1, 2)
    following = np.full(len(names), -1, dtype=np.intp)
    following[ends[:, 0]] = ends[:, 1]
    position = np.zeros((len(names), 3))
    position[ends[:, 0]] = patch.segments[:, 0]
    position[ends[:, 1]] = patch.segments[:, 1]
    free = np.ones(len(names), dtype=bool)
    best, best_length = np.zeros((0, 3)), -1.0
    for start in range(len(names)):
        if not free[start]:
            continue
        loop = []
        node = start
        while node >= 0 and free[node]:
            free[node] = False
            loop.append(node)
            node = int(following[node])
        line = position[loop]
        length = float(np.sum(np.linalg.norm(np.diff(line, axis=0, append=line[:1]), axis=1)))
        if length > best_length:
            best, best_length = line, length
    return best

"""Fields on a triangulated surface: refinement, diffusion on a fixed physical scale, the set above a level.

Everything here depends on the surface and not on its triangles: edges are bisected to a given length,
normals are diffused over a given length in mm, and sets are cut inside the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

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
        faces = self.faces[np.all(keep[self.faces], axis=1)]
        used = np.unique(faces)
        place = np.zeros(len(self.points), dtype=np.intp)
        place[used] = np.arange(len(used))
        return Mesh(self.points[used], place[faces])


def refined(mesh: Mesh, edge_mm: float, most_faces: int = 2_000_000) -> Mesh:
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
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import splu

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
        place = np.arange(n)
        matrix = csc_matrix(
            (
                np.concatenate([*weights, self.mass]),
                (np.concatenate([*rows, place]), np.concatenate([*columns, place])),
            ),
            shape=(n, n),
        )
        self._factors = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        self.vertex_area_vectors = np.column_stack(
            [
                np.bincount(mesh.faces.ravel(), np.repeat(vectors[:, k] / 3.0, 3), minlength=n)
                for k in range(3)
            ]
        )

    def step(self, field: Array) -> Array:
        """Diffuse a field (n, k) by one step."""
        return np.asarray(self._factors.solve(self.mass[:, None] * field))

    def normals(self) -> Array:
        """Return outward normals (n, 3) at the vertices after two steps; not yet of unit length."""
        return self.step(np.asarray(self._factors.solve(self.vertex_area_vectors)))


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
    segments : ndarray, (s, 2, 3)
        Pieces of its boundary, mm.
    segment_keys : ndarray, (s, 2)
        Names of their end points: equal names, equal points.
    segment_slope : ndarray, (s,)
        Length of the surface gradient of the field across each piece, 1/mm.
    """

    triangles: Array
    segments: Array
    segment_keys: Indices
    segment_slope: Array


def positive_patch(mesh: Mesh, field: Array, areas: Array) -> Patch | None:
    """Return the largest connected set of ``field > 0``; None when there is none.

    Parameters
    ----------
    mesh : Mesh
    field : ndarray, (n,)
        Linear inside each triangle.
    areas : ndarray, (n,)
        Area of every vertex, mm2: says which set is the largest.
    """
    inside = _largest_component(mesh, field > 0.0, areas)
    if inside is None:
        return None
    signs = inside[mesh.faces]
    count = np.count_nonzero(signs, axis=1)
    whole = mesh.points[mesh.faces[count == 3]]
    triangles, segments, keys, slopes = [whole], [], [], []
    for number in (1, 2):
        chosen = count == number
        odd = signs[chosen] if number == 1 else ~signs[chosen]
        turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
        corner = np.take_along_axis(mesh.faces[chosen], turn, axis=1)
        a, b, c = (mesh.points[corner[:, k]] for k in range(3))
        fa, fb, fc = (field[corner[:, k]] for k in range(3))
        ab = _crossing(a, b, fa, fb)
        ac = _crossing(a, c, fa, fc)
        if number == 1:
            triangles.append(np.stack([a, ab, ac], axis=1))
            segments.append(np.stack([ab, ac], axis=1))
        else:
            triangles += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
            segments.append(np.stack([ac, ab], axis=1))
        n = len(mesh.points)
        key_ab = np.minimum(corner[:, 0], corner[:, 1]) * n + np.maximum(corner[:, 0], corner[:, 1])
        key_ac = np.minimum(corner[:, 0], corner[:, 2]) * n + np.maximum(corner[:, 0], corner[:, 2])
        keys.append(np.column_stack([key_ab, key_ac] if number == 1 else [key_ac, key_ab]))
        slopes.append(_gradient_length(a, b, c, fa, fb, fc))
    return Patch(np.vstack(triangles), np.vstack(segments), np.vstack(keys), np.concatenate(slopes))


def _crossing(start: Array, end: Array, f_start: Array, f_end: Array) -> Array:
    difference = f_start - f_end
    share = np.where(np.abs(difference) > 1e-300, f_start / np.where(difference == 0, 1.0, difference), 0.5)
    return start + np.clip(share, 0.0, 1.0)[:, None] * (end - start)


def _gradient_length(a: Array, b: Array, c: Array, fa: Array, fb: Array, fc: Array) -> Array:
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1)
    around = fa[:, None] * (c - b) + fb[:, None] * (a - c) + fc[:, None] * (b - a)
    return np.asarray(np.linalg.norm(around, axis=1) / np.maximum(double, 1e-12))


def _largest_component(mesh: Mesh, inside: NDArray[np.bool_], areas: Array) -> NDArray[np.bool_] | None:
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    if not np.any(inside):
        return None
    edges = np.vstack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    edges = edges[inside[edges[:, 0]] & inside[edges[:, 1]]]
    edges = np.vstack([edges, mesh.faces[:, [2, 0]][np.all(inside[mesh.faces[:, [2, 0]]], axis=1)]])
    n = len(mesh.points)
    graph = csr_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, label = connected_components(graph, directed=False)
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

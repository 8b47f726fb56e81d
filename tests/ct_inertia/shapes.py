"""Bodies with known frames and moments, made for the tests of this room."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from legacy.ct_inertia.surface.surface import Surface

# Where the parts of the named stapes lie in its own axes: x anterior, y lateral, z superior; mm.
PARTS = {
    "footplate_centre": (0.0, 0.0, 0.0),
    "head": (0.1, 3.1, 0.1),
    "anterior": (1.4, 0.15, 0.0),
    "posterior": (-1.4, 0.15, 0.0),
    "superior": (0.0, 0.15, 0.68),
    "inferior": (0.0, 0.15, -0.68),
}


def capsule(p, a, b, r):
    a, b = np.array(a), np.array(b)
    t = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - r


def stapes_distance(p):
    """Signed distance of a stapes whose footplate (2.9 x 1.4 x 0.25 mm) has its medial face at y = 0."""
    x, y, z = np.moveaxis(p, -1, 0)
    a, b, thick, rim = 1.45, 0.7, 0.25, 0.1
    k0, k1 = np.hypot(x / a, z / b), np.hypot(x / a**2, z / b**2)
    across = k0 * (k0 - 1.0) / np.maximum(k1, 1e-9) + rim
    along = np.abs(y - thick / 2) - thick / 2 + rim
    plate = np.minimum(np.maximum(across, along), 0.0) - rim
    plate = plate + np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0))
    parts = [
        capsule(p, (1.0, 0.22, 0.0), (0.25, 2.6, 0.05), 0.17),
        capsule(p, (-1.0, 0.22, 0.0), (-0.2, 2.6, 0.05), 0.15),
        capsule(p, (0.05, 2.7, 0.05), (0.1, 3.1, 0.1), 0.38),
    ]
    return np.minimum.reduce([plate, *parts])


@lru_cache(maxsize=4)
def stapes(step_mm: float = 0.05) -> Surface:
    """The stapes as a surface, in its own axes."""
    from skimage.measure import marching_cubes

    axes = [np.arange(-1.7, 1.7, step_mm), np.arange(-0.3, 3.8, step_mm), np.arange(-1.0, 1.0, step_mm)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(stapes_distance(grid) + 1e-7, 0.0)
    vertices = vertices * step_mm + [axis[0] for axis in axes]
    return outward(vertices, faces)


def outward(vertices, faces) -> Surface:
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
        faces = faces[:, ::-1]
    return Surface(vertices, np.ascontiguousarray(faces))


def box(size_mm, centre_mm=(0.0, 0.0, 0.0)) -> Surface:
    """A box with its edges along the axes."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return outward(corners * np.array(size_mm) + np.array(centre_mm), faces)


def moved(surface: Surface, rotation, shift=(0.0, 0.0, 0.0)) -> Surface:
    """The surface after r -> R r + t; a reflection turns the faces round."""
    return outward(surface.vertices_mm @ np.asarray(rotation).T + np.asarray(shift), surface.faces)


def signed_permutations():
    """All 48 ways in which an array can be flipped and transposed."""
    from itertools import permutations, product

    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield np.eye(3)[list(order)] * np.array(signs)[:, None]

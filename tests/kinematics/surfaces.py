"""Surfaces for the tests of registration: plates with known planes, and a blurred step of labels."""

from __future__ import annotations

import gzip

import numpy as np

from legacy.kinematics.registration.mesh_distance import TriangleSurface

_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box(low, high, cells=12):
    """Return a closed box with outward triangles, each side cut into cells x cells squares."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    vertices, faces = [], []
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    for a, b, _, d in _QUADS:
        origin, u, v = corners[a], corners[b] - corners[a], corners[d] - corners[a]
        outward = origin + 0.5 * (u + v) - 0.5
        if np.cross(u, v) @ outward < 0.0:
            u, v = v, u
        start = len(vertices)
        for i in range(cells + 1):
            vertices += [origin + u * i / cells + v * j / cells for j in range(cells + 1)]
        for i in range(cells):
            for j in range(cells):
                p = start + i * (cells + 1) + j
                q = p + cells + 1
                faces += [(p, q, q + 1), (p, q + 1, p + 1)]
    return TriangleSurface(low + np.array(vertices) * (high - low), np.array(faces), "surface of the plate")


def wedge(cells=12):
    """Return a plate of 4.2 x 1 x 2.8 mm with a leaning top: no half turn or mirror leaves it as it is."""
    flat = box([-2.1, -1.0, -1.4], [2.1, 0.0, 1.4], cells)
    vertices = flat.vertices_mm.copy()
    lean = 0.06 * vertices[:, 0] + 0.11 * vertices[:, 2] + 0.03 * vertices[:, 0] * vertices[:, 2]
    vertices[:, 1] += lean * (1.0 + vertices[:, 1])
    vertices[:, 0] *= 1.0 + 0.05 * vertices[:, 2]
    return TriangleSurface(vertices, flat.faces, "surface of the plate")


def on_faces(surface, rng, count, sides=((1, 1.0), (0, 1.0), (2, 1.0))):
    """Return points on the faces whose normal has a component beyond 0.8 along signed axes."""
    points, normals = surface.samples(6000, int(rng.integers(1 << 30)))
    ok = np.zeros(len(points), dtype=bool)
    for axis, sign in sides:
        ok |= sign * normals[:, axis] > 0.8
    return points[rng.choice(np.flatnonzero(ok), count, replace=False)]


def write_labels(path, array, spacing=0.025, origin=(0.0, 0.0, 0.0), space="left-posterior-superior"):
    """Write labels [z, y, x] as a compressed NRRD."""
    sizes = " ".join(str(n) for n in array.shape[::-1])
    text = (
        f"NRRD0004\n# made by a test\ntype: uint8\ndimension: 3\nspace: {space}\nsizes: {sizes}\n"
        f"space directions: ({spacing},0,0) (0,{spacing},0) (0,0,{spacing})\nkinds: domain domain domain\n"
        f"encoding: gzip\nspace origin: ({','.join(str(v) for v in origin)})\n\n"
    )
    path.write_bytes(text.encode() + gzip.compress(array.astype(np.uint8).tobytes()))
    return path

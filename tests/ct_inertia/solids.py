"""Exact solids for the tests: closed meshes, and their grey-value images without discretisation error."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.volume import Volume


def box_surface(lengths, centre=(0.0, 0.0, 0.0)):
    corner = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], dtype=float) - 0.5
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Surface(corner * lengths + centre, np.array(faces))


def stapes_field(points):
    """Signed field (negative inside, about mm) of a footplate, two crura and a head: one hole."""
    x, y, z = np.moveaxis(points, -1, 0)

    def ellipsoid(cx, cy, cz, a, b, c):
        r = np.sqrt(((x - cx) / a) ** 2 + ((y - cy) / b) ** 2 + ((z - cz) / c) ** 2)
        return (r - 1.0) * min(a, b, c)

    def rod(start, end, r0, r1):
        start, end = np.array(start), np.array(end)
        along = end - start
        away = points - start
        t = np.clip(away @ along / (along @ along), 0.0, 1.0)
        return np.linalg.norm(away - t[..., None] * along, axis=-1) - (r0 + (r1 - r0) * t)

    plate = np.maximum(
        np.sqrt((x / 1.4) ** 2 + (z / 0.65) ** 2) * 0.65 - 0.65, np.abs(y - 0.03 * x**2) - 0.13
    )
    parts = [
        plate,
        rod((-1.0, 0.0, 0.0), (-0.35, 2.2, 0.05), 0.2, 0.17),
        rod((1.1, 0.0, 0.05), (0.35, 2.2, 0.05), 0.22, 0.18),
        ellipsoid(0.0, 2.6, 0.05, 0.62, 0.55, 0.42),
    ]
    width = 0.04
    stacked = np.stack(parts)
    low = stacked.min(axis=0)
    return low - width * np.log(np.exp(-(stacked - low) / width).sum(axis=0))


def stapes_surface(step=0.02):
    """Mesh of ``stapes_field``; this polyhedron itself is the truth."""
    return implicit_surface(stapes_field, (-1.7, -0.4, -0.9), (1.7, 3.4, 0.9), step)


def implicit_surface(function, low, high, step):
    from skimage.measure import marching_cubes

    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(function(grid), 0.0, allow_degenerate=False)
    vertices = vertices * step + np.array(low)
    try:
        return Surface(vertices, faces)
    except ValueError:
        return Surface(vertices, faces[:, ::-1])


def moved(surface, rotation, translation=(0.0, 0.0, 0.0)):
    return Surface(surface.vertices_mm @ np.asarray(rotation).T + translation, surface.faces)


def joined(*surfaces):
    """One surface of several disjoint ones."""
    start = np.cumsum([0] + [len(s.vertices_mm) for s in surfaces])
    faces = [s.faces + k for s, k in zip(surfaces, start, strict=False)]
    return Surface(np.vstack([s.vertices_mm for s in surfaces]), np.vstack(faces))


def filled(surface, shape_xyz, spacing, origin, rays=4):
    """Share of each voxel [z, y, x] inside the surface: exact along x, ``rays``^2 lines per voxel."""
    nx, ny, nz = shape_xyz
    hx, hy, hz = np.broadcast_to(spacing, 3)
    corners = (surface.vertices_mm - origin) / (hx, hy, hz) + 0.5
    # A hair of an offset keeps the lines off edges and corners.
    corners[:, 1:] = corners[:, 1:] * rays + 1.2345e-7 * np.array([1.0, 1.7])
    a, b, c = np.moveaxis(corners[surface.faces], 1, 0)
    first = np.ceil(np.minimum(np.minimum(a, b), c)[:, 1:] - 0.5)
    last = np.floor(np.maximum(np.maximum(a, b), c)[:, 1:] - 0.5)
    (b1, b2), (c1, c2) = (b - a)[:, 1:].T, (c - a)[:, 1:].T
    det = b1 * c2 - b2 * c1
    wide, high = np.maximum(last - first + 1.0, 0.0).astype(np.int64).T
    count = np.where(det != 0.0, wide * high, 0)
    # Every line that may meet a triangle, triangle by triangle.
    face = np.repeat(np.arange(len(a)), count)
    number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    v, u = np.divmod(number, wide[face])
    u, v = u + first[face, 0], v + first[face, 1]
    du, dv = u + 0.5 - a[face, 1], v + 0.5 - a[face, 2]
    s = (du * c2[face] - dv * c1[face]) / det[face]
    t = (dv * b1[face] - du * b2[face]) / det[face]
    hit = (s >= 0) & (t >= 0) & (s + t <= 1)
    hit &= (u >= 0) & (u < ny * rays) & (v >= 0) & (v < nz * rays)
    face, s, t = face[hit], s[hit], t[hit]
    row = (v[hit] * (ny * rays) + u[hit]).astype(np.int64)
    place = a[face, 0] + s * (b - a)[face, 0] + t * (c - a)[face, 0]
    sign = -np.sign(det[face])
    v, u = np.divmod(row, ny * rays)
    voxel_row = (v // rays) * ny + u // rays
    place = np.clip(place, 0.0, nx)
    cell = np.minimum(place.astype(np.int64), nx - 1)
    inside = place - cell
    # A crossing at x fills its own voxel's rest and every later voxel of the row.
    own = np.bincount(voxel_row * nx + cell, sign * (1.0 - inside), ny * nz * nx)
    later = np.bincount(voxel_row * nx + cell, sign, ny * nz * nx).reshape(-1, nx)
    total = own.reshape(-1, nx) + np.cumsum(later, axis=1) - later
    return total.reshape(nz, ny, nx) / rays**2


def imaged(shares, sigma_voxels):
    """Blur shares of voxels so that the whole point spread (voxel included) has ``sigma_voxels``."""
    from scipy.ndimage import gaussian_filter

    rest = np.sqrt(np.maximum(np.broadcast_to(sigma_voxels, 3).astype(float) ** 2 - 1.0 / 12.0, 0.0))
    return gaussian_filter(shares.astype(np.float32), rest[::-1], truncate=6.0)


def grey_volume(grey, spacing, origin=(0.0, 0.0, 0.0), dtype=np.uint16, **options):
    info = np.iinfo(dtype) if np.issubdtype(dtype, np.integer) else None
    array = np.clip(np.rint(grey), info.min, info.max).astype(dtype) if info else grey.astype(dtype)
    return Volume(array, np.broadcast_to(spacing, 3), np.asarray(origin, float), np.eye(3), **options)


def random_rotation(seed):
    from scipy.spatial.transform import Rotation

    return Rotation.random(random_state=seed).as_matrix()

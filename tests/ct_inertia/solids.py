"""Exact solids for the tests: closed meshes, and their grey-value images without discretisation error."""

from __future__ import annotations

import numpy as np

from ct_inertia.surface.surface import Surface
from ct_inertia.volume.volume import Volume


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
    rows, places, signs = [], [], []
    for a, b, c in corners[surface.faces]:
        u0, u1 = np.ceil(min(a[1], b[1], c[1]) - 0.5), np.floor(max(a[1], b[1], c[1]) - 0.5)
        v0, v1 = np.ceil(min(a[2], b[2], c[2]) - 0.5), np.floor(max(a[2], b[2], c[2]) - 0.5)
        if u1 < u0 or v1 < v0:
            continue
        u, v = np.meshgrid(np.arange(u0, u1 + 1), np.arange(v0, v1 + 1))
        u, v = u.ravel(), v.ravel()
        det = (b[1] - a[1]) * (c[2] - a[2]) - (c[1] - a[1]) * (b[2] - a[2])
        if det == 0.0:
            continue
        du, dv = u + 0.5 - a[1], v + 0.5 - a[2]
        s = (du * (c[2] - a[2]) - dv * (c[1] - a[1])) / det
        t = (dv * (b[1] - a[1]) - du * (b[2] - a[2])) / det
        hit = (s >= 0) & (t >= 0) & (s + t <= 1)
        hit &= (u >= 0) & (u < ny * rays) & (v >= 0) & (v < nz * rays)
        rows.append((v[hit] * (ny * rays) + u[hit]).astype(np.int64))
        places.append(a[0] + s[hit] * (b[0] - a[0]) + t[hit] * (c[0] - a[0]))
        signs.append(np.full(int(hit.sum()), -np.sign(det)))
    row, place, sign = np.concatenate(rows), np.concatenate(places), np.concatenate(signs)
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

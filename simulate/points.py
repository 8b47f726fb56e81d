"""Points to measure: on a stapes where all lasers reach, on the bone, and random ones."""

from __future__ import annotations

import numpy as np

from simulate.ear import WINDOW_TOP_MM, footplate_outline, vertex_normals
from simulate.solids import Solid
from stapeskit.arrays import Array


def visible_points(solid: Solid, count: int, beams: Array) -> Array:
    """Return vertices (count, 3), mm, that all lasers reach, spread over head, crura and footplate.

    ``beams`` (n, 3) are unit vectors towards the laser heads; all in footplate axes.
    """
    normals, corners = vertex_normals(solid), solid.vertices_mm[solid.faces]
    facing = np.all(normals @ beams.T > 0.2, axis=1)
    starts, open_to = solid.vertices_mm[facing] + 1e-6 * normals[facing], solid.vertices_mm[facing]
    nearest = open_to[:, 1] - open_to[:, 1].min()
    chosen: list[int] = []
    while len(chosen) < count and nearest.max() > 0.0:
        best = int(np.argmax(nearest))
        if any(_shaded(starts[best], corners, beam) for beam in beams):
            nearest[best] = 0.0
            continue
        away = np.linalg.norm(open_to - open_to[best], axis=1)
        nearest = np.where(nearest > 0.0, away if not chosen else np.minimum(nearest, away), 0.0)
        chosen.append(best)
    return open_to[chosen]


def _shaded(start: Array, corners: Array, beam: Array) -> bool:
    """Return whether triangles (m, 3, 3) hide a point (3,) from a laser in the direction ``beam``.

    Moeller and Trumbore 1997, J. Graphics Tools 2:21, doi:10.1080/10867651.1997.10487468.
    """
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    across = np.cross(beam, second)
    scale = np.einsum("mk,mk->m", across, first)
    cut = np.flatnonzero(scale)
    away = start - corners[cut, 0]
    turned = np.cross(away, first[cut])
    u = np.einsum("mk,mk->m", away, across[cut]) / scale[cut]
    v = turned @ beam / scale[cut]
    distance = np.einsum("mk,mk->m", turned, second[cut]) / scale[cut]
    return bool(np.any((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)))


def bone_points(solid: Solid, count: int) -> Array:
    """Return points on the lateral side of the bone around the oval window, (count, 3) mm."""
    near, far = footplate_outline(solid, 0.32), footplate_outline(solid, 0.48)
    turn = np.linspace(0, len(near), count, endpoint=False).astype(int)
    places = np.where((np.arange(count) % 2 == 0)[:, None], near[turn], far[turn])
    return np.insert(places, 1, WINDOW_TOP_MM, axis=1)


def scattered_points(rng: np.random.Generator, count: int, flat: bool = False) -> Array:
    """Return random points on a footplate, and on crura and head unless flat, (count, 3) mm."""
    low = count if flat else count // 2
    turn = 2.0 * np.pi * (np.arange(low) + rng.uniform()) / max(low, 1)
    rim = np.column_stack([1.3 * np.cos(turn), rng.uniform(0.0, 0.3, low), 0.6 * np.sin(turn)])
    high = count - low
    arch = np.column_stack(
        [rng.uniform(-0.7, 0.7, high), np.linspace(1.0, 3.2, high), rng.uniform(-0.4, 0.4, high)]
    )
    return np.concatenate([rim + 0.1 * rng.normal(size=rim.shape), arch])

"""Find the face of the footplate: the largest near-planar face at an extremity of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.surface.surface_field import Mesh
from legacy.stapeskit.arrays import Array

# Directions over the sphere: 12 degrees apart, about half of the search cone (which is not that of the medial
# face), then 6 degrees apart within 10 degrees of the best, which covers the cell of a coarse direction.
_DIRECTIONS = 300
_FINE_DIRECTIONS = 1200
_NEAR_DEG = 10.0
# Faces whose direction is refined: the footplate and two rivals.
_REFINED = 3
# Edge of the cells that pool triangles, in diameters of the body: a quarter of the slab of a face.
_CELL = 0.02
_SEARCH_CONE_DEG = calibrated("footplate_search.cone_deg")
_SLAB = calibrated("footplate_search.slab")
_OTHER_DEG = calibrated("footplate_search.other_deg")


@dataclass(frozen=True)
class FaceCandidate:
    """A face at an extremity.

    Attributes
    ----------
    outward : ndarray, (3,)
        Unit vector out of the body, square to the face.
    area_mm2 : float
        Its area projected on its plane.
    """

    outward: Array
    area_mm2: float


def face_candidates(mesh: Mesh, extent_mm: float) -> list[FaceCandidate]:
    """Return extremal faces by falling area, each well off those before it (``footplate_search.other_deg``).

    Parameters
    ----------
    mesh : Mesh
        Closed and outward.
    extent_mm : float
        Diameter of the body.

    Notes
    -----
    For directions spread evenly over the sphere: the projected area of what faces that direction within the
    search cone (``cone_deg``) and lies within a slab of the extreme plane (``slab``, in diameters of the
    body). Side views of the arch, the head and the lateral side of the footplate score less: narrow, small,
    or not at an extremity.
    """
    centres, vectors = _pool(mesh, _CELL * extent_mm)
    areas = np.linalg.norm(vectors, axis=1)
    pieces = (centres, vectors / np.maximum(areas[:, None], 1e-30), areas)
    directions = sphere(_DIRECTIONS)
    scores = _scores(directions, pieces, extent_mm)
    free = np.ones(len(directions), dtype=bool)
    fine = sphere(_FINE_DIRECTIONS)
    candidates: list[FaceCandidate] = []
    while np.any(free):
        best = int(np.argmax(np.where(free, scores, -1.0)))
        outward, area = directions[best], float(scores[best])
        free &= directions @ outward < np.cos(np.radians(_OTHER_DEG))
        if len(candidates) < _REFINED:
            near = fine[fine @ outward > np.cos(np.radians(_NEAR_DEG))]
            closer = _scores(near, pieces, extent_mm)
            place = int(np.argmax(closer))
            if closer[place] > area:
                outward, area = near[place], float(closer[place])
        candidates.append(FaceCandidate(outward, area))
    return sorted(candidates, key=lambda face: -face.area_mm2)


def _scores(directions: Array, pieces: tuple[Array, Array, Array], extent_mm: float) -> Array:
    """Return the area (n,) of the face that each direction (n, 3) sees at the extremity of the body."""
    centres, normals, areas = pieces
    cosine, slab = np.cos(np.radians(_SEARCH_CONE_DEG)), _SLAB * extent_mm
    scores = np.zeros(len(directions))
    for number, direction in enumerate(directions):
        height = centres @ direction
        facing = normals @ direction
        mask = (facing > cosine) & (height > height.max() - slab)
        scores[number] = areas[mask] @ facing[mask]
    return scores


def _pool(mesh: Mesh, cell_mm: float) -> tuple[Array, Array]:
    """Pool faces by cells of space and main direction: centres (n, 3) and area vectors (n, 3).

    Pooling averages the noise of single normals and leaves few pieces of a fine mesh.
    """
    vectors = mesh.area_vectors
    centres = mesh.points[mesh.faces].mean(axis=1)
    cells = np.floor((centres - centres.min(axis=0)) / cell_mm).astype(np.int64)
    main = np.argmax(np.abs(vectors), axis=1)
    sense = np.take_along_axis(vectors, main[:, None], axis=1)[:, 0] > 0.0
    shape = cells.max(axis=0) + 1
    key = ((cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]) * 6 + 2 * main + sense
    _, group = np.unique(key, return_inverse=True)
    count = np.bincount(group)
    pooled: Array = np.stack([np.bincount(group, vectors[:, k]) for k in range(3)], axis=1, dtype=float)
    middle: Array = np.stack(
        [np.bincount(group, centres[:, k]) / count for k in range(3)], axis=1, dtype=float
    )
    return middle, pooled


def sphere(count: int) -> Array:
    """Return directions (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])

"""Nearest points of a triangle surface, exactly, with normals averaged over its roughness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError
from stapeskit.faults import Fault

Array = NDArray[np.float64]
Index = NDArray[np.int64]
_SMALL = 3.0
_FIRST = 12
_REACH = 6.0
_SAME_SIDE = 0.8
_EDGE = 0.7


@dataclass(frozen=True)
class TriangleSurface:
    """A triangle surface, open or closed, with outward faces.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
    faces : ndarray, (m, 3), int
    name : str
        What it is, for messages.
    sd_mm : float or None
        How well it is known, where that was said.

    Raises
    ------
    KinematicsError
        There is no triangle with an area, or a number is not finite.
    """

    vertices_mm: Array
    faces: Index
    name: str = "surface"
    sd_mm: float | None = None
    _parts: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_mm, dtype=float)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        fine = vertices.ndim == 2 and faces.ndim == 2 and faces.shape[1:] == (3,) and len(faces) > 0
        if fine:
            fine = bool(np.all(np.isfinite(vertices)) and faces.min() >= 0 and faces.max() < len(vertices))
        if fine:
            corners = vertices[faces]
            area = 0.5 * np.linalg.norm(
                np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
            )
            faces = faces[area > 1e-9 * np.max(area)] if np.max(area) > 0.0 else faces[:0]
        if not fine or len(faces) == 0:
            raise KinematicsError(
                Fault(
                    f"the {self.name}",
                    "made of triangles with finite corners",
                    "none",
                    "",
                    "Run ct2mass anew",
                )
            )
        object.__setattr__(self, "vertices_mm", vertices)
        object.__setattr__(self, "faces", faces)

    def _made(self) -> dict[str, Any]:
        """Return what the searches need, made at the first one."""
        if not self._parts:
            from scipy.spatial import cKDTree

            corners = self.vertices_mm[self.faces]
            centre = corners.mean(axis=1)
            reach = np.sqrt(np.max(np.sum((corners - centre[:, None]) ** 2, axis=2), axis=1))
            small = reach <= _SMALL * np.median(reach)
            area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            size = np.linalg.norm(area, axis=1)
            self._parts.update(
                corners=corners,
                centre=centre,
                normal=area / size[:, None],
                area=0.5 * size,
                small=np.flatnonzero(small),
                large=np.flatnonzero(~small),
                reach=float(np.max(reach[small])),
                tree=cKDTree(centre[small]),
                every=cKDTree(centre),
                edge=float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))),
            )
        return self._parts

    @property
    def edge_mm(self) -> float:
        """Median length of an edge, mm: about one voxel on a surface from a scan."""
        return float(self._made()["edge"])

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the bounding box, mm."""
        used = self.vertices_mm[self.faces].reshape(-1, 3)
        return float(np.linalg.norm(np.ptp(used, axis=0)))

    def closest(self, points_mm: Array) -> tuple[Array, Array, Index]:
        """Return the nearest points (n, 3) of the surface, their distances (n,), mm, and their triangles."""
        parts = self._made()
        points = np.atleast_2d(np.asarray(points_mm, dtype=float))
        found = np.zeros_like(points)
        best = np.full(len(points), np.inf)
        owner = np.zeros(len(points), dtype=np.int64)
        if len(parts["large"]):
            _nearest(
                points, parts["corners"], parts["large"][None].repeat(len(points), 0), found, best, owner
            )
        open_, count = np.arange(len(points)), _FIRST
        while len(open_):
            count = min(count, len(parts["small"]))
            away, near = parts["tree"].query(points[open_], k=np.arange(1, count + 1))
            some, size, which = found[open_], best[open_], owner[open_]
            _nearest(points[open_], parts["corners"], parts["small"][near], some, size, which)
            found[open_], best[open_], owner[open_] = some, size, which
            if count == len(parts["small"]):
                break
            open_ = open_[size > away[:, -1] - parts["reach"]]
            count *= 4
        return found, best, owner

    def normals(self, triangles: Index, reach_mm: float = 0.0) -> Array:
        """Return outward unit normals (n, 3) at triangles, averaged over the roughness of the surface.

        Neighbours that lie on another side of an edge are left out.
        """
        parts = self._made()
        radius = max(reach_mm, _REACH * parts["edge"])
        own = parts["normal"][triangles]
        if not len(triangles) or parts["edge"] > 0.05 * self.diagonal_mm:
            return np.asarray(own)
        mean = np.empty_like(own)
        for place, near in enumerate(parts["every"].query_ball_point(parts["centre"][triangles], radius)):
            sides, areas = parts["normal"][near], parts["area"][near]
            mean[place] = _main_side(sides, areas, own[place])
        return mean

    def near_edge(self, near_mm: Array, normal: Array, reach_mm: Array) -> NDArray[np.bool_]:
        """Tell which points (n, 3) have an edge, a turn by 45 degrees, within a reach (n,), mm."""
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
        first /= np.linalg.norm(first, axis=1)[:, None]
        second = np.cross(normal, first)
        edge = np.zeros(len(near_mm), dtype=bool)
        for turn in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False):
            step = reach_mm[:, None] * (np.cos(turn) * first + np.sin(turn) * second)
            _, away, triangle = self.closest(near_mm + step)
            other = self.normals(triangle)
            edge |= (np.sum(other * normal, axis=1) < _EDGE) | (away > 0.5 * reach_mm)
        return edge

    def signed(self, points_mm: Array) -> tuple[Array, Array, Array]:
        """Return signed distances (n,), mm (outside positive), along normals (n, 3), and nearest points."""
        near, distance, triangle = self.closest(points_mm)
        normal = self.normals(triangle)
        along = np.sum((points_mm - near) * normal, axis=1)
        return np.copysign(distance, along), normal, near

    def samples(self, count: int, seed: int = 0) -> tuple[Array, Array]:
        """Return points (count, 3), mm, spread evenly over the surface, and their triangles' normals."""
        parts = self._made()
        rng = np.random.default_rng(seed)
        steps = (np.arange(count) + rng.random(count)) / count
        triangle = np.searchsorted(np.cumsum(parts["area"]) / np.sum(parts["area"]), steps)
        triangle = np.minimum(triangle, len(self.faces) - 1)
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        share = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
        points = np.einsum("nk,nki->ni", share, parts["corners"][triangle])
        return points, parts["normal"][triangle]


def _main_side(sides: Array, areas: Array, own: Array) -> Array:
    """Average the normals of one side of an edge, the side that the neighbourhood's own normals lie on."""
    mean = own
    for _ in range(3):
        same = sides @ mean > _SAME_SIDE
        if not np.any(same):
            return own
        total = areas[same] @ sides[same]
        mean = total / np.linalg.norm(total)
    return np.asarray(mean)


def _nearest(points: Array, corners: Array, among: Index, found: Array, best: Array, owner: Index) -> None:
    """Lower ``best`` (n,), and set ``found`` and ``owner``, by the nearest of the triangles ``among``."""
    step = max(1, 200_000 // among.shape[1])
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        near = nearest_on_triangles(points[part, None], corners[among[part]])
        away = np.linalg.norm(near - points[part, None], axis=2)
        first = np.argmin(away, axis=1)
        rows = np.arange(len(first))
        size = away[rows, first]
        better = size < best[part]
        best[part] = np.where(better, size, best[part])
        found[part] = np.where(better[:, None], near[rows, first], found[part])
        owner[part] = np.where(better, among[part][rows, first], owner[part])


def nearest_on_triangles(points: Array, corners: Array) -> Array:
    """Return the nearest points (..., 3) of triangles (..., 3 corners, 3) to points (..., 3).

    Notes
    -----
    Ericson 2005, Real-Time Collision Detection, section 5.1.5, all cases at once.
    """
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    ab, ac = b - a, c - a
    d1, d2 = np.sum(ab * (points - a), axis=-1), np.sum(ac * (points - a), axis=-1)
    d3, d4 = np.sum(ab * (points - b), axis=-1), np.sum(ac * (points - b), axis=-1)
    d5, d6 = np.sum(ab * (points - c), axis=-1), np.sum(ac * (points - c), axis=-1)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    with np.errstate(divide="ignore", invalid="ignore"):
        total = va + vb + vc
        v, w = vb / total, vc / total
        along_ab, along_ac = d1 / (d1 - d3), d2 / (d2 - d6)
        along_bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
    cases = (
        ((d1 <= 0) & (d2 <= 0), 0.0, 0.0),
        ((d3 >= 0) & (d4 <= d3), 1.0, 0.0),
        ((d6 >= 0) & (d5 <= d6), 0.0, 1.0),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), along_ab, 0.0),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), 0.0, along_ac),
        ((va <= 0) & (d4 >= d3) & (d5 >= d6), 1.0 - along_bc, along_bc),
    )
    v = np.select([case[0] for case in cases], [case[1] for case in cases], v)
    w = np.select([case[0] for case in cases], [case[2] for case in cases], w)
    return np.asarray(a + v[..., None] * ab + w[..., None] * ac)

"""The medial face, cut out of the triangles of a region where its normals pass an angle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ct_inertia.surface.fields import sum_at_corners
from ct_inertia.surface.surface import Faces
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from ct_inertia.frames.footplate_face import Region

_MARGIN = 0.15  # cosines beyond the face's angle that a cone keeps
_NEXT_STEP = "Check the segmentation or the mesh, or correct it with --seed or --labels"


@dataclass(frozen=True)
class Face:
    """A medial face cut out of the surface.

    Attributes
    ----------
    centres, areas : ndarray, (k, 3), (k,)
        Its triangles, mm and mm2.
    outline : ndarray, (n, 3)
        Longest closed line of its border, in order, mm.
    segments : ndarray, (s, 2, 3)
        All pieces of its border, mm.
    slopes : ndarray, (s,)
        Length of the surface gradient there of the cosine between normal and -y, 1/mm.
    reaches_end : bool
        The region ends it, not the angle.
    """

    centres: Array
    areas: Array
    outline: Array
    segments: Array
    slopes: Array
    reaches_end: bool

    @property
    def area(self) -> float:
        """Area of the face, mm2."""
        return float(self.areas.sum())

    @cached_property
    def centroid(self) -> Array:
        """Area-weighted centroid (3,), mm."""
        return np.asarray(self.areas @ self.centres / self.areas.sum())

    def rms(self, normal: Array) -> float:
        """Return how far it departs from the plane with a normal (3,), root mean square, mm."""
        height = (self.centres - self.centroid) @ normal
        return float(np.sqrt(self.areas @ (height - self.areas @ height / self.area) ** 2 / self.area))


@dataclass(frozen=True)
class Cone:
    """The triangles of a region that look about against a direction.

    ``points`` (n, 3 or 6) are its vertices, before and after a correction for blur, mm; ``across`` (m, 3)
    the directions in which areas of its faces count, None where all do.
    """

    y_axis: Array
    points: Array
    faces: Faces
    normals: Array
    ends: NDArray[np.bool_]
    across: Array | None

    @classmethod
    def of(cls, region: Region, normals: Array, y_axis: Array, cosine: float) -> Cone:
        """Cut the cone out of a region, for one field of normals."""
        near = -(normals @ y_axis) > cosine - _MARGIN
        kept = np.any(near[region.faces], axis=1)
        faces, across = region.faces[kept], None if region.across is None else region.across[kept]
        if not len(faces):
            raise no_face("a body without such a face")
        used, place = np.unique(faces, return_inverse=True)
        points, before = region.points, region.diffusion.points
        points = points[used] if points is before else np.hstack([before[used], points[used]])
        return cls(y_axis, points, place.reshape(-1, 3), normals[used], region.ends[used], across)

    @cached_property
    def sizes(self) -> tuple[Array, Array]:
        """Areas (m,) and centres (m, 3) of its faces."""
        return _sizes(self.points[self.faces], self.across)

    def face(self, y_axis: Array, cosine: float, border: bool = False) -> Face:
        """Cut the face out, with the triangles that pass the angle; its border only if asked for."""
        field = -(self.normals @ y_axis) - cosine
        inside = field > 0.0
        piece = self._pieces(inside)
        count = inside[self.faces].sum(axis=1)
        # The corner that is alone on its side of the angle comes first, in the sense of the triangle.
        one, two = (
            np.take_along_axis(cut, (np.argmax(inside[cut] == alone, axis=1)[:, None] + np.arange(3)) % 3, 1)
            for cut, alone in ((self.faces[count == 1], True), (self.faces[count == 2], False))
        )
        values = self.points
        ahead, back = (np.concatenate([one[:, [0, a]], two[:, [0, b]]]) for a, b in ((1, 2), (2, 1)))
        starts, stops = (_crossings(values, field, edges) for edges in (ahead, back))
        first, last = starts[len(one) :], stops[len(one) :]
        corners = [
            np.stack([values[one[:, 0]], starts[: len(one)], stops[: len(one)]], axis=1),
            np.stack([last, values[two[:, 1]], values[two[:, 2]]], axis=1),
            np.stack([last, values[two[:, 2]], first], axis=1),
        ]
        along = None
        if self.across is not None:
            along = np.concatenate([self.across[count == number] for number in (1, 2, 2)])
        parts, whole = _sizes(np.concatenate(corners), along), count == 3
        areas, centres = (
            np.concatenate([own[whole], cut]) for own, cut in zip(self.sizes, parts, strict=True)
        )
        of = piece[np.concatenate([self.faces[whole, 0], one[:, 0], two[:, 1], two[:, 1]])]
        largest = int(np.argmax(np.bincount(of, areas)))
        kept = of == largest
        outline, segments, slopes = np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0)
        if border:
            own = piece[np.concatenate([one[:, 0], two[:, 1]])] == largest
            segments = np.stack([starts[own, -3:], stops[own, -3:]], axis=1)
            slope = _slope(values[:, :3], self.faces, field)[:, None]
            slopes = np.mean([_crossings(slope, field, edges[own])[:, 0] for edges in (ahead, back)], axis=0)
            keys = (np.sort(edges[own], axis=1) @ [len(field), 1] for edges in (ahead, back))
            outline = _longest_line(segments, *keys)
        reaches_end = bool(np.any(self.ends & inside & (piece == largest)))
        return Face(centres[kept], areas[kept], outline, segments, slopes, reaches_end)

    def _pieces(self, inside: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the number of the connected part (n,) of each vertex inside."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        if not inside.any():
            raise no_face("a body without such a face")
        ends = self.faces[:, [0, 1, 2]].ravel(), self.faces[:, [1, 2, 0]].ravel()
        both = inside[ends[0]] & inside[ends[1]]
        links = coo_array((both[both], (ends[0][both], ends[1][both])), shape=(len(inside),) * 2)
        return np.asarray(connected_components(links, directed=False)[1])


def _sizes(corners: Array, across: Array | None) -> tuple[Array, Array]:
    """Return areas (m,) and centres (m, 3) of triangles (m, 3, 3 or 6)."""
    a, b, c = (corners[:, k, :3] for k in range(3))
    vectors = 0.5 * np.cross(b - a, c - a)
    if across is None:
        areas = np.linalg.norm(vectors, axis=1)
    else:
        areas = np.maximum(np.sum(vectors * across, axis=1), 0.0)
    return areas, corners[:, :, -3:].mean(axis=1)


def _crossings(values: Array, field: Array, pairs: NDArray[np.intp]) -> Array:
    """Return values (m, k) where a linear field (n,) passes zero between two vertices (m, 2)."""
    a, b = pairs.T
    share = field[a] / (field[a] - field[b])
    return np.asarray(values[a] + share[:, None] * (values[b] - values[a]))


def _slope(points: Array, faces: Faces, field: Array) -> Array:
    """Return the length of the surface gradient of a field (n,) at the vertices (n, 3), 1/mm."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    double = np.linalg.norm(area, axis=1)
    across = field[faces[:, [0]]] * (c - b) + field[faces[:, [1]]] * (a - c) + field[faces[:, [2]]] * (b - a)
    weighted = np.column_stack([np.linalg.norm(across, axis=1), double])
    total = sum_at_corners(faces, weighted, len(points))
    return np.asarray(total[:, 0] / np.maximum(total[:, 1], 1e-30))


def _longest_line(segments: Array, starts: NDArray[np.intp], stops: NDArray[np.intp]) -> Array:
    """Return the longest line (n, 3) of segments (s, 2, 3), which join where they cross one edge."""
    after = dict(zip(starts.tolist(), range(len(starts)), strict=True))
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    free, best, longest = set(after.values()), [], -1.0
    for first in (*np.flatnonzero(~np.isin(starts, stops)).tolist(), *range(len(starts))):  # open lines first
        line, place = [], first
        while place in free:
            free.remove(place)
            line.append(place)
            place = after.get(int(stops[place]), -1)
        if line and lengths[line].sum() > longest:
            best, longest = line, float(lengths[line].sum())
    return segments[best, 0]


def no_face(got: str) -> StapeskitError:
    """Return the refusal of a body in which there is no footplate."""
    expected = "a stapes with a footplate: a near-planar face at one end"
    return StapeskitError.of("the surface", expected, got, next_step=_NEXT_STEP)

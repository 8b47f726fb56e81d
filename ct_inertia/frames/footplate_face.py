"""The medial face of the footplate: cut out of a surface by pyvista, its plane, the fixed point of both.

The definition. On the surface, n are the outward normals diffused over 0.05 mm. For a direction y the
medial face F(y) is the largest connected part where n lies within 60 degrees of -y. Then y is the normal of
the robust plane of F(y) into the body (lateral, towards the head): a fixed point; the origin is the
area-weighted centroid of F(y) in space; x is the long principal axis of the area within the outline of
F(y), projected on that plane; z = x cross y. The scale of 0.05 mm makes the frame one of the bone and not
of the voxels or triangles it is known by.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ct_inertia.surface.fields import Diffusion, refined, sum_at_corners, unit
from ct_inertia.surface.surface import Surface, as_mesh
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from pyvista import PolyData

FACE_ANGLE_DEG = 60.0
NORMAL_SCALE_MM = 0.05
PLANE_SCALE_MM = 0.03
"""Numbers of the definition: other values define another frame (docs/conventions.md states them, too)."""

EDGE_MM = 0.04
"""Longest edges of triangles after refinement: below the scale of the normals."""

_DEPTH_MM, _DEEPER = 0.6, 1.5  # of the region around a footplate; deeper where the face reaches its end
_CONE_MARGIN = 0.15  # cosines beyond the face's angle that the working part of the region keeps
_CONE_TURN = 0.05  # turn of y (rad) after which that part is cut anew: a third of the margin
_ROUNDS = 60  # most iterations of the fixed point and of its plane: a guard against cycles
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
class Region:
    """The part of the surface around a footplate, its triangles refined to the scale of the definition.

    Attributes
    ----------
    mesh : PolyData
        About ``middle``, for single precision in filters.
    middle : ndarray, (3,)
        mm, scan coordinates.
    points : ndarray, (n, 3)
        Its vertices, corrected for a blur that is left in the surface.
    normals : ndarray, (n, 3)
        Unit normals on the scale of the definition.
    diffusion : Diffusion
    ends : ndarray of bool, (n,)
        Vertices where the region ends.
    edge_mm : float
        Median length of the edges before they were refined.
    """

    mesh: PolyData
    middle: Array
    points: Array
    normals: Array
    diffusion: Diffusion
    ends: NDArray[np.bool_]
    edge_mm: float

    @cached_property
    def smoother(self) -> Array:
        """Unit normals (n, 3) after one more step of diffusion."""
        return unit(self.diffusion.step(self.normals))


@dataclass(frozen=True)
class Solved:
    """A fixed point of the definition.

    Attributes
    ----------
    region : Region
    face : Face
    axes : ndarray, (3, 3)
        x, y, z in columns, scan axes.
    elongation : float
        Root of the ratio of the principal moments of the outline.
    """

    region: Region
    face: Face
    axes: Array
    elongation: float

    @property
    def origin(self) -> Array:
        """Footplate centre (3,), scan coordinates, mm."""
        return np.asarray(self.face.centroid + self.region.middle)

    def turned(self, sign: float) -> Solved:
        """Return the frame turned half way about y when ``sign`` is negative."""
        return replace(self, axes=self.axes * np.array([sign, 1.0, sign]))


def solve_at(surface: Surface, outward: Array, extent_mm: float, blur_mm: float) -> Solved:
    """Solve for the face at one extremity, in a region deep enough to hold the face whole.

    Parameters
    ----------
    surface : Surface
    outward : ndarray, (3,)
        About -y, unit.
    extent_mm : float
        Diameter of the body.
    blur_mm : float
        Blur that is left in the surface.

    Raises
    ------
    StapeskitError
        No region holds the face whole: it is no part of a closed surface.
    """
    depth = max(_DEPTH_MM, 0.15 * extent_mm)
    while True:
        solved = solve(region_around(surface, outward, depth, blur_mm), -outward)
        if not solved.face.reaches_end:
            return solved
        if depth > extent_mm:
            raise _no_face("a face with an open outline")
        depth *= _DEEPER


def region_around(surface: Surface, outward: Array, depth_mm: float, blur_mm: float) -> Region:
    """Cut out what lies within a depth of the extreme plane across a direction.

    Notes
    -----
    Blur moves an iso surface inward where it is convex, by blur^2 / 2 times the sum of the principal
    curvatures; one step of diffusion on the scale s moves it by s^2 / 4 times its mean curvature vector. So
    blur is taken back.
    """
    middle = np.round(surface.vertices_mm.mean(axis=0), 3)
    mesh = surface.mesh()
    mesh.points = mesh.points - middle
    limit = float(np.max(mesh.points @ outward)) - depth_mm
    mesh = mesh.clip(normal=-outward, origin=outward * limit).triangulate()
    corners = mesh.points[mesh.regular_faces]
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)))
    mesh = refined(mesh.clean(), EDGE_MM).clean().triangulate()
    points, faces = np.asarray(mesh.points, dtype=float), np.asarray(mesh.regular_faces, dtype=np.int64)
    diffusion = Diffusion(points, faces, NORMAL_SCALE_MM)
    ends = points @ outward < limit + 1e-6
    if blur_mm > 0.0:
        normals = unit(diffusion.normals())
        lift = 2.0 * (blur_mm / NORMAL_SCALE_MM) ** 2 * (points - diffusion.step(points))
        points = points + np.einsum("ij,ij->i", lift, normals)[:, None] * normals
    return Region(mesh, middle, points, unit(diffusion.normals(points)), diffusion, ends, edge)


@dataclass(frozen=True)
class _Cone:
    """The triangles of a region that look about against a direction."""

    y_axis: Array
    mesh: PolyData
    normals: Array
    ends: NDArray[np.bool_]

    @classmethod
    def of(cls, region: Region, normals: Array, y_axis: Array, cosine: float) -> _Cone:
        """Cut the cone out of a region, for one field of normals."""
        faces = region.mesh.regular_faces
        near = -(normals @ y_axis) > cosine - _CONE_MARGIN
        faces = faces[np.any(near[faces], axis=1)]
        if not len(faces):
            raise _no_face("a body without such a face")
        used, place = np.unique(faces, return_inverse=True)
        mesh = as_mesh(np.asarray(region.mesh.points)[used], place.reshape(-1, 3))
        mesh.point_data["place"] = region.points[used]
        return cls(y_axis, mesh, normals[used], region.ends[used])

    def face(self, y_axis: Array, cosine: float, border: bool = False) -> Face:
        """Cut the face out; its border only where it is asked for."""
        field = -(self.normals @ y_axis) - cosine
        self.mesh.point_data["field"] = field
        self.mesh.point_data["end"] = self.ends.astype(float)
        if border:
            self.mesh.point_data["slope"] = _slope(self.mesh, field)
        patch = self.mesh.clip_scalar(scalars="field", value=0.0, invert=False)
        if not patch.n_cells:
            raise _no_face("a body without such a face")
        patch = patch.triangulate().connectivity("all")
        faces = np.asarray(patch.regular_faces)
        corners = np.asarray(patch.points, dtype=float)[faces]
        areas = 0.5 * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        of = np.asarray(patch.cell_data["RegionId"])
        kept = of == int(np.argmax(np.bincount(of, areas)))
        places = np.asarray(patch.point_data["place"], dtype=float)
        outline, segments, slopes = np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0)
        if border:
            outline, segments, slopes = _border(
                patch.extract_cells(kept).extract_surface(algorithm="dataset_surface")
            )
        ends = bool(np.any(np.asarray(patch.point_data["end"])[faces[kept]] > 0.5))
        return Face(places[faces[kept]].mean(axis=1), areas[kept], outline, segments, slopes, ends)


def _slope(mesh: PolyData, field: Array) -> Array:
    """Return the length of the surface gradient of a field (n,) at the vertices, 1/mm."""
    faces, points = np.asarray(mesh.regular_faces), np.asarray(mesh.points, dtype=float)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    double = np.linalg.norm(area, axis=1)
    across = field[faces[:, [0]]] * (c - b) + field[faces[:, [1]]] * (a - c) + field[faces[:, [2]]] * (b - a)
    weighted = np.column_stack([np.linalg.norm(across, axis=1), double])
    total = sum_at_corners(faces, weighted, len(points))
    return np.asarray(total[:, 0] / np.maximum(total[:, 1], 1e-30))


def _border(patch: PolyData) -> tuple[Array, Array, Array]:
    """Return the longest line (n, 3) of a patch's border, all its pieces (s, 2, 3), the slopes there."""
    edges = patch.extract_feature_edges(
        boundary_edges=True, feature_edges=False, manifold_edges=False, non_manifold_edges=False
    )
    places = np.asarray(edges.point_data["place"], dtype=float)
    pairs = np.asarray(edges.lines).reshape(-1, 3)[:, 1:]
    slopes = np.asarray(edges.point_data["slope"], dtype=float)[pairs].mean(axis=1)
    lines = np.asarray(edges.strip(join=True, max_length=10**6).lines)
    best, longest, place = np.zeros((0, 3)), -1.0, 0
    while place < len(lines):
        line = places[lines[place + 1 : place + 1 + lines[place]]]
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        if length > longest:
            best, longest = line, length
        place += 1 + int(lines[place])
    closed = len(best) > 1 and np.allclose(best[0], best[-1])
    return best[:-1] if closed else best, places[pairs], slopes


def solve(
    region: Region,
    y_axis: Array,
    angle_deg: float = FACE_ANGLE_DEG,
    normals: Array | None = None,
    accuracy: float = 1e-8,
) -> Solved:
    """Iterate face -> plane -> direction to the fixed point; the sign of x is left open.

    Parameters
    ----------
    region : Region
    y_axis : ndarray, (3,)
        Where to begin.
    angle_deg : float
    normals : ndarray, (n, 3), optional
        Other normals than those of the definition.
    accuracy : float
        Of y, rad.

    Raises
    ------
    StapeskitError
        No part of the region looks that way.
    """
    field = region.normals if normals is None else normals
    cosine = float(np.cos(np.radians(angle_deg)))
    cone = _Cone.of(region, field, y_axis, cosine)
    tried: list[tuple[Array, Array]] = []
    for _ in range(_ROUNDS):
        change = plane_normal(cone.face(y_axis, cosine), y_axis, 0.01 * accuracy) - y_axis
        tried = [*tried[-2:], (y_axis, change)]
        y_axis = unit(_extrapolated(tried))
        if np.linalg.norm(change) < accuracy:
            break
        if np.linalg.norm(y_axis - cone.y_axis) > _CONE_TURN:
            cone = _Cone.of(region, field, y_axis, cosine)
    face = cone.face(y_axis, cosine, border=True)
    moments, across = _outline_moments(face, y_axis)
    values, vectors = np.linalg.eigh(moments)
    x_axis = unit(across @ vectors[:, 1])
    # An outline that crosses itself may have no positive moment: no axis of it is long.
    ratio = values[1] / values[0] if values[0] > 0.0 else 1.0
    axes = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    return Solved(region, face, axes, float(np.sqrt(ratio)))


def plane_weights(distance_mm: Array) -> Array:
    """Return the weights (n,) of the robust plane: a smooth, convex form of Huber's."""
    return np.asarray(1.0 / np.sqrt(1.0 + (distance_mm / PLANE_SCALE_MM) ** 2))


def plane_normal(face: Face, start: Array, accuracy: float) -> Array:
    """Return the normal of the plane with the least sum of area times robust distance."""
    normal, offset = start, float(face.centroid @ start)
    for _ in range(_ROUNDS):
        weights = face.areas * plane_weights(face.centres @ normal - offset)
        centre = weights @ face.centres / weights.sum()
        away = face.centres - centre
        vectors = np.linalg.eigh((away * weights[:, None]).T @ away)[1]
        new = vectors[:, 0] * np.sign(vectors[:, 0] @ start)
        step = float(np.linalg.norm(new - normal))
        normal, offset = new, float(centre @ new)
        if step < accuracy:
            break
    return normal


def _extrapolated(tried: list[tuple[Array, Array]]) -> Array:
    """Return where the change vanishes, from the last places (3,) and the changes (3,) that they ask for.

    Notes
    -----
    Anderson's mixing (1965, J. ACM 12:547) over at most three places: a direction has two freedoms.
    """
    place, change = tried[-1]
    if len(tried) == 1:
        return place + change
    moves = np.column_stack([place - earlier for earlier, _ in tried[:-1]])
    answers = np.column_stack([change - earlier for _, earlier in tried[:-1]])
    share = np.linalg.lstsq(answers, change, rcond=1e-3)[0]
    step = change - (moves + answers) @ share
    most = 3.0 * float(np.linalg.norm(change))
    return np.asarray(place + step * min(1.0, most / max(float(np.linalg.norm(step)), 1e-30)))


def _outline_moments(face: Face, y_axis: Array) -> tuple[Array, Array]:
    """Return second moments (2, 2) of the area in the projected outline, and their two directions (3, 2)."""
    first = unit(np.cross(y_axis, np.eye(3)[int(np.argmin(np.abs(y_axis)))]))
    across = np.column_stack([first, np.cross(first, y_axis)])
    if len(face.outline) < 3:
        raise _no_face("a face at its end that bends away without an edge")
    u, v = ((face.outline - face.centroid) @ across).T
    u2, v2 = np.roll(u, -1), np.roll(v, -1)
    cross = u * v2 - u2 * v
    area = cross.sum() / 2.0
    cu, cv = (u + u2) @ cross / (6.0 * area), (v + v2) @ cross / (6.0 * area)
    uu = (u * u + u * u2 + u2 * u2) @ cross / 12.0 / area - cu * cu
    vv = (v * v + v * v2 + v2 * v2) @ cross / 12.0 / area - cv * cv
    uv = (u * v2 + 2.0 * u * v + 2.0 * u2 * v2 + u2 * v) @ cross / 24.0 / area - cu * cv
    return np.array([[uu, uv], [uv, vv]]), across


def _no_face(got: str) -> StapeskitError:
    expected = "a stapes with a footplate: a near-planar face at one end"
    return StapeskitError.of("the surface", expected, got, next_step=_NEXT_STEP)

"""The medial face of the footplate: its region on a surface, its plane, the fixed point of both.

The definition. On the surface, n are the outward normals diffused over 0.05 mm. For a direction y the
medial face F(y) is the largest connected part where n lies within 60 degrees of -y. Then y is the normal of
the robust plane of F(y) into the body (lateral, towards the head): a fixed point; the origin is the
area-weighted centroid of F(y) in space; x is the long principal axis of the area within the outline of
F(y), projected on that plane; z = x cross y. The scale of 0.05 mm makes the frame one of the bone and not
of the voxels or triangles it is known by.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import BodySurface
from ct_inertia.frames.footplate_cut import Cone, Face, no_face
from ct_inertia.surface.fields import Diffusion, refined, ring_normals, unit
from ct_inertia.surface.surface import Faces, Surface, chosen_part
from stapeskit.arrays import Array

FACE_ANGLE_DEG = 60.0
NORMAL_SCALE_MM = 0.05
PLANE_SCALE_MM = 0.03
"""Numbers of the definition: other values define another frame (docs/conventions.md states them, too)."""

EDGE_MM = 0.04
"""Longest edges of triangles after refinement: below the scale of the normals."""

_DEPTH_MM, _DEEPER = 0.6, 1.5  # of the region around a footplate; deeper where the face reaches its end
_CONE_TURN = 0.05  # turn of y (rad) after which that part is cut anew: a third of its margin
_MOST_MM2 = 100.0  # of that part: all of a stapes has 15 to 40; memory grows with it at fixed edges
_ROUNDS, _STILL_RAD = 60, 1e-5  # of the fixed point and of its plane: a hundredth of what noise leaves


@dataclass(frozen=True)
class Region:
    """The part of the surface around a footplate, its triangles refined to the scale of the definition.

    Attributes
    ----------
    faces : ndarray of int, (m, 3)
    middle : ndarray, (3,)
        mm, scan coordinates.
    points : ndarray, (n, 3)
        Its vertices about ``middle``, corrected for a blur that is left in the surface.
    normals : ndarray, (n, 3)
        Unit normals on the scale of the definition.
    across : ndarray, (m, 3), or None
        Directions in which the area of its triangles counts, averaged over their neighbours: noise makes a
        surface rough, not large. None: a mesh without noise.
    ends : ndarray of bool, (n,)
        Vertices where the region ends.
    edge_mm : float
        Median length of the edges before they were refined.
    """

    faces: Faces
    middle: Array
    points: Array
    normals: Array
    diffusion: Diffusion
    across: Array | None
    ends: NDArray[np.bool_]
    edge_mm: float

    def sharpened(self, blur_mm: float) -> Region:
        """Return the region with a blur of its surface taken back."""
        points = self.diffusion.sharpened(blur_mm)
        return replace(self, points=points, normals=unit(self.diffusion.normals(points)))


@dataclass(frozen=True)
class Solved:
    """A fixed point of the definition.

    Attributes
    ----------
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


def solve_at(surface: Surface, outward: Array, extent_mm: float, body: BodySurface | None = None) -> Solved:
    """Solve for the face at one extremity, in a region deep enough to hold the face whole.

    ``outward`` (3,), unit, is about -y; ``extent_mm``: diameter of the body; ``body``: how the surface errs.

    Raises
    ------
    StapeskitError
        No region holds the face whole: it is no part of a closed surface.
    """
    depth = max(_DEPTH_MM, 0.1 * extent_mm)
    while True:
        region = region_around(surface, outward, depth, body)
        face, y_axis = _fixed_point(region, -outward, region.normals)
        if not face.reaches_end:
            return _with_axes(region, face, y_axis)
        if depth > extent_mm:
            raise no_face("a face with an open outline")
        depth *= _DEEPER


def region_around(surface: Surface, outward: Array, depth_mm: float, body: BodySurface | None) -> Region:
    """Cut out what lies within a depth of the extreme plane across a direction, and take its blur back."""
    middle = np.round(surface.vertices_mm.mean(axis=0), 3)
    points, faces = surface.vertices_mm - middle, surface.faces
    limit = float((points @ outward).max()) - depth_mm
    points, faces = chosen_part(points, faces, np.any((points @ outward > limit)[faces], axis=1))
    area = float(np.linalg.norm(Surface(points, faces).area_vectors_mm2, axis=1).sum())
    if area > _MOST_MM2:
        raise no_face(f"{area:.0f} mm2 of surface at that end, too large for a stapes")
    corners = points[faces]
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)))
    points, faces = refined(points, faces, EDGE_MM)
    points, faces = chosen_part(points, faces, np.any((points @ outward > limit)[faces], axis=1))
    diffusion = Diffusion(points, faces, NORMAL_SCALE_MM)
    ends = points @ outward <= limit
    across = None if body is None else ring_normals(Surface(points, faces))
    region = Region(faces, middle, points, unit(diffusion.normals()), diffusion, across, ends, edge)
    return region.sharpened(body.blur_mm) if body is not None and body.blur_mm > 0.0 else region


def solve(region: Region, y_axis: Array, normals: Array | None = None) -> Solved:
    """Iterate face -> plane -> direction to the fixed point, from a y axis (3,); the sign of x is left open.

    ``normals`` (n, 3): others than those of the definition.

    Raises
    ------
    StapeskitError
        No part of the region looks that way, or it has no edge: its outline has no long axis.
    """
    return _with_axes(region, *_fixed_point(region, y_axis, region.normals if normals is None else normals))


def _fixed_point(region: Region, y_axis: Array, field: Array) -> tuple[Face, Array]:
    cosine = float(np.cos(np.radians(FACE_ANGLE_DEG)))
    cone = Cone.of(region, field, y_axis, cosine)
    for _ in range(_ROUNDS):
        before, y_axis = y_axis, plane_normal(cone.face(y_axis, cosine), y_axis)
        if np.linalg.norm(y_axis - before) < _STILL_RAD:
            break
        if np.linalg.norm(y_axis - cone.y_axis) > _CONE_TURN:
            cone = Cone.of(region, field, y_axis, cosine)
    return cone.face(y_axis, cosine, border=True), y_axis


def _with_axes(region: Region, face: Face, y_axis: Array) -> Solved:
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


def plane_normal(face: Face, start: Array) -> Array:
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
        if step < 0.01 * max(_STILL_RAD, float(np.linalg.norm(new - start))):  # of how far the face has moved
            break
    return normal


def _outline_moments(face: Face, y_axis: Array) -> tuple[Array, Array]:
    """Return second moments (2, 2) of the area in the projected outline, and their two directions (3, 2)."""
    first = unit(np.cross(y_axis, np.eye(3)[int(np.argmin(np.abs(y_axis)))]))
    across = np.column_stack([first, np.cross(first, y_axis)])
    if len(face.outline) < 3:
        raise no_face("a face at its end that bends away without an edge")
    u, v = ((face.outline - face.centroid) @ across).T
    u2, v2 = np.roll(u, -1), np.roll(v, -1)
    cross = u * v2 - u2 * v
    area = cross.sum() / 2.0
    cu, cv = (u + u2) @ cross / (6.0 * area), (v + v2) @ cross / (6.0 * area)
    uu = (u * u + u * u2 + u2 * u2) @ cross / 12.0 / area - cu * cu
    vv = (v * v + v * v2 + v2 * v2) @ cross / 12.0 / area - cv * cv
    uv = (u * v2 + 2.0 * u * v + 2.0 * u2 * v2 + u2 * v) @ cross / 24.0 / area - cu * cv
    return np.array([[uu, uv], [uv, vv]]), across

"""The medial face of the footplate: cut out of a surface, its robust plane, the fixed point of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.surface.surface_field import (
    Diffusion,
    Mesh,
    Patch,
    outer_loop,
    positive_patch,
    refine_edges,
    unit,
)
from legacy.stapeskit.arrays import Array

# Definition of the footplate frame: the medial face is what faces medially within this angle, its normals
# averaged over this length; its plane is the robust fit with this scale. Other values define another frame:
# docs/conventions.md and its picture state them, too. No other cone of the code is this one.
FACE_ANGLE_DEG = 60.0
NORMAL_SCALE_MM = 0.05
PLANE_SCALE_MM = 0.03
# Longest edges of triangles after refinement, mm: below the scale of the normals on a mesh; on a surface of
# grey values, which the blur has smoothed, twice as long for a quarter of the triangles.
EDGE_MM = 0.04
SEEN_EDGE_MM = 0.08
# Depth of the region around a footplate; deeper, by this factor, where the face reaches the region's end.
_DEPTH_MM, _DEEPER = 0.6, 1.5
_GRAIN_OF_BLUR = calibrated("footplate_face.grain_of_blur")
_GRAIN_OF_EDGE = calibrated("footplate_face.grain_of_edge")
# The part of the surface that is searched for the face: its cosines reach this far below that of the angle,
# and it is cut out anew when the axis has turned by this much (rad), which changes cosines by less.
_CONE_MARGIN = 0.15
_CONE_TURN = 0.05
# Most iterations of the fixed point and of its plane: a guard against cycles.
_ROUNDS = 100


@dataclass(frozen=True)
class Face:
    """A medial face cut out of the surface."""

    patch: Patch
    centres: Array
    areas: Array
    centroid: Array

    @property
    def area(self) -> float:
        """Area of the face, mm2."""
        return float(self.areas.sum())

    def rms(self, normal: Array) -> float:
        """Return how far it departs from the plane with a normal (3,), root mean square, mm."""
        height = (self.centres - self.centroid) @ normal
        return float(np.sqrt(self.areas @ (height - self.areas @ height / self.area) ** 2 / self.area))


@dataclass(frozen=True)
class Region:
    """The part of the surface around the footplate: ``points`` (n, 3) are corrected for the blur.

    ``normals`` and ``smoother`` (n, 3) are its normals on the scale of the definition and on the next one;
    ``grain_mm`` is the standard deviation of what its grid takes of short waves, ``edge_mm`` the length of
    the edges of its triangles before refinement.
    """

    mesh: Mesh
    points: Array
    diffusion: Diffusion
    resolution_mm: float
    blur_mm: float
    grain_mm: float
    normals: Array
    smoother: Array
    edge_mm: float


@dataclass(frozen=True)
class _Cone:
    """The part of a region that looks about against a direction, for one field of normals."""

    y_axis: Array
    mesh: Mesh
    points: Array
    normals: Array
    areas: Array


@dataclass(frozen=True)
class Solved:
    """A fixed point of the definition: origin (3,) and axes (3, 3) in scan coordinates."""

    region: Region
    face: Face
    origin: Array
    axes: Array
    elongation: float

    def turned(self, sign: float) -> Solved:
        """Return the frame turned half way about y when ``sign`` is negative."""
        axes = self.axes * np.array([sign, 1.0, sign])
        return Solved(self.region, self.face, self.origin, axes, self.elongation)


def solve_at(mesh: Mesh, outward: Array, extent_mm: float, blur_mm: float) -> Solved:
    """Solve for the face at one extremity, in a region deep enough to hold the face whole.

    Raises
    ------
    CtInertiaError
        The outline of the face is open in every region: the face is no part of a closed surface.
    """
    depth = max(_DEPTH_MM, 0.15 * extent_mm)
    while True:
        solved = solve(region_around(mesh, outward, depth, extent_mm, blur_mm), -outward)
        if not solved.face.patch.reaches_border:
            return solved
        if depth > extent_mm:
            raise _no_face_error("a face with an open outline")
        depth *= _DEEPER


def region_around(mesh: Mesh, outward: Array, depth_mm: float, extent_mm: float, blur_mm: float) -> Region:
    """Cut out what lies within a depth of the extreme plane and refine it to the scale of the definition."""
    height = mesh.points @ outward
    part = mesh.part(height > height.max() - depth_mm)
    corners = part.points[part.faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
    part = refine_edges(part, max(EDGE_MM if blur_mm == 0.0 else SEEN_EDGE_MM, 0.008 * extent_mm))
    diffusion = Diffusion(part, NORMAL_SCALE_MM)
    points = part.points if blur_mm == 0.0 else correct_blur(diffusion, blur_mm)
    normals = diffusion.normals(points)
    smoother = diffusion.step(normals)
    known = blur_mm > 0.0
    resolution = blur_mm if known else float(np.median(edges))
    grain = (_GRAIN_OF_BLUR if known else _GRAIN_OF_EDGE) * resolution
    edge = float(np.median(edges))
    return Region(part, points, diffusion, resolution, blur_mm, grain, unit(normals), unit(smoother), edge)


def correct_blur(diffusion: Diffusion, blur_mm: float) -> Array:
    """Return the vertices (n, 3) corrected for the blur, by a shift along the normals."""
    normals = unit(diffusion.normals())
    return np.asarray(
        diffusion.mesh.points + blur_displacement(diffusion, blur_mm, normals)[:, None] * normals
    )


def blur_displacement(diffusion: Diffusion, blur_mm: float, normals: Array) -> Array:
    """Return how far blur has moved each vertex (n,) inward, mm, along unit normals (n, 3).

    Notes
    -----
    One step of diffusion on the scale s moves the surface by s^2 / 4 times its mean curvature vector, the
    blur b by b^2 / 2 times it.
    """
    lift = 2.0 * (blur_mm / diffusion.sigma_mm) ** 2 * (diffusion.mesh.points - diffusion.diffused_points)
    return np.asarray(np.einsum("ij,ij->i", lift, normals))


def _cone(region: Region, y_axis: Array, cosine: float, normals: Array) -> _Cone:
    near = -(normals @ y_axis) > cosine - _CONE_MARGIN
    mesh, used = region.mesh.with_faces(np.any(near[region.mesh.faces], axis=1))
    return _Cone(y_axis, mesh, region.points[used], normals[used], region.diffusion.mass[used])


def _face(cone: _Cone, y_axis: Array, cosine: float) -> Face:
    field = -(cone.normals @ y_axis) - cosine
    patch = positive_patch(cone.mesh, field, cone.areas, cone.points)
    if patch is None:
        raise _no_face_error("a body without such a face")
    centres = patch.triangles[:, 0] + patch.triangles[:, 1] + patch.triangles[:, 2]
    centres /= 3.0
    return Face(patch, centres, patch.areas, patch.areas @ centres / patch.areas.sum())


def _no_face_error(got: str) -> CtInertiaError:
    return CtInertiaError.of(
        "the surface",
        "a stapes with a footplate: a near-planar face at one end",
        f"no object that can be a stapes: {got}",
        next_step="Check the segmentation or the mesh, or correct it with {seed} or {labels}",
    )


def plane_weights(distance_mm: Array) -> Array:
    """Return the weights (n,) of the robust plane fit: a smooth form of Huber's, convex, scale 0.03 mm."""
    return np.asarray(1.0 / np.sqrt(1.0 + (distance_mm / PLANE_SCALE_MM) ** 2))


def _plane_normal(face: Face, start: Array, accuracy: float = 1e-10) -> Array:
    """Return the normal of the plane with the least sum of area times robust distance."""
    normal, offset = start, float(face.centroid @ start)
    for _ in range(_ROUNDS):
        weights = face.areas * plane_weights(face.centres @ normal - offset)
        centre = weights @ face.centres / weights.sum()
        away = face.centres - centre
        _, vectors = np.linalg.eigh((away * weights[:, None]).T @ away)
        new = vectors[:, 0] * np.sign(vectors[:, 0] @ start)
        step = float(np.linalg.norm(new - normal))
        normal, offset = new, float(centre @ new)
        if step < accuracy:
            break
    return normal


def solve(
    region: Region,
    y_axis: Array,
    angle_deg: float = FACE_ANGLE_DEG,
    normals: Array | None = None,
    accuracy: float = 1e-8,
) -> Solved:
    """Iterate face -> plane -> direction to the fixed point; the sign of x is left open."""
    field_normals = region.normals if normals is None else normals
    cosine = float(np.cos(np.radians(angle_deg)))
    cone = _cone(region, y_axis, cosine, field_normals)
    tried: list[tuple[Array, Array]] = []
    step = 30.0 * accuracy if normals is not None or angle_deg != FACE_ANGLE_DEG else 0.02
    for _ in range(_ROUNDS):
        face = _face(cone, y_axis, cosine)
        change = _plane_normal(face, y_axis, max(0.01 * step, 0.01 * accuracy)) - y_axis
        step = float(np.linalg.norm(change))
        tried = [*tried[-2:], (y_axis, change)]
        y_axis = unit(_extrapolate(tried)[None])[0]
        if step < accuracy:
            break
        if np.linalg.norm(y_axis - cone.y_axis) > _CONE_TURN:
            cone = _cone(region, y_axis, cosine, field_normals)
    face = _face(cone, y_axis, cosine)
    moments, helper, across = _outline_moments(face, y_axis)
    values, vectors = np.linalg.eigh(moments)
    x_axis = vectors[0, 1] * helper + vectors[1, 1] * across
    axes = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    # An outline that crosses itself may have no positive moment: no axis of it is long.
    ratio = values[1] / values[0] if values[0] > 0.0 else 1.0
    return Solved(region, face, face.centroid, axes, float(np.sqrt(ratio)))


def _extrapolate(tried: list[tuple[Array, Array]]) -> Array:
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


def _outline_moments(face: Face, y_axis: Array) -> tuple[Array, Array, Array]:
    """Return second moments (2, 2) of the area in the projected outline, and their two directions."""
    helper = np.cross(y_axis, np.eye(3)[int(np.argmin(np.abs(y_axis)))])
    helper = helper / np.linalg.norm(helper)
    across = np.cross(helper, y_axis)
    loop = outer_loop(face.patch) - face.centroid
    if len(loop) < 3:
        raise _no_face_error("no footplate face found, for the face at its end bends away without an edge")
    u, v = loop @ helper, loop @ across
    u2, v2 = np.roll(u, -1), np.roll(v, -1)
    cross = u * v2 - u2 * v
    area = cross.sum() / 2.0
    cu, cv = ((u + u2) @ cross / (6.0 * area), (v + v2) @ cross / (6.0 * area))
    uu = (u * u + u * u2 + u2 * u2) @ cross / 12.0 / area - cu * cu
    vv = (v * v + v * v2 + v2 * v2) @ cross / 12.0 / area - cv * cv
    uv = (u * v2 + 2.0 * u * v + 2.0 * u2 * v2 + u2 * v) @ cross / 24.0 / area - cu * cv
    return np.array([[uu, uv], [uv, vv]]), helper, across

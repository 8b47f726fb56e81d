"""The footplate frame: centre of the medial face, piston direction, long axis, with their covariance.

The definition. On the surface, let n be the outward normals diffused over 0.05 mm, and for a direction y
let the medial face F(y) be the connected part of the footplate where n lies within 60 degrees of -y. Then

* y is the normal of the robust plane of F(y), pointing into the body (lateral, towards the head): a fixed
  point, found by iteration;
* the origin is the area-weighted centroid of F(y) in space;
* x is the long principal axis of the area within the outline of F(y), projected on that plane;
* z = x cross y.

The scale of 0.05 mm belongs to the definition: it makes the frame one of the bone and not of the voxels
or triangles it is known by.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ct_inertia.anatomy import AnatomyHints, orient_long_axis
from ct_inertia.errors import CtInertiaError
from ct_inertia.footplate_landmarks import check_head, contradiction
from ct_inertia.footplate_noise import boundary_covariance, height_covariance, height_noise
from ct_inertia.footplate_search import FaceCandidate, face_candidates
from ct_inertia.surface_field import Diffusion, Mesh, Patch, outer_loop, positive_patch, refined, unit
from kinematics.errors import sentence
from kinematics.frames import RigidTransform, vector_from_rotation
from kinematics.notices import Notice

Array = NDArray[np.float64]

FACE_ANGLE_DEG = 60.0
NORMAL_SCALE_MM = 0.05
PLANE_SCALE_MM = 0.03
_EDGE_MM = 0.04
_DEPTH_MM = 0.6
_RIM_DEG_PER_MM = 55.0
_BLUR_SHIFT_1_MM = 2.9
_BLUR_TILT_RAD_MM2 = 0.84
_BLUR_MOST_MM = 0.04
_ROUNDS = 100


class SurfaceLike(Protocol):
    """A closed outward surface in scan coordinates: vertices (n, 3) in mm and faces (m, 3)."""

    @property
    def vertices_mm(self) -> Array: ...  # noqa: D102
    @property
    def faces(self) -> NDArray[np.integer]: ...  # noqa: D102


@dataclass(frozen=True)
class FootplateFrame:
    """The footplate frame of a stapes.

    Attributes
    ----------
    scan_from_footplate : RigidTransform
        Axes x anterior, y lateral, z; origin the footplate centre; mm.
    contributions : mapping of str to ndarray, (6, 6)
        Covariance of the frame's displacement in its own axes (m, rad; x, y, z, alpha, beta, gamma) by
        source: ``noise`` of the surface, ``rim`` (where the face ends), its ``resolution`` and ``blur``.
    outline_mm : ndarray, (n, 3)
        Outline of the medial face in footplate coordinates, in order.
    face_area_mm2 : float
        Area of the medial face.
    length_mm, width_mm, height_mm : float
        Extent of the outline along x and z, and of the body along y.
    face_rms_mm : float
        How far the medial face departs from its plane (root mean square).
    anterior_from : str
        What decided the sign of x.
    notices : tuple of Notice
    """

    scan_from_footplate: RigidTransform
    contributions: Mapping[str, Array]
    outline_mm: Array
    face_area_mm2: float
    length_mm: float
    width_mm: float
    height_mm: float
    face_rms_mm: float
    anterior_from: str
    notices: tuple[Notice, ...] = field(default=())

    @property
    def covariance(self) -> Array:
        """Covariance of the frame's displacement in its own axes, (6, 6), m and rad."""
        return sum((np.asarray(part) for part in self.contributions.values()), np.zeros((6, 6)))


def footplate_frame(surface: SurfaceLike, hints: AnatomyHints | None = None) -> FootplateFrame:
    """Find the footplate frame of a stapes' surface.

    Parameters
    ----------
    surface : Surface
        Closed, outward; scan coordinates, mm.
    hints : AnatomyHints, optional
        Where anterior is; without them the sign of x is arbitrary but fixed, and a notice says so.

    Raises
    ------
    CtInertiaError
        No near-planar face at an extremity, hints that contradict each other or the surface.
    """
    hints = hints or AnatomyHints()
    check_head(np.asarray(surface.vertices_mm, dtype=float), np.asarray(surface.faces), hints)
    mesh = Mesh(np.asarray(surface.vertices_mm, dtype=float), np.asarray(surface.faces, dtype=np.intp))
    candidates = face_candidates(mesh, _extent(mesh))
    solved, notices = _chosen(mesh, candidates, hints)
    oriented = orient_long_axis(hints, solved.origin, solved.axes[:, 0], solved.axes[:, 1])
    solved = solved.turned(oriented.sign)
    frame = RigidTransform.from_parts(solved.axes, solved.origin, "scan", "footplate")
    outline = frame.inverse().points(outer_loop(solved.face.patch))
    body = frame.inverse().points(mesh.points)
    length, width = (float(np.ptp(outline[:, k])) for k in (0, 2))
    notices += [*oriented.notices, *_shape_notices(solved)]
    return FootplateFrame(
        scan_from_footplate=frame,
        contributions=_contributions(solved),
        outline_mm=outline,
        face_area_mm2=solved.face.area,
        length_mm=length,
        width_mm=width,
        height_mm=float(np.ptp(body[:, 1])),
        face_rms_mm=solved.face.rms(solved.axes[:, 1]),
        anterior_from=oriented.evidence,
        notices=tuple(notices),
    )


@dataclass(frozen=True)
class _Face:
    """A medial face cut out of the surface."""

    patch: Patch
    centres: Array
    areas: Array
    centroid: Array

    @property
    def area(self) -> float:
        return float(self.areas.sum())

    def rms(self, normal: Array) -> float:
        height = (self.centres - self.centroid) @ normal
        return float(np.sqrt(self.areas @ (height - self.areas @ height / self.area) ** 2 / self.area))


@dataclass(frozen=True)
class _Region:
    """The part of the surface around the footplate, with normals on the scale of the definition."""

    mesh: Mesh
    diffusion: Diffusion
    resolution_mm: float
    normals: Array
    blurred: Array


@dataclass(frozen=True)
class _Solved:
    """A fixed point of the definition: origin (3,) and axes (3, 3) in scan coordinates."""

    region: _Region
    face: _Face
    origin: Array
    axes: Array
    elongation: float

    def turned(self, sign: float) -> _Solved:
        """Return the frame turned half way about y when ``sign`` is negative."""
        axes = self.axes * np.array([sign, 1.0, sign])
        return _Solved(self.region, self.face, self.origin, axes, self.elongation)


def _extent(mesh: Mesh) -> float:
    """Return the diameter of the body about its middle, mm; the same in every pose."""
    centres = mesh.points[mesh.faces].mean(axis=1)
    areas = np.linalg.norm(mesh.area_vectors, axis=1)
    return 2.0 * float(np.max(np.linalg.norm(mesh.points - areas @ centres / areas.sum(), axis=1)))


def _chosen(mesh: Mesh, candidates: list[FaceCandidate], hints: AnatomyHints) -> tuple[_Solved, list[Notice]]:
    """Solve for the largest face; when landmarks contradict it, for one of similar size that they fit."""
    solved = _solve(_region(mesh, candidates[0].outward), -candidates[0].outward)
    fault = contradiction(solved.origin, solved.axes, hints)
    if fault is None:
        notices = []
        rival = candidates[1].area_mm2 / candidates[0].area_mm2
        known = {"head", "footplate_centre"} & hints.landmarks.keys()
        if rival > 0.85 and not known:
            text = (
                f"Another face of the body is nearly as large as the one taken for the footplate "
                f"({candidates[1].area_mm2:.2f} against {candidates[0].area_mm2:.2f} mm2). Check the report; "
                f"a landmark named head or footplate_centre settles it."
            )
            notices.append(Notice("footplate_ambiguous", text))
        return solved, notices
    for other in candidates[1:]:
        if other.area_mm2 < 0.5 * candidates[0].area_mm2:
            break
        trial = _solve(_region(mesh, other.outward), -other.outward)
        if contradiction(trial.origin, trial.axes, hints) is None:
            text = "The footplate was taken to be the second largest face of the body, as the landmarks ask."
            return trial, [Notice("footplate_by_landmark", text)]
    raise CtInertiaError(fault)


def _region(mesh: Mesh, outward: Array) -> _Region:
    """Cut out what lies within 0.6 mm of the extreme plane and refine it to the scale of the definition."""
    height = mesh.points @ outward
    depth = max(_DEPTH_MM, 0.15 * _extent(mesh))
    part = mesh.part(height > height.max() - depth)
    corners = part.points[part.faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
    part = refined(part, max(_EDGE_MM, 0.008 * _extent(mesh)))
    diffusion = Diffusion(part, NORMAL_SCALE_MM)
    normals = diffusion.normals()
    return _Region(part, diffusion, float(np.median(edges)), unit(normals), unit(diffusion.step(normals)))


def _face(region: _Region, y_axis: Array, cosine: float, normals: Array) -> _Face:
    patch = positive_patch(region.mesh, -(normals @ y_axis) - cosine, region.diffusion.mass)
    if patch is None:
        raise _no_face("a body without such a face")
    a, b, c = (patch.triangles[:, k] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    centres = (a + b + c) / 3.0
    return _Face(patch, centres, areas, areas @ centres / areas.sum())


def _no_face(found: str) -> CtInertiaError:
    return CtInertiaError(
        sentence(
            "the surface",
            "a stapes with a footplate: a near-planar face at one end",
            f"no object that can be a stapes: {found}",
            next_step="Check the segmentation or the mesh, or correct it with --seed or --labels",
        )
    )


def plane_weights(distance_mm: Array) -> Array:
    """Return the weights (n,) of the robust plane fit: a smooth form of Huber's, convex, scale 0.03 mm."""
    return np.asarray(1.0 / np.sqrt(1.0 + (distance_mm / PLANE_SCALE_MM) ** 2))


def _plane_normal(face: _Face, start: Array) -> Array:
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
        if step < 1e-10:
            break
    return normal


def _solve(
    region: _Region, y_axis: Array, angle_deg: float = FACE_ANGLE_DEG, normals: Array | None = None
) -> _Solved:
    """Iterate face -> plane -> direction to the fixed point; the sign of x is left open."""
    field_normals = region.normals if normals is None else normals
    cosine = float(np.cos(np.radians(angle_deg)))
    for _ in range(_ROUNDS):
        face = _face(region, y_axis, cosine, field_normals)
        new = _plane_normal(face, y_axis)
        step = float(np.linalg.norm(new - y_axis))
        y_axis = new
        if step < 1e-8:
            break
    face = _face(region, y_axis, cosine, field_normals)
    moments, helper, across = _outline_moments(face, y_axis)
    values, vectors = np.linalg.eigh(moments)
    x_axis = vectors[0, 1] * helper + vectors[1, 1] * across
    axes = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    return _Solved(region, face, face.centroid, axes, float(np.sqrt(values[1] / values[0])))


def _outline_moments(face: _Face, y_axis: Array) -> tuple[Array, Array, Array]:
    """Return second moments (2, 2) of the area in the projected outline, and their two directions."""
    helper = np.cross(y_axis, np.eye(3)[int(np.argmin(np.abs(y_axis)))])
    helper = helper / np.linalg.norm(helper)
    across = np.cross(helper, y_axis)
    loop = outer_loop(face.patch) - face.centroid
    if len(loop) < 3:
        raise _no_face("no footplate face found, for the face at its end bends away without an edge")
    u, v = loop @ helper, loop @ across
    u2, v2 = np.roll(u, -1), np.roll(v, -1)
    cross = u * v2 - u2 * v
    area = cross.sum() / 2.0
    cu, cv = ((u + u2) @ cross / (6.0 * area), (v + v2) @ cross / (6.0 * area))
    uu = (u * u + u * u2 + u2 * u2) @ cross / 12.0 / area - cu * cu
    vv = (v * v + v * v2 + v2 * v2) @ cross / 12.0 / area - cv * cv
    uv = (u * v2 + 2.0 * u * v + 2.0 * u2 * v2 + u2 * v) @ cross / 24.0 / area - cu * cv
    return np.array([[uu, uv], [uv, vv]]), helper, across


def _contributions(solved: _Solved) -> dict[str, Array]:
    """Return the covariance of the frame by source, (6, 6) each, SI."""
    region = solved.region
    y_axis = solved.axes[:, 1]
    density = height_noise(region.diffusion, solved.face.patch, region.normals)
    frame = (solved.origin, solved.axes)
    noise = height_covariance(
        frame, solved.face.centres, solved.face.areas, plane_weights, density
    ) + boundary_covariance(
        frame,
        solved.face.patch,
        solved.face.areas,
        solved.face.centres,
        density,
        FACE_ANGLE_DEG,
        NORMAL_SCALE_MM,
        plane_weights,
    )
    step = min(_RIM_DEG_PER_MM * region.resolution_mm, 6.0)
    wider = _solve(region, y_axis, FACE_ANGLE_DEG + step)
    narrower = _solve(region, y_axis, FACE_ANGLE_DEG - step)
    rim = 0.5 * _displacement(narrower, wider, solved)
    blurred = _solve(region, y_axis, normals=region.blurred)
    blur = 2.0 * (region.resolution_mm / NORMAL_SCALE_MM) ** 2
    resolution = min(blur, 4.0) * _displacement(solved, blurred, solved)
    return {
        "noise": noise,
        "rim": np.outer(rim, rim),
        "resolution": np.outer(resolution, resolution),
        "blur": _blur_covariance(region.resolution_mm),
    }


def _blur_covariance(resolution_mm: float) -> Array:
    """Return what the blur of a scan adds, (6, 6), SI: the curved face sinks or rises and tilts a little.

    Notes
    -----
    It grows with the square of the resolution. Its size is the bias found on phantoms whose blur is 1.2
    voxels, of the real stapes and of an analytic one, at 20, 25 and 40 um: 1.1, 1.8 and 4.5 um along y.
    """
    square = min(resolution_mm, _BLUR_MOST_MM) ** 2
    shift, tilt = _BLUR_SHIFT_1_MM * square * 1e-3, _BLUR_TILT_RAD_MM2 * square
    return np.diag([0.0, shift**2, 0.0, tilt**2, 0.0, tilt**2])


def _displacement(start: _Solved, end: _Solved, frame: _Solved) -> Array:
    """Return the small motion (6,) from one solution to another, in the axes of ``frame``, m and rad."""
    turned = end.axes * np.sign(np.sum(end.axes * start.axes, axis=0))
    rotation = vector_from_rotation(turned @ start.axes.T)
    shift = (end.origin - start.origin) * 1e-3
    return np.concatenate([frame.axes.T @ shift, frame.axes.T @ rotation])


def _shape_notices(solved: _Solved) -> list[Notice]:
    notices = []
    if solved.elongation < 1.2:
        text = (
            f"The footplate is nearly round (length to width {solved.elongation:.2f}): its long axis, and "
            f"with it x and z, are weakly determined."
        )
        notices.append(Notice("long_axis_weak", text))
    return notices

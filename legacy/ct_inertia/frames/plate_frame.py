"""The plate frame: +y out of the plate's large face towards the stapes, x along its longest straight edge.

The edges are the lines where the fitted plane of the face meets those of the plate's sides, so that bone
and glue on the face do not matter. Edges that are parallel or square to the longest one within what is known
of them help to tell its direction. Where the field of view crops the plate, its border ends the face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import PlateFace, PlateFrame
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.covered_plate import covered_face
from legacy.ct_inertia.frames.footplate import SurfaceLike
from legacy.ct_inertia.frames.plane_faces import PlaneFace, large_faces
from legacy.ct_inertia.frames.plane_fit import fit_to_grey_values
from legacy.ct_inertia.frames.plate_surface import PlateSurface
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform, axes_matrix, vector_from_rotation
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

_LEAST_EDGE_MM = calibrated("plate_frame.least_edge_mm")
_STEEP = calibrated("plate_frame.steep_side")
# Cosine to the main face from which the border of the field of view is parallel to it and ends nothing.
_BORDER_STEEP = 0.995
_RIM_MM = calibrated("plate_frame.rim_mm")
# Cosine from which two directions are taken for one: a side of the hull that a plane side covers already, and
# scan x too near to the face's normal to be laid into it. Chosen by judgement: 26 degrees.
_COVERED = 0.9
_CURVED_1_MM = calibrated("plate_frame.curved_1_mm")
_AMBIGUOUS = calibrated("plate_frame.ambiguous_edges")
_LIKE = calibrated("plate_frame.like_side")
_ROUNDING_MM = calibrated("plate_frame.rounding_mm")
_AGREEING_SD = calibrated("plate_frame.agreeing_sd")
_AGREEING_RAD = calibrated("plate_frame.agreeing_rad")
_UNKNOWN_TURN_RAD = calibrated("plate_frame.unknown_turn_rad")
# Step of the finite differences, mm and rad: the frame is smooth in it, and rounding stays below 1e-9.
_STEP = 1e-6


def plate_frame(
    plate: SurfaceLike,
    stapes_mm: Array,
    on_border: NDArray[np.bool_] | None = None,
    volume: Volume | None = None,
    sigma_mm: float = 0.0,
    near: PlateFace | None = None,
) -> PlateFrame:
    """Find the frame of the plate from its surface.

    Parameters
    ----------
    plate : Surface
        Closed, outward; scan coordinates, mm.
    stapes_mm : ndarray, (3,)
        A point in the middle of the stapes, scan coordinates.
    on_border : ndarray of bool, (n,), optional
        Vertices of the plate at the border of the field of view, where the scan crops it.
    volume : Volume, optional
        Its grey values, for planes fitted to them.
    sigma_mm : float
        Standard deviation of their blur.
    near : PlateFace, optional
        The face as fitted beside the stapes: where bone or glue covers so much of the face that its surface
        shows them, it tells where the plate is.

    Raises
    ------
    CtInertiaError
        The plate has no large plane face that looks towards the stapes.
    """
    if isinstance(plate, PlateSurface) and on_border is plate.on_border:
        faces = plate.planes
    else:
        faces = large_faces(plate, on_border)
    if volume is not None:
        faces = [_place_border(face, volume) for face in faces]
    covered: tuple[Notice, ...] = ()
    main = _main_face(faces, stapes_mm)
    sides = _sides(faces, main)
    if volume is not None and sigma_mm > 0.0:
        seen, (main, *sides) = main, fit_to_grey_values([main, *sides], faces, volume, sigma_mm)
        if main is seen and not main.at_border:
            main, covered = covered_face(main, faces, near, volume, sigma_mm)
    frame = _frame(main, sides)
    weights = _weigh_sides(main, sides, frame)
    frame = _frame(main, sides, frame.along, weights)
    covariance = _propagate(main, sides, frame, weights)
    notices = (*_notices(frame, sides), *covered)
    transform = RigidTransform.from_parts(frame.axes, frame.origin, "scan", "plate")
    return PlateFrame(
        transform, covariance, frame.corners, any(side.at_border for side in sides), "faces", notices
    )


@dataclass(frozen=True)
class _PlatePose:
    """A frame built from planes: axes (3, 3), origin (3,), corners (n, 3) and the plane behind each edge."""

    axes: Array
    origin: Array
    corners: Array
    lengths: Array
    owners: NDArray[np.int_]
    along: int


def _place_border(face: PlaneFace, volume: Volume) -> PlaneFace:
    """Return a face at the border of the field of view where that border is: half a voxel outside."""
    if not face.at_border:
        return face
    inner = face.normal @ volume.direction
    axis = int(np.argmax(np.abs(inner)))
    normal = volume.direction[:, axis] * np.sign(inner[axis])
    index = volume.index_points(face.point_mm)
    index[axis] = -0.5 if inner[axis] < 0.0 else float(volume.size[axis]) - 0.5
    basis = np.delete(volume.direction, axis, axis=1)
    return replace(
        face, normal=normal, point_mm=volume.scan_points(index), basis=basis, covariance=np.zeros((3, 3))
    )


def _main_face(faces: Sequence[PlaneFace], stapes_mm: Array) -> PlaneFace:
    for face in faces:
        if not face.at_border and face.distance(stapes_mm[None, :])[0] > 0.0:
            return face
    raise CtInertiaError.of(
        "the plate",
        "a solid with a plane face towards the stapes",
        f"{len(faces)} plane faces, none of which has the stapes on its outer side",
        next_step="Check the segmentation in the report, or give {plate_fiducials}",
    )


def _sides(faces: Sequence[PlaneFace], main: PlaneFace) -> list[PlaneFace]:
    """Return the faces that end the main face: steep, flat, reaching up to its plane."""
    kept: list[PlaneFace] = []
    for face in faces:
        steep = abs(face.normal @ main.normal) < (_BORDER_STEEP if face.at_border else _STEEP)
        reaches = float(np.max(main.distance(face.samples_mm))) > -_RIM_MM
        inside = float(np.median(face.distance(main.samples_mm))) < 0.0
        along = np.cross(main.normal, face.normal)
        flat = face.at_border or face.curvature(along) < _CURVED_1_MM
        if face is not main and steep and reaches and inside and flat and not _is_rounded_edge(face, kept):
            kept.append(face)
    return kept


def _is_rounded_edge(face: PlaneFace, kept: Sequence[PlaneFace]) -> bool:
    """Return whether a face is only the rounded edge of a larger one."""
    return any(
        face.normal @ other.normal > _LIKE
        and abs(float(np.median(other.distance(face.samples_mm)))) < _ROUNDING_MM
        for other in kept
    )


def _frame(
    main: PlaneFace, sides: Sequence[PlaneFace], along: int | None = None, weights: Array | None = None
) -> _PlatePose:
    """Build the frame from the planes; ``along`` names the side whose edge gives x, with others by weight."""
    normal = main.normal
    u = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    u = u / np.linalg.norm(u)
    plane = np.column_stack([u, np.cross(normal, u)])
    lines = [(plane.T @ side.normal, float((side.point_mm - main.point_mm) @ side.normal)) for side in sides]
    polygon, owners = _polygon((main.samples_mm - main.point_mm) @ plane, lines)
    lengths = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
    edge = np.array([owner >= 0 and not sides[owner].at_border for owner in owners])
    if along is None:
        longest = int(np.argmax(np.where(edge, lengths, 0.0)))
        along = int(owners[longest]) if edge[longest] and lengths[longest] > _LEAST_EDGE_MM else -1
    if along >= 0:
        direction = np.cross(normal, sides[along].normal)
        if weights is not None:
            direction = _mean_direction(normal, sides, direction, weights)
    else:
        direction = np.eye(3)[int(abs(normal[0]) > _COVERED)]
        direction = direction - (direction @ normal) * normal
    axes = axes_matrix(positive_sense(direction), normal)
    corners = main.point_mm + polygon @ plane.T
    origin = main.point_mm + plane @ _centroid(polygon)
    return _PlatePose(axes, origin, corners, np.where(edge, lengths, 0.0), owners, along)


def _mean_direction(normal: Array, sides: Sequence[PlaneFace], first: Array, weights: Array) -> Array:
    """Return the mean of the directions of edges, each turned by quarters to lie near the first."""
    x, y, z = normal
    turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    total = np.zeros(3)
    for side, weight in zip(sides, weights, strict=True):
        if weight == 0.0:
            continue
        edge = turn @ side.normal
        edge = edge / np.sqrt(edge @ edge)
        square = turn @ edge
        total += weight * max((edge, square, -edge, -square), key=lambda turned: float(turned @ first))
    return total


def _weigh_sides(main: PlaneFace, sides: Sequence[PlaneFace], pose: _PlatePose) -> Array:
    """Return the weight (n,) of each side in the mean direction of x; they sum to 1.

    Sides parallel or perpendicular to the longest edge, within their uncertainty, are weighted by the inverse
    of their variance; the others have weight 0.
    """
    weights = np.zeros(len(sides))
    if pose.along < 0:
        return weights
    first = np.cross(main.normal, sides[pose.along].normal)
    first = first / np.linalg.norm(first)
    variances = np.array([_turn_variance(main, side) for side in sides])
    for place, side in enumerate(sides):
        alone = np.zeros(len(sides))
        alone[place] = 1.0
        edge = _mean_direction(main.normal, sides, first, alone)
        angle = float(np.arcsin(np.clip(np.cross(first, edge) @ main.normal, -1.0, 1.0)))
        limit = _AGREEING_SD * float(np.sqrt(variances[place] + variances[pose.along]))
        if not side.at_border and abs(angle) <= min(limit, _AGREEING_RAD):
            weights[place] = 1.0 / max(variances[place], 1e-16)
    weights[pose.along] = 1.0 / max(variances[pose.along], 1e-16)
    return np.asarray(weights / weights.sum())


def _turn_variance(main: PlaneFace, side: PlaneFace) -> float:
    """Return the variance of the direction of a side's edge about the normal of the main face, rad2."""
    edge = np.cross(main.normal, side.normal)
    slopes = side.basis.T @ (edge / np.linalg.norm(edge))
    return float(slopes @ side.covariance[1:, 1:] @ slopes)


def positive_sense(direction: Array) -> Array:
    """Return the sense with the larger positive component along scan x (ties: y, then z)."""
    unit = direction / np.linalg.norm(direction)
    leading = next((component for component in unit if abs(component) > 1e-6), 1.0)
    return np.asarray(unit * np.sign(leading))


def _polygon(points: Array, lines: Sequence[tuple[Array, float]]) -> tuple[Array, NDArray[np.int_]]:
    """Return the face's corners (n, 2) and the line (or -1) that each edge lies on, counter-clockwise.

    Where no side ends the face, the convex hull of what was seen of it does.
    """
    reach = 4.0 * float(np.max(np.abs(points)))
    polygon = reach * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    owners = np.full(4, -1)
    directions = np.array([line[0] / np.linalg.norm(line[0]) for line in lines]).reshape(-1, 2)
    for place, (across, offset) in enumerate(lines):
        polygon, owners = _clip(polygon, owners, across, offset, place)
    open_side = bool(np.any(owners < 0))
    for across, offset in _hull_sides(points) if open_side else ():
        if not np.any(directions @ across > _COVERED):
            polygon, owners = _clip(polygon, owners, across, offset, -1)
    if len(polygon) < 3:
        raise CtInertiaError.of(
            "the sides of the plate",
            "planes around its face",
            "planes that leave nothing of it",
            next_step="Check the segmentation in the report, or give {plate_fiducials}",
        )
    return polygon, owners


def _hull_sides(points: Array) -> list[tuple[Array, float]]:
    """Return outward unit normals and offsets of the sides of the convex hull of points (n, 2)."""
    from scipy.spatial import ConvexHull

    return [(np.array(side[:2]), -float(side[2])) for side in ConvexHull(points).equations]


def _clip(
    polygon: Array, owners: NDArray[np.int_], across: Array, offset: float, owner: int
) -> tuple[Array, NDArray[np.int_]]:
    """Keep the part of a convex polygon where ``across . p <= offset`` and name the new edge's line."""
    height = polygon @ across - offset
    corners: list[Array] = []
    names: list[int] = []
    for place, corner in enumerate(polygon):
        after = (place + 1) % len(polygon)
        h, h_after = height[place], height[after]
        crossing = corner + h / (h - h_after) * (polygon[after] - corner) if h * h_after < 0.0 else None
        if h <= 0.0:
            corners.append(corner)
            names.append(int(owners[place]))
            if crossing is not None:
                corners.append(crossing)
                names.append(owner)
        elif crossing is not None:
            corners.append(crossing)
            names.append(int(owners[place]))
    return np.array(corners).reshape(-1, 2), np.array(names, dtype=np.int_)


def _centroid(polygon: Array) -> Array:
    x, y = polygon.T
    x2, y2 = np.roll(polygon, -1, axis=0).T
    cross = x * y2 - x2 * y
    return np.asarray(np.array([(x + x2) @ cross, (y + y2) @ cross]) / (3.0 * cross.sum()))


def _propagate(main: PlaneFace, sides: Sequence[PlaneFace], pose: _PlatePose, weights: Array) -> Array:
    """Carry the covariance of every plane to the frame by finite differences, (6, 6), m and rad."""
    covariance = np.zeros((6, 6))
    planes = [main, *sides]
    for place, plane in enumerate(planes):
        if not np.any(plane.covariance):
            continue
        columns = []
        for step in np.eye(3) * _STEP:
            moved = [*planes]
            moved[place] = plane.moved(step)
            columns.append(_displacement(pose, _frame(moved[0], moved[1:], pose.along, weights)) / _STEP)
        jacobian = np.column_stack(columns)
        covariance += jacobian @ plane.covariance @ jacobian.T
    if pose.along < 0:
        covariance[4, 4] += _UNKNOWN_TURN_RAD**2
    return covariance


def _displacement(base: _PlatePose, moved: _PlatePose) -> Array:
    shift = base.axes.T @ (moved.origin - base.origin) * 1e-3
    return np.concatenate([shift, vector_from_rotation(base.axes.T @ moved.axes)])


def _notices(pose: _PlatePose, sides: Sequence[PlaneFace]) -> tuple[Notice, ...]:
    notices = []
    listed = ", ".join(f"{value:+.3f}" for value in pose.axes[:, 0])
    if pose.along < 0:
        text = (
            "No straight edge of the plate is in the scan: x of the plate frame is scan x laid into it, "
            f"and its turn about y says nothing about the plate. Give {named('plate_fiducials')}."
        )
        notices.append(Notice("plate_edges_not_visible", text))
    else:
        text = (
            f"x of the plate frame is the longest edge of the plate in the sense with the positive component "
            f"along scan x, [{listed}] in scan axes. Check it against the plate, or give "
            f"{named('plate_fiducials')}."
        )
        notices.append(Notice("plate_axis_sign", text))
        own = pose.owners == pose.along
        across = sides[pose.along].normal
        other = [
            length
            for length, owner in zip(pose.lengths, pose.owners, strict=True)
            if owner >= 0 and abs(sides[owner].normal @ across) < 0.7
        ]
        ratio = max(other, default=0.0) / float(pose.lengths[own].max())
        if ratio > _AMBIGUOUS:
            text = (
                f"Two edges of the plate are nearly equally long (ratio {ratio:.3f}): which of them is x is "
                f"ambiguous. Give {named('plate_fiducials')}."
            )
            notices.append(Notice("plate_axis_ambiguous", text))
    if any(side.at_border for side in sides):
        text = (
            "The scan crops the plate: the origin of the plate frame is the centroid of the part in view, no "
            f"point of the plate itself. Give {named('plate_fiducials')} to tie it to the plate."
        )
        notices.append(Notice("plate_cropped", text))
    return tuple(notices)

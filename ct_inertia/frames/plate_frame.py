"""The plate frame from its mesh: +y out of the large face towards the stapes, x along the longest edge.

The edges are the lines where the fitted plane of the face meets those of the plate's sides, so that bone
and glue on the face do not matter. Edges that are parallel or square to the longest one within what is
known of them help to tell its direction. Where the field of view crops the plate, its border ends the face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.frames.plate import PlaneFace, jacobian
from ct_inertia.surface.fields import unit
from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform, axes_matrix
from stapeskit.registration import displacement
from stapeskit.warnings import Notice

AMBIGUOUS = 0.95
"""Ratio of two edges from which it is ambiguous which one is the longest (contract)."""

# Half a footplate, which holds 30 to 50 % of the bone of the eight families of `simulate`; they sink 0.1 to
# 0.25 mm into a plate before.
MOST_SUNK = 0.15
"""Share of the stapes behind a face up to which it is that of a plate; what covers more is a fluid."""

_LEAST_EDGE_MM = 0.5
_STEEP, _BORDER_STEEP = 0.2, 0.995  # cosine to the main face up to which a side, or the border, ends it
_COVERED = 0.9  # cosine from which two directions are taken for one
_OPEN_RAD = 0.05  # less than a half turn between two sides: they meet within 20 widths of the face
_LIKE, _ROUNDING_MM = 0.93, 0.1  # cosine and distance of a face that is only the rounded edge of a larger one
_CURVED_1_MM = 0.15  # a face of 7 mm radius is no plane
_RIM_MM = calibrated("plate_frame.rim_mm")
_AGREEING_SD, _AGREEING_RAD = 3.0, calibrated("plate_frame.agreeing_rad")
_UNKNOWN_TURN_RAD = 1.0
_HULL_SD_MM = calibrated("plate_frame.hull_sd_mm")


@dataclass(frozen=True)
class PlateFrame:
    """The frame of the plastic plate.

    Attributes
    ----------
    scan_from_plate : RigidTransform
        mm.
    covariance : ndarray, (6, 6)
        Of the frame's displacement in its own axes, m and rad.
    outline_mm : ndarray, (n, 3)
        Corners of the visible face, scan coordinates; empty when fiducials gave the frame.
    cropped : bool
        The field of view ends the face on at least one side.
    source : str
        ``faces`` or ``fiducials``.
    """

    scan_from_plate: RigidTransform
    covariance: Array
    outline_mm: Array
    cropped: bool
    source: str
    notices: tuple[Notice, ...] = field(default=())

    def share_behind(self, points_mm: Array) -> float:
        """Return the share of points (n, 3), scan axes, behind the visible face and within its outline."""
        from scipy.spatial import Delaunay

        outline, points = map(self.scan_from_plate.inverse().points, (self.outline_mm, points_mm))
        below = Delaunay(outline[:, [0, 2]]).find_simplex(points[:, [0, 2]]) >= 0
        return float(np.mean(below & (points[:, 1] < 0.0)))


@dataclass(frozen=True)
class _Pose:
    """A frame built from planes: axes, origin, corners (n, 3), edge lengths, planes behind the edges."""

    axes: Array
    origin: Array
    corners: Array
    lengths: Array
    owners: NDArray[np.int_]
    along: int

    @property
    def transform(self) -> RigidTransform:
        return RigidTransform.from_parts(self.axes, self.origin, "scan", "plate")


def plate_frame(faces: Sequence[PlaneFace], stapes_mm: Array, level_sd_mm: float = 0.0) -> PlateFrame | None:
    """Find the frame of the plate from its plane faces; None without one that looks towards the stapes.

    ``stapes_mm`` (3,) is a point in the middle of the stapes, scan coordinates; ``level_sd_mm`` the standard
    deviation of one shift of the whole surface along its normal.
    """
    from scipy.spatial import QhullError

    main = next(iter(facing(faces, stapes_mm)), None)
    if main is None:
        return None
    main = replace(main, covariance=main.covariance + np.diag([level_sd_mm**2, 0.0, 0.0]))
    sides = _sides([face for face in faces if face.point_mm is not main.point_mm], main)
    try:
        pose = _pose(main, sides)
        covariance = _propagated(main, sides, pose)
    except QhullError:  # sides that enclose no face
        return None
    cropped = any(side.at_border for side in sides)
    return PlateFrame(pose.transform, covariance, pose.corners, cropped, "faces", _notices(pose, sides))


def facing(faces: Sequence[PlaneFace], stapes_mm: Array) -> list[PlaneFace]:
    """Return the plane faces of a plate that have a point of the stapes on their outer side."""
    return [
        face
        for face in faces
        if float(np.max(np.abs(np.linalg.eigvalsh(face.turning_1_mm)))) < _CURVED_1_MM
        and not face.at_border
        and face.distance(stapes_mm[None, :])[0] > 0.0
    ]


def _sides(faces: Sequence[PlaneFace], main: PlaneFace) -> list[PlaneFace]:
    """Return the faces that end the main face: steep, flat, reaching up to its plane."""
    kept: list[PlaneFace] = []
    for face in faces:
        steep = abs(face.normal @ main.normal) < (_BORDER_STEEP if face.at_border else _STEEP)
        reaches = float(np.max(main.distance(face.samples_mm))) > -_RIM_MM
        inside = float(np.median(face.distance(main.samples_mm))) < 0.0
        flat = face.at_border or face.curvature(np.cross(main.normal, face.normal)) < _CURVED_1_MM
        if steep and reaches and inside and flat and not _is_rounded_edge(face, kept):
            kept.append(face)
    return kept


def _is_rounded_edge(face: PlaneFace, kept: Sequence[PlaneFace]) -> bool:
    """Return whether a face is only the rounded edge of a larger one."""
    return any(
        face.normal @ other.normal > _LIKE
        and abs(float(np.median(other.distance(face.samples_mm)))) < _ROUNDING_MM
        for other in kept
    )


def _pose(main: PlaneFace, sides: Sequence[PlaneFace], along: int | None = None) -> _Pose:
    """Build the frame from the planes; x follows the longest edge, or that of side ``along``."""
    normal = main.normal
    u = unit(np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))]))
    plane = np.column_stack([u, np.cross(normal, u)])
    lines = [(plane.T @ side.normal, float((side.point_mm - main.point_mm) @ side.normal)) for side in sides]
    polygon, owners = _polygon((main.samples_mm - main.point_mm) @ plane, lines)
    lengths = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
    edge = np.array([owner >= 0 and not sides[owner].at_border for owner in owners])
    lengths = np.where(edge, lengths, 0.0)
    if along is None:
        longest = int(np.argmax(lengths))
        along = int(owners[longest]) if lengths[longest] > _LEAST_EDGE_MM else -1
    if along >= 0:
        direction = _edge_direction(normal, sides, along)
    else:
        direction = np.eye(3)[int(abs(normal[0]) > _COVERED)]
        direction = direction - (direction @ normal) * normal
    corners = main.point_mm + polygon @ plane.T
    origin = main.point_mm + plane @ centroid(polygon)
    return _Pose(axes_matrix(positive_sense(direction), normal), origin, corners, lengths, owners, along)


def _edge_direction(normal: Array, sides: Sequence[PlaneFace], along: int) -> Array:
    """Return the direction (3,) of the edge of one side, averaged with those parallel or square to it.

    Those count that are so within what is known of both, weighted by the inverse of their variance.
    """
    edges = unit(np.cross(normal, np.stack([side.normal for side in sides])))
    first = edges[along]
    turns = np.arctan2(np.cross(first, edges) @ normal, edges @ first)
    turns = (turns + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi
    slopes = [side.basis.T @ edge for side, edge in zip(sides, edges, strict=True)]
    variances = np.array([s @ side.covariance[1:, 1:] @ s for side, s in zip(sides, slopes, strict=True)])
    limits = np.minimum(_AGREEING_SD * np.sqrt(variances + variances[along]), _AGREEING_RAD)
    agree = (np.abs(turns) <= limits) & ~np.array([side.at_border for side in sides])
    agree[along] = True
    weights = agree / np.maximum(variances, 1e-16)
    turn = float(weights @ turns / weights.sum())
    return np.asarray(np.cos(turn) * first + np.sin(turn) * np.cross(normal, first))


def positive_sense(direction: Array) -> Array:
    """Return the sense with the larger positive component along scan x (ties: y, then z), unit."""
    found = direction / np.linalg.norm(direction)
    leading = next((component for component in found if abs(component) > 1e-6), 1.0)
    return np.asarray(found * np.sign(leading))


def _polygon(points: Array, lines: Sequence[tuple[Array, float]]) -> tuple[Array, NDArray[np.int_]]:
    """Return the face's corners (n, 2) and the line (or -1) that each edge lies on, counter-clockwise.

    Where no side ends the face, the convex hull of what was seen of it does.
    """
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    rows = np.array([[*across, -offset] for across, offset in lines]).reshape(-1, 3)
    rows /= np.linalg.norm(rows[:, :2], axis=1, keepdims=True)
    angles = np.sort(np.arctan2(rows[:, 1], rows[:, 0]))
    gaps = np.diff(np.append(angles, angles[:1] + 2.0 * np.pi))
    if not len(gaps) or gaps.max() > np.pi - _OPEN_RAD:
        hull = ConvexHull(points).equations
        rows = np.vstack([rows, hull[~np.any(hull[:, :2] @ rows[:, :2].T > _COVERED, axis=1)]])
    corners = HalfspaceIntersection(rows, np.median(points, axis=0)).intersections
    corners = corners[ConvexHull(corners).vertices]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    owners = np.argmin(np.abs(middles @ rows[:, :2].T + rows[:, 2]), axis=1)
    return corners, np.where(owners < len(lines), owners, -1)


def centroid(polygon: Array) -> Array:
    """Return the centroid (2,) of the area within a polygon (n, 2)."""
    x, y = polygon.T
    x2, y2 = np.roll(polygon, -1, axis=0).T
    cross = x * y2 - x2 * y
    return np.asarray(np.array([(x + x2) @ cross, (y + y2) @ cross]) / (3.0 * cross.sum()))


def _propagated(main: PlaneFace, sides: Sequence[PlaneFace], pose: _Pose) -> Array:
    """Carry the covariance of every plane to the frame by finite differences, (6, 6), m and rad."""
    covariance = np.zeros((6, 6))
    planes = [main, *sides]
    for place, plane in enumerate(planes):

        def moved(face: PlaneFace, place: int = place) -> Array:
            every = [*planes[:place], face, *planes[place + 1 :]]
            return displacement(pose.transform, _pose(every[0], every[1:], pose.along).transform)

        steps = jacobian(moved, plane)
        covariance += steps @ plane.covariance @ steps.T
    if np.any(pose.owners < 0):  # no plane side ends the face there, but what was seen of it
        covariance[[0, 2], [0, 2]] += (1e-3 * _HULL_SD_MM) ** 2
    if pose.along < 0:
        covariance[4, 4] += _UNKNOWN_TURN_RAD**2
    return covariance


def axis_notices(x_axis: Array, ratio: float, edge: str = "edge of the plate") -> list[Notice]:
    """Report the sense of the longest edge, and another one that is nearly as long: ``ratio`` of both."""
    listed = ", ".join(f"{value:+.3f}" for value in x_axis)
    text = (
        f"x of the plate frame is the longest {edge} in the sense with the positive component along scan x, "
        f"[{listed}] in scan axes. Check it against the plate, or give --plate-fiducials with x_ref_mm, "
        "y_ref_mm, z_ref_mm."
    )
    notices = [Notice("plate_axis_sign", text)]
    if ratio > AMBIGUOUS:
        text = (
            f"The longest {edge} and another one are nearly equally long (ratio {ratio:.3f}): which "
            "of them is x is ambiguous. Give --plate-fiducials with x_ref_mm, y_ref_mm, z_ref_mm."
        )
        notices.append(Notice("plate_axis_ambiguous", text))
    return notices


def _notices(pose: _Pose, sides: Sequence[PlaneFace]) -> tuple[Notice, ...]:
    if pose.along < 0:
        text = (
            "No straight edge of the plate is in the scan: x of the plate frame is scan x laid into it, and "
            "its turn about y says nothing about the plate. Give --plate-fiducials."
        )
        notices = [Notice("plate_axis_ambiguous", text)]
    else:
        across = sides[pose.along].normal
        pairs = list(zip(pose.lengths, pose.owners, strict=True))
        other = [length for length, owner in pairs if owner >= 0 and abs(sides[owner].normal @ across) < 0.7]
        longest = max(length for length, owner in pairs if owner == pose.along)
        notices = axis_notices(pose.axes[:, 0], max(other, default=0.0) / longest)
    if any(side.at_border for side in sides):
        text = (
            "The scan crops the plate: the origin of the plate frame is the centroid of the part in view, "
            "no point of the plate itself. Give --plate-fiducials to tie it to the plate."
        )
        notices.append(Notice("plate_cropped", text))
    return tuple(notices)

"""The footplate frame: centre of the medial face, piston direction, long axis, with their covariance.

The definition. On the surface, let n be the outward normals diffused over 0.05 mm, and for a direction y
let the medial face F(y) be the connected part of the footplate where n lies within
`footplate_face.FACE_ANGLE_DEG` of -y. Then

* y is the normal of the robust plane of F(y), pointing into the body (lateral, towards the head): a fixed
  point, found by iteration;
* the origin is the area-weighted centroid of F(y) in space;
* x is the long principal axis of the area within the outline of F(y), projected on that plane;
* z = x cross y.

The scale of 0.05 mm belongs to the definition: it makes the frame one of the bone and not of the voxels
or triangles it is known by.

The half level of a blurred body lies inside it where it is convex: by blur^2 / 2 times the sum of the
principal curvatures, for blurring moves an iso surface like heat flow does. Where the blur is known, the
surface is moved back by that much before its face is looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import AnatomyHints, orient_long_axis
from legacy.ct_inertia.frames.footplate_face import Solved, solve_at
from legacy.ct_inertia.frames.footplate_landmarks import check_head, contradiction
from legacy.ct_inertia.frames.footplate_search import FaceCandidate, face_candidates
from legacy.ct_inertia.frames.footplate_uncertainty import contributions_of
from legacy.ct_inertia.surface.surface_field import Mesh, outer_loop
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.warnings import Notice


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


def footplate_frame(
    surface: SurfaceLike,
    hints: AnatomyHints | None = None,
    blur_mm: float = 0.0,
    noise_mm4: float = 0.0,
) -> FootplateFrame:
    """Find the footplate frame of a stapes' surface.

    Parameters
    ----------
    surface : Surface
        Closed, outward; scan coordinates, mm.
    hints : AnatomyHints, optional
        Where anterior is; without them the sign of x is arbitrary but fixed, and a notice says so.
    blur_mm : float
        Standard deviation of the blur of the grey values whose half level the surface is; 0 for a surface
        that is exact.
    noise_mm4 : float
        Spectral density of the surface's height noise at long waves beyond what its short waves show: that of
        noise which neighbouring voxels share.

    Raises
    ------
    CtInertiaError
        No near-planar face at an extremity, hints that contradict each other or the surface.
    """
    mesh, solved, anterior_from, notices = _solve(surface, hints or AnatomyHints(), blur_mm)
    frame = _frame_of(solved)
    outline = frame.inverse().points(outer_loop(solved.face.patch))
    body = frame.inverse().points(mesh.points)
    length, width = (float(np.ptp(outline[:, k])) for k in (0, 2))
    return FootplateFrame(
        scan_from_footplate=frame,
        contributions=contributions_of(solved, noise_mm4),
        outline_mm=outline,
        face_area_mm2=solved.face.area,
        length_mm=length,
        width_mm=width,
        height_mm=float(np.ptp(body[:, 1])),
        face_rms_mm=solved.face.rms(solved.axes[:, 1]),
        anterior_from=anterior_from,
        notices=tuple(notices),
    )


def footplate_pose(surface: SurfaceLike, hints: AnatomyHints, blur_mm: float) -> RigidTransform:
    """Return scan_from_footplate alone, as `footplate_frame` finds it."""
    return _frame_of(_solve(surface, hints, blur_mm)[1])


def _frame_of(solved: Solved) -> RigidTransform:
    return RigidTransform.from_parts(solved.axes, solved.origin, "scan", "footplate")


def _solve(
    surface: SurfaceLike, hints: AnatomyHints, blur_mm: float
) -> tuple[Mesh, Solved, str, list[Notice]]:
    """Return the surface, the solution with the sign of x, the hint that decided it, and warnings."""
    check_head(np.asarray(surface.vertices_mm, dtype=float), np.asarray(surface.faces), hints)
    mesh = Mesh(np.asarray(surface.vertices_mm, dtype=float), np.asarray(surface.faces, dtype=np.intp))
    extent = _extent(mesh)
    candidates = face_candidates(mesh, extent)
    solved, notices = _choose_face(lambda face: solve_at(mesh, face, extent, blur_mm), candidates, hints)
    oriented = orient_long_axis(hints, solved.origin, solved.axes[:, 0], solved.axes[:, 1])
    solved = solved.turned(oriented.sign)
    return mesh, solved, oriented.evidence, [*notices, *oriented.notices, *_shape_notices(solved)]


def _extent(mesh: Mesh) -> float:
    """Return the diameter of the body about its middle, mm; the same in every pose."""
    centres = mesh.points[mesh.faces].mean(axis=1)
    areas = np.linalg.norm(mesh.area_vectors, axis=1)
    return 2.0 * float(np.max(np.linalg.norm(mesh.points - areas @ centres / areas.sum(), axis=1)))


def _choose_face(
    solved_at: Callable[[Array], Solved], candidates: list[FaceCandidate], hints: AnatomyHints
) -> tuple[Solved, list[Notice]]:
    """Solve for the largest face; when landmarks contradict it, for one of similar size that they fit."""
    solved = solved_at(candidates[0].outward)
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
        trial = solved_at(other.outward)
        if contradiction(trial.origin, trial.axes, hints) is None:
            text = "The footplate was taken to be the second largest face of the body, as the landmarks ask."
            return trial, [Notice("footplate_by_landmark", text)]
    raise CtInertiaError(fault)


def _shape_notices(solved: Solved) -> list[Notice]:
    notices = []
    if solved.elongation < 1.2:
        text = (
            f"The footplate is nearly round (length to width {solved.elongation:.2f}): its long axis, and "
            f"with it x and z, are weakly determined."
        )
        notices.append(Notice("long_axis_weak", text))
    return notices

"""The footplate frame: centre of the medial face, piston direction, long axis, with their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ct_inertia.bodies import BodySurface
from ct_inertia.calibrated import calibrated
from ct_inertia.frames.anatomy import AnatomyHints, check_places, contradiction, orient_long_axis
from ct_inertia.frames.footplate_face import Solved, solve_at
from ct_inertia.frames.footplate_sd import contributions_of
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.registration import displacement
from stapeskit.warnings import Notice

_DIRECTIONS, _PARTS = 1200, 40  # over the sphere: 6 degrees apart; so few at a time fit the processor's cache
_CELL = 0.02  # edge of the cells that pool triangles, in diameters of the body: a quarter of the face's slab
_CONE_DEG = calibrated("footplate.search_cone_deg")
_SLAB = calibrated("footplate.search_slab")
_LEAST_HEIGHT = 0.5  # of a body above its footplate, in its diameters: stapedes have 0.65 to 0.8, sides 0.3
_OTHER_DEG = 40.0  # faces whose normals are nearer belong to one
_RIVAL = 0.85  # of the area of the largest face: another one from there on is reported
_LEAST_RIVAL = 0.5  # of the largest area, from which landmarks may choose another face
_ROUND = 1.2  # elongation below which the long axis is reported as weak


@dataclass(frozen=True)
class FootplateFrame:
    """The footplate frame of a stapes.

    Attributes
    ----------
    scan_from_footplate : RigidTransform
        Axes x anterior, y lateral, z; origin the footplate centre; mm.
    contributions : mapping of str to ndarray, (6, 6)
        Covariance of the frame's displacement in its own axes (m, rad; x, y, z, alpha, beta, gamma) by
        source.
    outline_mm : ndarray, (n, 3)
        Outline of the medial face in footplate coordinates, in order.
    face_area_mm2, face_rms_mm : float
        Area of the medial face; how far it departs from its plane.
    length_mm, width_mm, height_mm : float
        Extent of the outline along x and z, and of the body along y.
    anterior_from : str
        What decided the sign of x.
    """

    scan_from_footplate: RigidTransform
    contributions: Mapping[str, Array]
    outline_mm: Array
    face_area_mm2: float
    face_rms_mm: float
    length_mm: float
    width_mm: float
    height_mm: float
    anterior_from: str
    notices: tuple[Notice, ...] = field(default=())

    @property
    def covariance(self) -> Array:
        """Covariance of the frame's displacement in its own axes, (6, 6), m and rad."""
        return np.asarray(sum(self.contributions.values(), np.zeros((6, 6))))

    def with_other_surface(self, other: RigidTransform) -> FootplateFrame:
        """Add the source ``surroundings`` to the uncertainty: the displacement to another surface's frame."""
        step = displacement(self.scan_from_footplate, other)
        return replace(self, contributions={**self.contributions, "surroundings": np.outer(step, step)})


def footplate_frame(
    surface: Surface, hints: AnatomyHints | None = None, body: BodySurface | None = None
) -> FootplateFrame:
    """Find the footplate frame on the surface of a stapes.

    Without hints of where anterior is the sign of x is arbitrary but fixed, and a notice says so. ``body``
    tells how the surface errs; None: a mesh of which nothing is known but its triangles.

    Raises
    ------
    StapeskitError
        No near-planar face at an extremity; hints that contradict each other or the surface.
    """
    hints = hints or AnatomyHints()
    solved, anterior_from, notices = _solve(surface, hints, body)
    frame = _frame_of(solved)
    outline = frame.inverse().points(solved.face.outline + solved.region.middle)
    return FootplateFrame(
        scan_from_footplate=frame,
        contributions=contributions_of(solved, body),
        outline_mm=outline,
        face_area_mm2=solved.face.area,
        face_rms_mm=solved.face.rms(solved.axes[:, 1]),
        length_mm=float(np.ptp(outline[:, 0])),
        width_mm=float(np.ptp(outline[:, 2])),
        height_mm=float(np.ptp(frame.inverse().points(surface.vertices_mm)[:, 1])),
        anterior_from=anterior_from,
        notices=tuple(notices),
    )


def pose_near(surface: Surface, near: FootplateFrame, body: BodySurface) -> RigidTransform:
    """Return the frame of a slightly different surface, its axes in the sense of another frame's."""
    axes = near.scan_from_footplate.rotation
    solved = solve_at(surface, -axes[:, 1], _extent(surface), body)
    return _frame_of(solved.turned(float(np.sign(solved.axes[:, 0] @ axes[:, 0]) or 1.0)))


def _frame_of(solved: Solved) -> RigidTransform:
    return RigidTransform.from_parts(solved.axes, solved.origin, "scan", "footplate")


def _solve(
    surface: Surface, hints: AnatomyHints, body: BodySurface | None
) -> tuple[Solved, str, list[Notice]]:
    """Return the solution with the sign of x, what decided it, and warnings."""
    check_places(surface, hints)
    extent = _extent(surface)
    solved, notices = _choose_face(surface, extent, body, hints)
    sign, evidence, said = orient_long_axis(hints, solved.origin, solved.axes[:, 0], solved.axes[:, 1])
    notices += said
    if solved.elongation < _ROUND:
        text = (
            f"The footplate is nearly round (length to width {solved.elongation:.2f}): its long axis, and "
            "with it x and z, are weakly determined."
        )
        notices.append(Notice("long_axis_weak", text))
    return solved.turned(sign), evidence, notices


def _extent(surface: Surface) -> float:
    """Return the diameter of the body about its middle, mm; the same in every pose."""
    areas = np.linalg.norm(surface.area_vectors_mm2, axis=1)
    middle = areas @ surface.centres_mm / areas.sum()
    return 2.0 * float(np.max(np.linalg.norm(surface.vertices_mm - middle, axis=1)))


def _choose_face(
    surface: Surface, extent: float, body: BodySurface | None, hints: AnatomyHints
) -> tuple[Solved, list[Notice]]:
    """Solve for the largest face; when landmarks contradict it, for one of similar size that they fit."""
    faces = extremal_faces(surface, extent)
    solved = solve_at(surface, faces[0][0], extent, body)
    fault = contradiction(solved.origin, solved.axes, hints)
    if fault is None:
        known = {"head", "footplate_centre"} & hints.landmarks.keys()
        if len(faces) < 2 or faces[1][1] < _RIVAL * faces[0][1] or known:
            return solved, []
        text = (
            "Another face of the body is nearly as large as the one taken for the footplate "
            f"({faces[1][1]:.2f} against {faces[0][1]:.2f} mm2). Check the report; a landmark named head or "
            "footplate_centre settles it."
        )
        return solved, [Notice("footplate_ambiguous", text)]
    for outward, area in faces[1:]:
        if area < _LEAST_RIVAL * faces[0][1]:
            break
        trial = solve_at(surface, outward, extent, body)
        if contradiction(trial.origin, trial.axes, hints) is None:
            text = "The footplate was taken to be another face than the largest, as the landmarks ask."
            return trial, [Notice("footplate_ambiguous", text)]
    raise StapeskitError(fault)


def extremal_faces(surface: Surface, extent_mm: float) -> list[tuple[Array, float]]:
    """Return near-planar faces at the extremities of a body: direction (3,) and area (mm2), largest first.

    Notes
    -----
    For directions spread evenly over the sphere: the projected area of what faces that direction within a
    cone and lies within a slab of the extreme plane. Side views of the arch, the head and the lateral side
    of the footplate score less: narrow, small, or not at an extremity; and a body is flat along its sides.
    """
    pieces = _pooled(surface, _CELL * extent_mm)
    directions = sphere(_DIRECTIONS)
    scores = _scores(directions, pieces, extent_mm)
    free = np.ones(len(directions), dtype=bool)
    faces: list[tuple[Array, float]] = []
    while np.any(free):
        best = int(np.argmax(np.where(free, scores, -1.0)))
        faces.append((directions[best], float(scores[best])))
        free &= directions @ directions[best] < np.cos(np.radians(_OTHER_DEG))
    high = [face for face in faces if np.ptp(surface.vertices_mm @ face[0]) > _LEAST_HEIGHT * extent_mm]
    return high or faces


def _scores(directions: Array, pieces: tuple[Array, Array, Array], extent_mm: float) -> Array:
    """Return the area (n,) of the face that each direction (n, 3) sees at the extremity of the body."""
    centres, normals, areas = (values.astype(np.float32) for values in pieces)
    scores = []
    for some in np.array_split(directions.astype(np.float32), _PARTS):
        facing, height = some @ normals.T, some @ centres.T
        facing[height < height.max(axis=1)[:, None] - np.float32(_SLAB * extent_mm)] = 0.0
        facing[facing < np.float32(np.cos(np.radians(_CONE_DEG)))] = 0.0
        scores.append(facing @ areas)
    return np.concatenate(scores)


def _pooled(surface: Surface, cell_mm: float) -> tuple[Array, Array, Array]:
    """Pool triangles by cells of space and main direction: centres (n, 3), unit normals (n, 3), areas (n,).

    Pooling averages the noise of single normals and leaves few pieces of a fine mesh.
    """
    vectors, centres = surface.area_vectors_mm2, surface.centres_mm
    cells = np.floor((centres - centres.min(axis=0)) / cell_mm).astype(np.int64)
    main = np.argmax(np.abs(vectors), axis=1)
    sense = np.take_along_axis(vectors, main[:, None], axis=1)[:, 0] > 0.0
    shape = cells.max(axis=0) + 1
    key = ((cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]) * 6 + 2 * main + sense
    group = np.unique(key, return_inverse=True)[1]
    count = np.bincount(group)
    total = np.stack([np.bincount(group, column) for column in vectors.T], axis=1)
    middle = np.stack([np.bincount(group, column) / count for column in centres.T], axis=1)
    areas = np.linalg.norm(total, axis=1)
    return middle, total / np.maximum(areas[:, None], 1e-30), areas


def sphere(count: int) -> Array:
    """Return directions (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])

"""How well the footplate frame is known: what noise, the rim, the resolution and the blur do to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.frames.footplate_face import (
    FACE_ANGLE_DEG,
    NORMAL_SCALE_MM,
    Solved,
    plane_weights,
    solve,
)
from legacy.ct_inertia.frames.footplate_noise import (
    boundary_covariance,
    edge_covariance,
    height_covariance,
    height_noise,
)
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import vector_from_rotation

_RIM_DEG_PER_MM = calibrated("footplate_uncertainty.rim_deg_per_mm")
_SEEN_RIM_DEG_PER_MM = calibrated("footplate_uncertainty.seen_rim_deg_per_mm")
_SHAPE_LEFT = np.array(calibrated("footplate_uncertainty.shape_left"))
_BLUR_LEFT = calibrated("footplate_uncertainty.blur_left")
_BLUR_SHIFT_1_MM = calibrated("footplate_uncertainty.blur_shift_1_mm")
_BLUR_TILT_RAD_MM2 = calibrated("footplate_uncertainty.blur_tilt_rad_mm2")
_BLUR_MOST_MM = calibrated("footplate_uncertainty.blur_most_mm")
# Accuracy of the axis, rad, of solutions that are only compared: far below the differences that count.
_ROUGH = 3e-5


def contributions_of(solved: Solved, noise_mm4: float = 0.0) -> dict[str, Array]:
    """Return the covariance of the frame by source, (6, 6) each, SI.

    Parameters
    ----------
    solved : Solved
    noise_mm4 : float
        Spectral density of the surface's height noise at long waves beyond what its short waves show: noise
        that neighbours share has few of these.

    Notes
    -----
    Where the blur was taken back, what a step of the angle or of the scale does shows how sensitive this
    shape is to edges sharper than the blur, which do not come back.
    """
    region = solved.region
    y_axis = solved.axes[:, 1]
    shown = height_noise(region.diffusion, _medial_vertices(solved), region.normals, region.grain_mm)
    density = shown + noise_mm4
    frame = (solved.origin, solved.axes)
    heights = height_covariance(frame, solved.face.centres, solved.face.areas, plane_weights)
    noise = density * heights + boundary_covariance(
        frame,
        solved.face.patch,
        solved.face.areas,
        solved.face.centres,
        density,
        FACE_ANGLE_DEG,
        NORMAL_SCALE_MM,
        plane_weights,
        (region.blur_mm, region.grain_mm),
    )
    seen = region.blur_mm > 0.0
    step = min((_SEEN_RIM_DEG_PER_MM if seen else _RIM_DEG_PER_MM) * region.resolution_mm, 6.0)
    wider = solve(region, y_axis, FACE_ANGLE_DEG + step, accuracy=_ROUGH)
    narrower = solve(region, y_axis, FACE_ANGLE_DEG - step, accuracy=_ROUGH)
    rim = 0.5 * _displacement(narrower, wider, solved)
    smoother = solve(region, y_axis, normals=region.smoother, accuracy=_ROUGH)
    blur = 2.0 * (region.resolution_mm / NORMAL_SCALE_MM) ** 2
    resolution = min(blur, 4.0) * _displacement(solved, smoother, solved)
    if seen:
        rim, resolution = _SHAPE_LEFT * rim, _SHAPE_LEFT * resolution
    face = solved.face
    edges = np.zeros((6, 6))
    if seen:
        rim_of = (face.patch, face.areas, face.centres, FACE_ANGLE_DEG, plane_weights)
        edges = edge_covariance(frame, *rim_of, region.blur_mm, region.edge_mm)
    return {
        "noise": noise,
        "edges": edges,
        "rim": np.outer(rim, rim),
        "resolution": np.outer(resolution, resolution),
        "blur": _remaining_blur(region.blur_mm, heights) if seen else _unknown_blur(region.resolution_mm),
    }


def _medial_vertices(solved: Solved) -> NDArray[np.intp]:
    """Return the vertices of the region that face medially."""
    facing = -(solved.region.normals @ solved.axes[:, 1]) > np.cos(np.radians(FACE_ANGLE_DEG))
    return np.flatnonzero(facing)


def _remaining_blur(blur_mm: float, heights: Array) -> Array:
    """Return what is left of the blur where it was taken back, (6, 6), SI.

    Parameters
    ----------
    blur_mm : float
    heights : ndarray, (6, 6)
        What errors of the height that are independent over the face do to the frame, in any unit.

    Notes
    -----
    Blur leaves errors of the height, in proportion to its variance: the next order of what was taken back, in
    the curvatures of the face. They tilt a face less about its short axis (gamma) than about its long one
    (alpha), for arms along x are longer.
    """
    aside, shift, turn = np.array(_BLUR_LEFT) * blur_mm**2
    covariance = np.diag(np.square([aside * 1e-3, shift * 1e-3, aside * 1e-3, 0.0, turn, 0.0]))
    tilts = np.ix_([3, 5], [3, 5])
    covariance[tilts] = turn**2 * heights[tilts] / heights[3, 3]
    return covariance


def _unknown_blur(resolution_mm: float) -> Array:
    """Return the covariance (6, 6), SI, from an unknown point spread: it shifts and tilts the curved face.

    Notes
    -----
    It grows with the square of the resolution. Its size is the bias of a half level found on phantoms whose
    blur is 1.2 voxels, at 20, 25 and 40 um: 1.1, 1.8 and 4.5 um along y.
    """
    square = min(resolution_mm, _BLUR_MOST_MM) ** 2
    shift, tilt = _BLUR_SHIFT_1_MM * square * 1e-3, _BLUR_TILT_RAD_MM2 * square
    return np.diag([0.0, shift**2, 0.0, tilt**2, 0.0, tilt**2])


def _displacement(start: Solved, end: Solved, frame: Solved) -> Array:
    """Return the small motion (6,) from one solution to another, in the axes of ``frame``, m and rad."""
    turned = end.axes * np.sign(np.sum(end.axes * start.axes, axis=0))
    rotation = vector_from_rotation(turned @ start.axes.T)
    shift = (end.origin - start.origin) * 1e-3
    return np.concatenate([frame.axes.T @ shift, frame.axes.T @ rotation])

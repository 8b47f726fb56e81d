"""Paired points of two frames: the least-squares pose between them, its residuals, what cannot be paired."""

from __future__ import annotations

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import cross_matrix


def kabsch(source_mm: Array, target_mm: Array, weights: Array) -> tuple[Array, Array]:
    """Return rotations (..., 3, 3) and shifts (..., 3), mm, of fits of points (..., n, 3), weights (..., n).

    Kabsch 1976 (doi:10.1107/S0567739476001873); the sign of Umeyama 1991 (doi:10.1109/34.88573) makes it
    never a reflection.
    """
    share = (weights / np.sum(weights, axis=-1, keepdims=True))[..., None]
    source_centre, target_centre = (share.swapaxes(-1, -2) @ points for points in (source_mm, target_mm))
    cross = ((source_mm - source_centre) * share).swapaxes(-1, -2) @ (target_mm - target_centre)
    u, _, vt = np.linalg.svd(cross)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    rotation = (u @ vt).swapaxes(-1, -2)
    return rotation, (target_centre - source_centre @ rotation.swapaxes(-1, -2))[..., 0, :]


def misfits(source_mm: Array, target_mm: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return the sums of squares (...) that the best poses leave, residuals (..., n, 3) and rotations."""
    rotation, shift = kabsch(source_mm, target_mm, weights)
    residuals = source_mm @ rotation.swapaxes(-1, -2) + shift[..., None, :] - target_mm
    return np.sum(weights[..., None] * residuals**2, axis=(-2, -1)), residuals, rotation


def pose_rows(points_m: Array) -> Array:
    """Return d(point)/d(displacement of its frame), (n, 3, 6), in the frame's own axes; points (n, 3), m."""
    return np.stack([np.hstack([np.eye(3), -cross_matrix(point)]) for point in points_m])


def check_pairs(source_mm: Array, target_mm: Array) -> None:
    """Refuse points that cannot be paired: fewer than 3, on a line, or with numbers that are not finite."""
    shape = source_mm.shape
    if source_mm.ndim != 2 or shape[1:] != (3,) or shape != target_mm.shape or len(source_mm) < 3:
        got = f"{len(source_mm)} and {len(target_mm)} points"
        want = "made from at least 3 paired points"
        raise StapeskitError.of("a registration", want, got, "", "Add fiducials")
    if not (np.all(np.isfinite(source_mm)) and np.all(np.isfinite(target_mm))):
        raise StapeskitError.of("the coordinates of fiducials", "finite", "NaN or infinity")
    for points in (source_mm, target_mm):
        size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if size[1] < 1e-3 * size[0] or size[0] == 0.0:
            want, step = "spread over a plane, not along a line", "Add a fiducial off the line"
            raise StapeskitError.of("fiducials", want, "points on one line", "", step)

"""The rotation and shift between paired points: in closed form, never a reflection, or with full weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import cross_matrix, rotation_from_vector

# Limit of rounds of reweighting.
_ROUNDS = 50


def kabsch(
    source_mm: Array, target_mm: Array, weights: Array
) -> tuple[Array, Array, NDArray[np.bool_] | np.bool_]:
    """Return the rotation and shift of the weighted least-squares fit of one set of points, or of many.

    Parameters
    ----------
    source_mm, target_mm : ndarray, (..., n, 3)
    weights : ndarray, (..., n)

    Returns
    -------
    rotation : ndarray, (..., 3, 3)
        Proper.
    shift : ndarray, (..., 3)
        mm.
    mirrored : ndarray of bool, (...)
        Whether a reflection would have fitted better.

    Notes
    -----
    Kabsch 1976 (doi:10.1107/S0567739476001873) with the sign of Umeyama 1991 (doi:10.1109/34.88573).
    """
    share = (weights / np.sum(weights, axis=-1, keepdims=True))[..., None]
    source_centre, target_centre = (share.swapaxes(-1, -2) @ points for points in (source_mm, target_mm))
    cross = ((source_mm - source_centre) * share).swapaxes(-1, -2) @ (target_mm - target_centre)
    u, _, vt = np.linalg.svd(cross)
    mirrored = np.linalg.det(u) * np.linalg.det(vt) < 0.0
    u[..., 2] *= np.where(mirrored, -1.0, 1.0)[..., None]
    rotation = (u @ vt).swapaxes(-1, -2)
    return rotation, (target_centre - source_centre @ rotation.swapaxes(-1, -2))[..., 0, :], mirrored


def misfits(source_mm: Array, target_mm: Array, weights: Array) -> tuple[Array, Array]:
    """Return the weighted sums of squares (...) that the best rotation and shift leave, and residuals, mm.

    Parameters
    ----------
    source_mm, target_mm : ndarray, (..., n, 3)
    weights : ndarray, (..., n)
    """
    rotation, shift, _ = kabsch(source_mm, target_mm, weights)
    residuals = source_mm @ rotation.swapaxes(-1, -2) + shift[..., None, :] - target_mm
    return np.sum(weights[..., None] * residuals**2, axis=(-2, -1)), residuals


def pose_rows(points_m: Array) -> Array:
    """Return d(point)/d(displacement of its frame), (n, 3, 6), in the frame's own axes."""
    return np.stack([np.hstack([np.eye(3), -cross_matrix(point)]) for point in points_m])


def refined(
    source_mm: Array, target_mm: Array, rotation: Array, shift: Array, source_var: Array, target_var: Array
) -> tuple[Array, Array]:
    """Refine a fit with variances (n, 3) per axis of either frame (mm2); return rotation and shift, mm.

    Notes
    -----
    Gauss-Newton with the covariance R diag(source) R^T + diag(target) of each difference, as in
    weighted total least squares of rigid motions (Ohta and Kanatani 1998, Optimal estimation of
    three-dimensional rotation and reliability evaluation, ECCV).
    """
    for _ in range(_ROUNDS):
        weights = pair_weights(rotation, source_var, target_var)
        rows = rotation @ pose_rows(source_mm)
        miss = source_mm @ rotation.T + shift - target_mm
        weighted = np.einsum("nji,njk->nik", rows, weights)
        information = np.einsum("nij,njk->ik", weighted, rows)
        score = -np.einsum("nij,nj->i", weighted, miss)
        scale = 1.0 / np.sqrt(np.diag(information))
        step = scale * np.linalg.solve(information * np.outer(scale, scale), scale * score)
        shift = shift + rotation @ step[:3]
        rotation = rotation @ rotation_from_vector(step[3:])
        if np.max(np.abs(step * np.sqrt(np.diag(information)))) < 1e-9:
            break
    return rotation, shift


def pair_weights(rotation: Array, source_var: Array, target_var: Array) -> Array:
    """Return the inverse covariances (n, 3, 3), 1/mm2, of the differences of pairs in target axes."""
    turned = np.einsum("ij,nj,kj->nik", rotation, source_var, rotation)
    turned[:, [0, 1, 2], [0, 1, 2]] += target_var
    return np.asarray(np.linalg.inv(turned))


def pose_covariance(points_mm: Array, weights: Array) -> Array:
    """Return the covariance (6, 6), SI, of the displacement of the source frame about its origin.

    Parameters
    ----------
    points_mm : ndarray, (n, 3)
        In the source frame.
    weights : ndarray, (n, 3, 3)
        Inverse covariances of the differences in SOURCE axes, 1/mm2.
    """
    total = np.trace(weights, axis1=1, axis2=2)
    centre = total @ points_mm / np.sum(total) * 1e-3
    rows = pose_rows(points_mm * 1e-3 - centre)
    information = np.einsum("nji,njk,nkl->il", rows, weights * 1e6, rows)
    scale = 1.0 / np.sqrt(np.diag(information))
    about_centre = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    move = np.eye(6)
    move[:3, 3:] = cross_matrix(centre)
    covariance = move @ about_centre @ move.T
    return np.asarray(0.5 * (covariance + covariance.T))

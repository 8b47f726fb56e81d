"""What is not known of the plate's face: its part in the covariance of the moments and of the frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.partial_volume import sensitivity, voxel_effects
from legacy.ct_inertia.grey.plate_face import FaceFit
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

# Distance from the face, in standard deviations of its blur, from which it changes no grey value (0.02 %).
_WIDTHS = 3.5
_DISPLACED_SD = calibrated("plate_face_doubt.displaced_sd")
_LEAST_DOUBT = calibrated("plate_face_doubt.least_doubt")


def face_covariance(
    fit: FaceFit,
    volume: Volume,
    cut: Cut,
    where: NDArray[np.bool_],
    contrast: float,
    moments: Moments,
    displaced: NDArray[np.float32] | None = None,
) -> Array:
    """Return the covariance (10, 10) of the stapes' moments from what is not known of the plate's face.

    Parameters
    ----------
    fit : FaceFit
    volume : Volume
    cut : Cut
    where : ndarray of bool, [z, y, x]
        Voxels that the face was subtracted from.
    contrast : float
        Bone minus air.
    moments : Moments
    displaced : ndarray of float32, [z, y, x], optional
        As from ``displaced_share``: known with a relative deviation: voxels are shared by bone and plastic.
    """
    face = fit.face
    points = volume.scan_points(np.argwhere(where)[:, ::-1] + cut.first)
    z = (points @ face.normal - face.offset_mm) / face.sigma_mm
    touched = z < _WIDTHS
    points, z = points[touched], z[touched]
    slope = (face.plastic - face.air) * normal_density(z) / face.sigma_mm
    flat = (points - fit.centre) @ fit.basis
    cover = normal_cdf(-z)
    design = np.column_stack([slope, -slope * flat[:, 0], -slope * flat[:, 1], slope * z, -cover, cover])
    voxel = volume.voxel_mm3 / contrast
    f = sensitivity(points - moments.centroid_mm, moments.volume_mm3, 0.0)
    linear = voxel * f.T @ design
    covariance = linear @ fit.covariance @ linear.T
    if displaced is not None:
        effects, _ = voxel_effects(displaced, (displaced > 0.0) & where, cut.first, volume, moments)
        step = _DISPLACED_SD / contrast * effects.sum(axis=0)
        covariance = covariance + np.outer(step, step)
    return np.asarray(covariance)


def face_doubt(
    fit: FaceFit, volume: Volume, cut: Cut, where: NDArray[np.bool_], contrast: float
) -> NDArray[np.float32] | None:
    """Return by how much the share of bone may be wrong at once for the place of the face; None where little.

    Parameters as for ``face_covariance``; [z, y, x].

    Notes
    -----
    One standard deviation along that combination of height and slopes which changes the grey values near the
    stapes most.
    """
    face = fit.face
    index = np.argwhere(where)
    points = volume.scan_points(index[:, ::-1] + cut.first)
    z = (points @ face.normal - face.offset_mm) / face.sigma_mm
    slope = (face.plastic - face.air) * normal_density(z) / face.sigma_mm
    flat = (points - fit.centre) @ fit.basis
    design = np.column_stack([slope, -slope * flat[:, 0], -slope * flat[:, 1]]) / contrast
    values, vectors = np.linalg.eigh(fit.covariance[:3, :3])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, along = np.linalg.eigh((design @ root).T @ (design @ root))
    change = design @ (root @ along[:, -1])
    if not np.any(np.abs(change) > _LEAST_DOUBT):
        return None
    doubt = np.zeros(where.shape, dtype=np.float32)
    doubt[where] = change
    return doubt

"""Closed voids inside the bone: does air fill them, or fluid or marrow, and can the scan show it?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.grey.levels import Air
from ct_inertia.grey.partial_volume import sensitivity
from ct_inertia.segment.cutting import Cut
from ct_inertia.surface.moments import Moments
from ct_inertia.volume.grids import dilated, gaussian, labelled, used_box
from ct_inertia.volume.volume import Volume
from stapeskit.warnings import Notice

Array = NDArray[np.float64]

_LEAST_VOXELS = calibrated("voids.least_voxels")
# Voids are looked at from this distance to bone on, in widths of the blur.
_CLEAR_OF_BLUR = 1.5
_LEAST_SHARE = calibrated("voids.least_share")
_BLUR_DOUBT = calibrated("voids.blur_doubt")
_SIGNIFICANT = calibrated("voids.significant")
_FILLING_SD = calibrated("voids.filling_sd")
_REPORTED = calibrated("voids.reported_share")


@dataclass(frozen=True)
class Voids:
    """Closed voids.

    Attributes
    ----------
    mask : ndarray of bool, [z, y, x]
    seen : bool
        They are wide enough to show what fills them.
    filled : bool
        Something brighter than air fills them.
    """

    mask: NDArray[np.bool_]
    seen: bool
    filled: bool


def closed_voids(
    cut: Cut, distance_mm: NDArray[np.float32], spacing_mm: Array, levels: tuple[Air, float], sigma_mm: float
) -> Voids | None:
    """Find the voids that the stapes encloses, and what the grey values far from their walls show.

    Parameters
    ----------
    cut : Cut
    distance_mm : ndarray of float32, [z, y, x]
        From the stapes.
    spacing_mm : ndarray, (3,)
    levels : (Air, bone)
    sigma_mm : float
        Standard deviation of the point spread.
    """
    air, bone = levels
    labels, count = labelled(~cut.stapes)
    if count < 2:
        return None
    sizes = np.bincount(labels.ravel())
    for axis in range(3):
        for end in (0, -1):
            sizes[np.unique(np.take(labels, end, axis))] = 0
    sizes[0] = 0
    mask = (sizes > _LEAST_VOXELS)[labels]
    around = 1 + int(np.ceil(4.0 * sigma_mm / float(spacing_mm.min())))
    box = used_box(dilated(mask, around)) if np.any(mask) else None
    if box is None:
        return None
    blurred = gaussian(cut.stapes[box].astype(np.float32), sigma_mm / spacing_mm[::-1])
    clear = mask[box] & (distance_mm[box] > np.float32(_CLEAR_OF_BLUR * sigma_mm))
    grey, expected = cut.grey[box][clear], float(blurred[clear].mean()) if np.any(clear) else 0.0
    if grey.size < _LEAST_VOXELS:
        return Voids(mask, False, False)
    rest = (float(grey.mean()) - air.level) / (bone - air.level) - expected
    noise = air.noise / (bone - air.level) * np.sqrt(air.correlation / grey.size)
    filled = rest > max(_LEAST_SHARE + _BLUR_DOUBT * expected, _SIGNIFICANT * noise)
    return Voids(mask, True, bool(filled))


def by_unseen_voids(voids: Voids, cut: Cut, volume: Volume, moments: Moments) -> Array:
    """Return the covariance (10, 10) of what may fill voids too narrow to show it, common to all of them."""
    index = np.argwhere(voids.mask)
    away = volume.scan_points(index[:, ::-1] + cut.first) - moments.centroid_mm
    step = sensitivity(away, moments.volume_mm3, 0.0).sum(axis=0) * volume.voxel_mm3 * _FILLING_SD
    return np.outer(step, step)


def void_notices(voids: Voids, volume: Volume, moments: Moments) -> list[Notice]:
    """Report voids whose filling the scan cannot show."""
    share = float(np.count_nonzero(voids.mask)) * volume.voxel_mm3 / moments.volume_mm3
    if voids.seen or share * _FILLING_SD < _REPORTED:
        return []
    text = (
        f"Closed voids inside the stapes ({100.0 * share:.1f} % of its volume) are narrower than the blur of "
        f"the scan: whether air or fluid fills them is not visible. Air is assumed, and the budget holds "
        f"{100.0 * share * _FILLING_SD:.2f} % for it (voids). Scan with smaller voxels, or dry the sample."
    )
    return [Notice("void_filling_unknown", text)]

"""The stapes parted from its surroundings by a marker watershed, and its grey values summed: a short script.

Its inputs are what ct2mass determines by itself: the grey levels of air and bone, the blur and the place of
the stapes; and the true volume, by which it chooses among basins and depths of erosion.
"""

from __future__ import annotations

from typing import Any

import numpy as np

DEPTHS = (2.5, 3.0, 3.5, 4.0)
_REACH_VOXELS = 6.0
_LEAST_MARKER = 200


def watershed_integral(
    grey: Any, spacing: float, levels: tuple[float, float], sigma_mm: float, exact_mm3: float
) -> tuple[float, Any, Any, float]:
    """Return volume (mm3), centre (mm), second moments about it (mm5) and the depth of erosion (voxels).

    Parameters
    ----------
    grey : ndarray, [z, y, x]
    spacing : float
        mm, the same along x, y, z.
    levels : (air, bone)
    sigma_mm : float
        Of the blur; its second moment is subtracted, and that of a voxel.
    exact_mm3 : float

    Notes
    -----
    Above the middle level the bone is eroded until the gap's bridges break; the components are the markers
    of a watershed of the negative grey values within six voxels of the bone; the stapes is the basin whose
    shares of bone, not clipped, sum nearest to the true volume, at the depth where they do so best.
    """
    from scipy.ndimage import distance_transform_edt, label
    from skimage.segmentation import watershed

    air, bone = levels
    share = (grey.astype(np.float32) - air) / (bone - air)
    mask = share > 0.5
    depth = distance_transform_edt(mask)
    wide = distance_transform_edt(~mask) <= _REACH_VOXELS
    best = None
    for eroded in DEPTHS:
        markers, count = label(depth > eroded)
        small = np.bincount(markers.ravel(), minlength=count + 1) < _LEAST_MARKER
        markers[small[markers]] = 0
        basins = watershed(-share, markers, mask=wide)
        volumes = np.bincount(basins.ravel(), share.ravel(), minlength=count + 1) * spacing**3
        volumes[np.bincount(basins.ravel(), minlength=count + 1) == 0] = np.inf
        volumes[0] = np.inf
        name = int(np.argmin(np.abs(volumes - exact_mm3)))
        if best is None or abs(volumes[name] - exact_mm3) < abs(best[0] - exact_mm3):
            best = float(volumes[name]), basins == name, eroded
    volume, own, eroded = best  # type: ignore[misc]
    points, weight = np.argwhere(own)[:, ::-1] * spacing, share[own].astype(float)
    centre = weight @ points / weight.sum()
    second = ((points - centre) * weight[:, None]).T @ (points - centre) * spacing**3
    second -= volume * (sigma_mm**2 + spacing**2 / 12.0) * np.eye(3)
    return volume, centre, second, eroded

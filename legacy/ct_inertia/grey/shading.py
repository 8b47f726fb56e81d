"""What grey values that change across bone and air do to the moments: slopes and cupping."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.bone_level import Bone
from legacy.ct_inertia.grey.cupping import Cupping
from legacy.ct_inertia.grey.partial_volume import Share, sensitivity
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array


def unweighted_centre(moments: Moments, bone: Bone, air: float, volume: Volume, cut: Cut) -> Array:
    """Return the centroid (3,), from the box's first voxel along its axes, as if bone were uniform.

    A weight 1 + b . (r - c) moves the centroid by S b / V and has the mean 1 over the body: the level at c is
    that of the body as a whole.
    """
    slope = volume.direction @ bone.slope / (bone.level - air)
    centre = moments.centroid_mm - moments.second_mm5 @ slope / moments.volume_mm3
    return np.asarray((volume.index_points(centre) - cut.first) * volume.spacing_mm)


def slope_effect(share: Share, bone: Bone, volume: Volume, moments: Moments) -> Array:
    """Return what taking bone of sloping grey values as it is, not as uniform, adds to the moments (10,)."""
    away = (share.index @ (volume.direction * volume.spacing_mm).T) + volume.origin_mm - moments.centroid_mm
    contrast = share.bone - share.air
    along = (share.index * volume.spacing_mm) @ bone.slope
    w = (share.grey - share.air) / contrast
    change = w * (along - (w @ along) / w.sum()) / contrast
    return np.asarray(sensitivity(away, moments.volume_mm3, 0.0).T @ change * volume.voxel_mm3)


def cupping_effect(share: Share, cupping: Cupping, volume: Volume, cut: Cut, moments: Moments) -> Array:
    """Return what cupping adds to the moments (10,) of bone that is uniform."""
    away = (share.index @ (volume.direction * volume.spacing_mm).T) + volume.origin_mm - moments.centroid_mm
    contrast = share.bone - share.air
    w = (share.grey - share.air) / contrast
    change = w * cupping.at((share.index - cut.first) * volume.spacing_mm) / contrast
    return np.asarray(sensitivity(away, moments.volume_mm3, 0.0).T @ change * volume.voxel_mm3)


def as_shares(step: Array, moments: Moments) -> tuple[float, float, float]:
    """Return a change of the moments (10,) as a share of the volume, mm, and a share of the inertia."""
    spread = abs(float(step[4:7].sum())) / float(np.trace(moments.second_mm5))
    return abs(float(step[0])) / moments.volume_mm3, float(np.linalg.norm(step[1:4])), spread


def air_slope_covariance(share: Share, air: Air, volume: Volume, moments: Moments) -> Array:
    """Return the covariance (10, 10) from an air level that changes across the box, each axis by itself."""
    points = (share.index @ (volume.direction * volume.spacing_mm).T) + volume.origin_mm
    away = points - moments.centroid_mm
    voxel = volume.voxel_mm3 / (share.bone - share.air)
    w = (share.grey - share.air) / (share.bone - share.air)
    change = (1.0 - w)[:, None] * (away @ volume.direction) * np.array(air.slope)
    steps = voxel * sensitivity(away, moments.volume_mm3, 0.0).T @ change
    return np.asarray(steps @ steps.T)

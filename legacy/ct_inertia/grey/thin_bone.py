"""The bone level where blur leaves hardly a voxel pure: from all voxels that are nearly bone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air, Surroundings
from legacy.ct_inertia.grey.bone_level import Bone, bone_of
from legacy.ct_inertia.grey.level_fit import BodyFit, blurred

_NEARLY = calibrated("thin_bone.fitted_share")
_MORE_NEARLY = calibrated("thin_bone.compared_share")
_LEAST = calibrated("thin_bone.least_voxels")
_TREND_SD = calibrated("thin_bone.trend_sd")


def thin_bone(
    fit: BodyFit, around: Surroundings, own: NDArray[np.bool_], box: tuple[slice, ...], air: Air
) -> Bone | None:
    """Measure level, slope and unevenness of bone from voxels that a fitted body fills nearly.

    Parameters
    ----------
    fit : BodyFit
    around : Surroundings
    own : ndarray of bool, [z, y, x]
        Voxels of the box that were fitted.
    box : tuple of slice
        Where in ``around`` the fit was made.
    air : Air

    Returns
    -------
    Bone or None
        None with too few such voxels.

    Notes
    -----
    With m the blurred share of the fitted body, grey values above air are L m + b (1 - m) + c (1 - m)^2 and
    a slope over the places: an error of the fitted surface or blur shows as b and c, so that L is the level
    at m = 1, where none of them counts. What b and c take from each voxel leaves its own level, which is
    looked at like that of pure bone. Where L and the plain mean over m > 0.95 differ, the blur was not
    Gaussian enough or the body too thin: the uncertainty holds a share of that.
    """
    model = blurred(fit.body, fit.sigma_mm, around.spacing_mm[::-1])
    inner = own & (model > _NEARLY)
    if np.count_nonzero(inner) < _LEAST:
        return None
    m = model[inner].astype(float)
    excess = around.grey[box][inner].astype(float) - air.level
    start = np.array([s.start for s in reversed(box)])
    index = np.stack(np.nonzero(inner)[::-1], axis=1) + start
    places = index * around.spacing_mm
    trend = np.column_stack([1.0 - m, (1.0 - m) ** 2])
    design = np.column_stack([m, trend, (places - places.mean(axis=0)) * m[:, None]])
    # Pseudo-inverse: voxels of one layer only say nothing about the slope across it.
    inverse = np.linalg.pinv(design.T @ design, hermitian=True)
    fitted = inverse @ (design.T @ excess)
    left = excess - design @ fitted
    random = float(np.sqrt(inverse[0, 0] * left.var() * air.correlation))
    values = air.level + (excess - trend @ fitted[1:3]) / m
    most = m > _MORE_NEARLY
    plain = float((excess[most] / m[most]).mean()) if np.any(most) else float(fitted[0])
    rest = _TREND_SD * abs(plain - float(fitted[0]))
    seen = most if np.count_nonzero(most) >= _LEAST else np.ones(len(m), dtype=bool)
    bone = bone_of(values[seen], places[seen], air, random, rest, around)
    return replace(bone, found_by="fit", seen=0.0)

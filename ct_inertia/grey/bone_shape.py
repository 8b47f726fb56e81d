"""The shape of a bone whose grey value varies: the unweighted moments behind the grey-weighted ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ct_inertia.bodies import MeasuredBody, Moments
from ct_inertia.find.distance import used_box
from stapeskit.arrays import Array

_DEEP = 0.999  # blurred share from which a voxel is bone alone
_LEAST_VOXELS = 200  # below, no slope is fitted: a line through space has four unknowns


def shape_moments(measured: MeasuredBody) -> Moments:
    """Return the moments of the bone's shape, every part of it counted alike.

    Parameters
    ----------
    measured : MeasuredBody
        With the grey-weighted moments, where denser bone counts more. Without grey values they are those of
        the shape.

    Notes
    -----
    Deep inside the bone the share of bone is fitted by a straight line through space, b0 + g . (r - c). With
    the grey-weighted moments V, c, S and the third central moments T of the body, dividing by that line gives
    to first order (volume: second) in g: V (1 + g C g) / b0, c - C g / b0 and (S - T g / b0) / b0 with C = S
    / V.
    """
    grey = measured.moments
    level, slope = _brightness(measured)
    slope = slope / level
    pull = grey.second_mm5 @ slope / grey.volume_mm3
    second = (grey.second_mm5 - _third_moments(measured) @ slope) / level
    volume = grey.volume_mm3 * (1.0 + float(slope @ pull)) / level
    return replace(grey, volume_mm3=volume, centroid_mm=grey.centroid_mm - pull, second_mm5=second)


def _brightness(measured: MeasuredBody) -> tuple[float, Array]:
    """Return the line b0 and g (3,), 1/mm, in scan axes about the centroid; 1 and 0 where little is deep."""
    scene = measured.scene
    if scene is None:
        return 1.0, np.zeros(3)
    deep = np.argwhere(scene.own & (scene.share > np.float32(_DEEP)))
    if len(deep) < _LEAST_VOXELS:
        return 1.0, np.zeros(3)
    deep = deep[:: max(1, len(deep) // 200_000)]
    values = scene.excess[tuple(deep.T)] / scene.share[tuple(deep.T)]
    arms = measured.labelled.box.scan_points(deep[:, ::-1]) - measured.moments.centroid_mm
    line = np.linalg.lstsq(np.column_stack([np.ones(len(arms)), arms]), values.astype(float), rcond=None)[0]
    return float(line[0]), np.asarray(line[1:])


def _third_moments(measured: MeasuredBody) -> Array:
    """Return the integral of r r r dV over the sharp body about the centroid, (3, 3, 3), mm6."""
    box = measured.labelled.box
    body = box.grey if measured.scene is None else measured.scene.body
    used = used_box(body > 0.0) or (slice(0, 1),) * 3
    index = np.argwhere(body[used] > 0.0)
    weight = body[used][tuple(index.T)].astype(float) * box.voxel_mm3
    corner = np.array([part.start for part in used])
    arms = box.scan_points((index + corner)[:, ::-1]) - measured.moments.centroid_mm
    weighted = arms * weight[:, None]
    return np.asarray(np.einsum("ni,nj,nk->ijk", weighted, arms, arms, optimize=True))

"""The shape of a bone whose grey value varies: the unweighted moments behind the grey-weighted ones."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.bodies import STAPES
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.arrays import Array

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies


# Depth below the surface, in standard deviations of the blur, from which bone is pure: 0.1 % of air is left.
_DEPTH_SIGMAS = 3.0
# Grid on which the grey value's slope is fitted, mm: fine enough for a straight line through a stapes.
_COARSE_MM = 0.03
# Pure voxels below which no slope is fitted. Chosen by judgement: a line through space has four unknowns.
_LEAST_VOXELS = 200
# Barycentric coordinates and weights of five points in a tetrahedron, exact to the third degree.
_CUBATURE = (
    np.vstack([np.full(4, 0.25), np.full((4, 4), 1.0 / 6.0) + np.eye(4) / 3.0]),
    np.array([-0.8, 0.45, 0.45, 0.45, 0.45]),
)


def shape_moments(bodies: Bodies, air: float, bone: float) -> Moments:
    """Return the moments of the bone's shape, every part of it counted alike.

    Parameters
    ----------
    bodies : Bodies
        With the grey-weighted moments, where denser bone counts more.
    air, bone : float
        Grey levels that those moments are scaled with.

    Notes
    -----
    Deep inside the bone the grey value is fitted by b(r) = air + (bone - air) (b0 + g . (r - c)), a straight
    line through space. With the grey-weighted moments V, c, S and the third central moments T of the closed
    surface, dividing by that line gives to first order (volume: second) in g
    V (1 + g C g) / b0, c - C g / b0 and (S - T g / b0) / b0 with C = S / V.
    """
    grey = bodies.moments
    level, slope = _brightness(bodies, air, bone)
    slope = slope / level
    pull = grey.second_mm5 @ slope / grey.volume_mm3
    second = (grey.second_mm5 - _third_moments(bodies.stapes, grey.centroid_mm) @ slope) / level
    volume = grey.volume_mm3 * (1.0 + float(slope @ pull)) / level
    return replace(grey, volume_mm3=volume, centroid_mm=grey.centroid_mm - pull, second_mm5=second)


def _brightness(bodies: Bodies, air: float, bone: float) -> tuple[float, Array]:
    """Return the line b0 and g (3,), 1/mm, in scan axes about the centroid; 1 and 0 where little is deep."""
    from scipy.ndimage import distance_transform_edt

    volume = bodies.volume
    index = volume.index_points(bodies.stapes.vertices_mm)
    labels = bodies.labels
    low = np.maximum(np.floor(index.min(axis=0)).astype(np.int64), labels.first_index)
    high = np.minimum(np.ceil(index.max(axis=0)).astype(np.int64) + 1, labels.end_index)
    step = np.maximum(1, (_COARSE_MM / volume.spacing_mm).astype(np.int64))
    x, y, z = (slice(int(a), int(b), int(s)) for a, b, s in zip(low, high, step, strict=True))
    inside = labels.read(low, high)[tuple(slice(None, None, int(s)) for s in step[::-1])] == STAPES
    deep_mm = _DEPTH_SIGMAS * bodies.psf_sigma_mm + 0.5 * float(np.max(volume.spacing_mm))
    spacing = (volume.spacing_mm * step)[::-1].tolist()
    deep = np.argwhere(
        distance_transform_edt(np.pad(inside, 1), sampling=spacing)[1:-1, 1:-1, 1:-1] > deep_mm
    )
    if len(deep) < _LEAST_VOXELS:
        return 1.0, np.zeros(3)
    grey = np.asarray(volume.array[z, y, x])[tuple(deep.T)].astype(float)
    arms = volume.scan_points(deep[:, ::-1] * step + low) - bodies.moments.centroid_mm
    design = np.column_stack([np.ones(len(arms)), arms])
    line = np.linalg.lstsq(design, (grey - air) / (bone - air), rcond=None)[0]
    return float(line[0]), np.asarray(line[1:])


def _third_moments(surface: Surface, centre_mm: Array) -> Array:
    """Return the integral of r r r dV about a point, (3, 3, 3), mm6: exact on the tetrahedra of each face.

    Notes
    -----
    Cubature of degree 3 with five points (Zienkiewicz and Taylor, The Finite Element Method, 6th ed.,
    table 5.3).
    """
    corners = surface.vertices_mm[surface.faces] - centre_mm
    six = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = np.zeros((3, 3, 3))
    for share, weight in zip(*_CUBATURE, strict=True):
        r = np.einsum("k,fki->fi", share[1:], corners)
        total += np.einsum("f,fi,fj,fk->ijk", weight * six / 6.0, r, r, r, optimize=True)
    return total

"""The gap between the rim of the footplate and the wall of the oval window, which the ligament bridges.

The definition. The rim is what of the stapes looks outward along the plane of the medial face, from 0.3 mm
below the lowest point of that face to 0.45 mm above it. The gap at a place of the rim is the shortest
distance to the surface of other bone that looks back, where that is at most 0.25 mm; as a number the median
over equal steps along the outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.frames.footplate import FootplateFrame
from ct_inertia.frames.footplate_face import EDGE_MM, NORMAL_SCALE_MM
from ct_inertia.surface.fields import refined, ring_normals, sum_at_corners, unit
from ct_inertia.surface.surface import Surface, chosen_part
from stapeskit.arrays import Array

FARTHEST_MM = 0.25
"""Farthest wall that counts as opposite: what surely lies in the box around the stapes."""

_STEP_MM = 0.06  # between places along the rim: about the scale of the normals, and more than the triangles
_HEIGHT_MM, _BELOW_MM = 0.45, 0.3  # the window's depth
_FACING = 0.5  # cosine of the angle within which a surface looks at the wall
_NEAREST = 0.1  # share of the points at a place whose mean is the gap: the least alone is too small by noise
_LEAST_SHARE = 0.5  # of the rim with a wall opposite, below which the median says nothing about the rest
_MOST_SD = 0.5  # of the gap, above which it is not stated: zero is within two standard deviations
_BLUR_SD, _LEAST_SD_MM = calibrated("gap.blur_sd"), calibrated("gap.least_sd_mm")


@dataclass(frozen=True)
class WindowGap:
    """The gap around the footplate.

    Attributes
    ----------
    median_mm, sd_mm : float
        Median along the rim, and its standard deviation.
    harmonic_mm : float
        Harmonic mean: a ligament of even thickness is as stiff as one with this gap all round.
    spread_mm : float
        Standard deviation along the rim.
    rim_share : float
        Share of the rim that has a wall opposite.
    outline_mm : ndarray, (n, 2)
        Places of the rim, x and z in footplate axes.
    along_mm : ndarray, (n,)
        The gap there; NaN where no wall is opposite.
    """

    median_mm: float
    sd_mm: float
    harmonic_mm: float
    spread_mm: float
    rim_share: float
    outline_mm: Array
    along_mm: Array


def window_gap(
    footplate: FootplateFrame, surface: Surface, wall: Surface, resolution_mm: float, level_sd_mm: float
) -> WindowGap | None:
    """Measure the gap; None where less than half of the rim has a wall opposite, or its sd is half of it.

    Parameters
    ----------
    surface, wall : Surface
        Of the stapes and of other bone, scan coordinates.
    resolution_mm : float
        Standard deviation of the blur of the scan.
    level_sd_mm : float
        Of one shift of either surface along its normal, in common.
    """
    to_footplate = footplate.scan_from_footplate.inverse()
    places, outward = _places(footplate.outline_mm)
    low = float(footplate.outline_mm[:, 1].min())
    rim = _near(to_footplate.points(surface.vertices_mm), surface, low, places)
    other = _near(to_footplate.points(wall.vertices_mm), wall, low, places)
    if rim is None or other is None:
        return None
    along = _distances(rim, other, places, outward)
    there = np.isfinite(along)
    share = float(np.mean(there))
    if share < _LEAST_SHARE:
        return None
    widths = along[there]
    median = float(np.median(widths))
    # Two surfaces that near share their tails; both move with the level.
    over = float(np.exp(-0.5 * (median / max(resolution_mm, 1e-9)) ** 2)) * resolution_mm
    sd = float(np.sqrt((2.0 * level_sd_mm) ** 2 + (_BLUR_SD * over) ** 2 + _LEAST_SD_MM**2))
    if sd > _MOST_SD * median:
        return None
    harmonic = float(1.0 / np.mean(1.0 / widths))
    return WindowGap(median, sd, harmonic, float(np.std(widths)), share, places, along)


def _places(outline_mm: Array) -> tuple[Array, Array]:
    """Return places (n, 2) at equal steps along an outline, x and z, and the outward directions there."""
    closed = np.vstack([outline_mm, outline_mm[:1]])[:, [0, 2]]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(int(way[-1] / _STEP_MM), 24)
    at = np.arange(count) / count * way[-1]
    places = np.column_stack([np.interp(at, way, closed[:, k]) for k in range(2)])
    tangent = np.roll(places, -3, axis=0) - np.roll(places, 3, axis=0)
    outward = unit(np.column_stack([tangent[:, 1], -tangent[:, 0]]))
    inward = np.sum(outward * (places - places.mean(axis=0))) < 0.0
    return places, -outward if inward else outward


def _near(points: Array, surface: Surface, low: float, places: Array) -> tuple[Array, Array] | None:
    """Return vertices (n, 3) and normals (n, 3) of the part of a surface near the rim, in footplate axes."""
    from scipy.spatial import cKDTree

    margin = 2.0 * NORMAL_SCALE_MM
    high = (points[:, 1] > low - _BELOW_MM - margin) & (points[:, 1] < low + _HEIGHT_MM + margin)
    near = np.zeros(len(points), dtype=bool)
    near[high] = cKDTree(places).query(points[high][:, [0, 2]])[0] < FARTHEST_MM + margin
    inside = np.all(near[surface.faces], axis=1)
    if not inside.any():
        return None
    vertices, faces = refined(*chosen_part(points, surface.faces, inside), EDGE_MM)
    return vertices, unit(sum_at_corners(faces, ring_normals(Surface(vertices, faces)), len(vertices)))


def _distances(rim: tuple[Array, Array], wall: tuple[Array, Array], places: Array, outward: Array) -> Array:
    """Return the gap at each place (n,), NaN without a wall."""
    from scipy.spatial import cKDTree

    points, normals = rim
    owner = cKDTree(places).query(points[:, [0, 2]])[1]
    facing = np.sum(normals[:, [0, 2]] * outward[owner], axis=1) > _FACING
    points, normals, owner = points[facing], normals[facing], owner[facing]
    nearest = cKDTree(wall[0]).query(points)[1]
    step, against = wall[0][nearest] - points, wall[1][nearest]
    across = -np.sum(step * against, axis=1)
    length = np.linalg.norm(step, axis=1)
    beside = np.sqrt(np.maximum(length**2 - across**2, 0.0))
    # Within a triangle of the nearest vertex the wall is plane; farther, an edge of the wall is nearest.
    distance = np.hypot(across, np.maximum(beside - EDGE_MM, 0.0))
    ahead = np.sum(step[:, [0, 2]] * outward[owner], axis=1) > _FACING * length
    opposite = np.sum(against * normals, axis=1) < -_FACING
    seen = ahead & opposite & (across > 0.0) & (distance < FARTHEST_MM)
    gap = np.full(len(places), np.nan)
    distance, owner = distance[seen], owner[seen]
    for place in np.unique(owner):
        here = np.sort(distance[owner == place])
        gap[place] = here[: int(np.ceil(_NEAREST * len(here)))].mean()
    return gap

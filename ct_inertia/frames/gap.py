"""The gap between the rim of the footplate and the wall of the oval window, which the ligament bridges.

The definition. The rim is what of the stapes looks outward along the plane of the medial face, from 0.3 mm
below the lowest point of that face to 0.45 mm above it. Both surfaces are averaged over 0.05 mm, since bumps
of rough ones would be nearest. The gap at a place of the rim is the shortest distance to the surface of other
bone that looks back, where that is at most 0.25 mm, averaged over the layer of 0.03 mm where that is least
around the place; as a number the median over equal steps along the outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import BodySurface, MeasuredBody
from ct_inertia.calibrated import calibrated
from ct_inertia.frames.footplate import FootplateFrame
from ct_inertia.frames.footplate_face import EDGE_MM, NORMAL_SCALE_MM
from ct_inertia.surface.fields import Diffusion, refined, unit
from ct_inertia.surface.repair import pieces
from ct_inertia.surface.surface import Surface, chosen_part
from stapeskit.arrays import Array

FARTHEST_MM = 0.25
"""Farthest wall that counts as opposite: what surely lies in the box around the stapes."""

_STEP_MM = 0.06  # between places along the rim: about the scale of the normals, and more than the triangles
_HEIGHT_MM, _BELOW_MM = 0.45, 0.3  # the window's depth
_FACING = 0.5  # cosine of the angle within which a surface looks at the wall
_SPECK = 0.01  # of the triangles near the rim: smaller pieces are specks of noise
_LAYER_MM, _NEIGHBOURS = 0.03, 5  # layers of the rim, and places each way over which they are compared
_APART = 3  # places between which noise has nothing in common
_LEAST_POINTS = 0.25  # of those of the fullest layer: a layer with fewer is the end of what looks outward
_LEAST_SHARE = 0.5  # of the rim with a wall opposite, below which the median says nothing about the rest
_MOST_SD = 0.5  # of the gap, above which it is not stated: zero is within two standard deviations
_CHOSEN_BY_NOISE = 0.2  # bias by choosing the nearest layer, over the noise of one place
_TAILS_SD, _EDGES_SD = calibrated("gap.tails_sd"), calibrated("gap.edges_sd")


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
    footplate: FootplateFrame,
    surface: Surface,
    wall: Surface,
    bodies: tuple[BodySurface, BodySurface] | None = None,
    medium: float = 0.0,
) -> WindowGap | None:
    """Measure the gap; None where less than half of the rim has a wall opposite, or its sd is half of it.

    ``surface`` and ``wall`` are those of the stapes and of other bone, in scan coordinates; ``bodies``: how
    both err, None: not at all; ``medium``: contrast of a fluid around the stapes, as a share of bone's.

    Notes
    -----
    Both surfaces move with the level. Second differences of the gap over places farther apart than what is
    averaged show the noise of one place, six times its variance: the median of n places, every third by
    itself, has pi / 2 times 3 / n of it; and noise chooses the layer where the rim is nearest. Two surfaces
    that are near share their tails, and blur leaves edges rounded. In a gap narrower than the blur, fluid
    of a contrast c looks like bone: half of it moves each edge by c / 2 times sqrt(2 pi) blur widths.
    """
    to_footplate = footplate.scan_from_footplate.inverse()
    places, outward = _places(footplate.outline_mm)
    low = float(footplate.outline_mm[:, 1].min())
    rim, other = (_near(to_footplate.points(one.vertices_mm), one, low, places) for one in (surface, wall))
    if rim is None or other is None:
        return None
    along = _distances(rim, other, places, outward)
    there = np.isfinite(along)
    share = float(np.mean(there))
    if share < _LEAST_SHARE:
        return None
    widths = along[there]
    median = float(np.median(widths))
    at_rim = footplate.scan_from_footplate.points(footplate.outline_mm)
    sd = 0.0 if bodies is None else _standard_deviation(median, along, bodies, medium, at_rim)
    if sd > _MOST_SD * median:
        return None
    harmonic = float(1.0 / np.mean(1.0 / widths))
    return WindowGap(median, sd, harmonic, float(np.std(widths)), share, places, along)


def fluid_contrast_at_rim(measured: MeasuredBody, footplate: FootplateFrame) -> float:
    """Return the contrast, over bone's, of fluid at the rim, which may have been taken for a plate."""
    from scipy.spatial import cKDTree

    found, scene = measured.labelled, measured.scene
    medium = 0.0 if scene is None else scene.media.get("soft", 0.0)
    if found.plastic is None or not found.plate.any():
        return medium
    rim = footplate.scan_from_footplate.points(footplate.outline_mm)
    plastic = found.box.scan_points(np.argwhere(found.plate)[:, ::-1])
    plastic = plastic[np.all(np.abs(plastic - rim.mean(axis=0)) < np.ptp(rim, axis=0).max(), axis=1)]
    if not len(plastic) or np.median(cKDTree(plastic).query(rim)[0]) > FARTHEST_MM:
        return medium
    return max(medium, (found.plastic - found.air) / (found.bone - found.air))


def _standard_deviation(
    gap_mm: float, along: Array, bodies: tuple[BodySurface, BodySurface], medium: float, rim_mm: Array
) -> float:
    """Return the standard deviation of a median gap of those along the rim; ``rim_mm`` (n, 3) in scan mm."""
    bends = np.roll(along, -_APART) - 2.0 * along + np.roll(along, _APART)
    rough = float(np.nanmean(bends**2)) / 6.0 if np.isfinite(bends).any() else gap_mm**2
    noise = rough * (0.5 * np.pi * _APART / np.count_nonzero(np.isfinite(along)) + _CHOSEN_BY_NOISE**2)
    level = sum(body.level_sd_mm for body in bodies)
    misfit = sum(float(np.median(body.misfit_at(rim_mm))) ** 2 for body in bodies)
    resolution = max(body.resolution_mm for body in bodies)
    tails = float(np.exp(-0.5 * (gap_mm / resolution) ** 2))
    blur = ((_TAILS_SD * tails) ** 2 + _EDGES_SD**2 + 2.0 * np.pi * medium**2) * resolution**2
    return float(np.sqrt(level**2 + misfit + noise + blur))


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
    """Return averaged vertices and normals (n, 3) of what of a surface is near the rim, in footplate axes."""
    from scipy.spatial import cKDTree

    margin = 2.0 * NORMAL_SCALE_MM
    high = (points[:, 1] > low - _BELOW_MM - margin) & (points[:, 1] < low + _HEIGHT_MM + margin)
    near = np.zeros(len(points), dtype=bool)
    near[high] = cKDTree(places).query(points[high][:, [0, 2]])[0] < FARTHEST_MM + margin
    inside = np.all(near[surface.faces], axis=1)
    if not inside.any():
        return None
    part, faces = chosen_part(points, surface.faces, inside)
    large = [one for one in pieces(faces) if len(one) > _SPECK * len(faces)]
    kept = np.isin(np.arange(len(faces)), np.concatenate(large))
    diffusion = Diffusion(*refined(*chosen_part(part, faces, kept), EDGE_MM), NORMAL_SCALE_MM)
    return diffusion.without_noise(), unit(diffusion.normals())


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
    return _at_nearest_layer(distance[seen], points[seen, 1], owner[seen], len(places))


def _at_nearest_layer(distance: Array, height: Array, owner: NDArray[np.intp], count: int) -> Array:
    """Return the mean distance (count,) at each place over the layer where the rim is nearest around it."""
    gap = np.full(count, np.nan)
    if not len(distance):
        return gap
    layer = ((height - height.min()) / _LAYER_MM).astype(int)
    shape = (count, int(layer.max()) + 1)
    cell = np.ravel_multi_index((owner, layer), shape)
    number, total = (np.bincount(cell, each, gap.size * shape[1]).reshape(shape) for each in (None, distance))
    turns = range(-_NEIGHBOURS, _NEIGHBOURS + 1)
    around, sums = (np.sum([np.roll(one, k, axis=0) for k in turns], axis=0) for one in (number, total))
    enough = around >= _LEAST_POINTS * around.max(axis=1, keepdims=True)
    mean = np.where(enough, sums / np.maximum(around, 1), np.inf)
    best = np.arange(count), np.argmin(mean, axis=1)
    there = number[best] > 0
    gap[there] = total[best][there] / number[best][there]
    return gap

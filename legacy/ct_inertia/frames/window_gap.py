"""The gap between the rim of the footplate and the wall of the oval window, which the ligament bridges.

The definition. The rim is what of the stapes looks outward along the plane of the medial face, from 0.3 mm
below the lowest point of that face to 0.45 mm above it. The gap at a place of the rim is the shortest
distance to the surface of other bone that looks back, where that is at most 0.25 mm; as a number the median
over equal steps along the outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import WindowWall
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.frames.footplate import FootplateFrame, SurfaceLike
from legacy.ct_inertia.frames.footplate_face import EDGE_MM, NORMAL_SCALE_MM, SEEN_EDGE_MM, blur_displacement
from legacy.ct_inertia.surface.surface_field import Diffusion, Mesh, refine_edges, unit
from legacy.ct_inertia.volume.normal_distribution import normal_cdf
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.background import Later

# Distance of places along the rim, mm: about the scale of the surface's normals, and more than its triangles.
_STEP_MM = 0.06
# Farthest wall that counts as opposite, mm: what surely lies in the box around the stapes.
_FARTHEST_MM = 0.25
# Heights of rim and wall above the lowest point of the outline and below it, mm: the window's depth.
_HEIGHT_MM, _BELOW_MM = 0.45, 0.3
# Cosine of the angle, 60 degrees, within which a surface looks at the wall. It is not that of the cone
# in which the medial face is cut (`footplate_face.FACE_ANGLE_DEG`), which is a definition.
_FACING = 0.5
# Share of the points of the rim at a place, the nearest to the wall, whose mean distance is the gap there:
# the least distance alone would be too small by the noise of the surfaces.
_NEAREST = 0.1
_REST_SD = calibrated("window_gap.rest_sd")
_LEAST_SD_MM = calibrated("window_gap.least_sd_mm")
# Share of the rim with a wall opposite below which the gap is not stated: the median is of the rim measured,
# and of less than half of it, it says nothing about the rest.
_LEAST_SHARE = 0.5
# Standard deviation of the gap, as a share of it, above which it is not stated: zero is within two of them.
_MOST_SD = 0.5
# Points that are compared with others at a time: few, so that all lie at about the same place.
_AT_A_TIME = 64
# Gap in widths of the blur below which blur hides it: between the half levels of two edges that close, grey
# values do not fall below half of the bone's, and the surfaces merge.
_LEAST_SIGMAS = 0.5


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


class _Body(NamedTuple):
    """Points (n, 3) of a surface, its normals there (n, 3), and how far each was moved for the blur (n,)."""

    points: Array
    normals: Array
    lifted_mm: Array


def window_gap(
    footplate: FootplateFrame, surface: SurfaceLike, blur_mm: float, wall: WindowWall | None
) -> WindowGap | None:
    """Measure the gap; None where less than half of the rim has a wall opposite, or its sd is half of it.

    Parameters
    ----------
    footplate : FootplateFrame
    surface : Surface
        Of the stapes, as its frame was found on it; scan coordinates, mm.
    blur_mm : float
        Standard deviation of the blur of the grey values whose half level the surface is; 0: exact.
    wall : WindowWall or None
    """
    if wall is None:
        return None
    to_footplate = footplate.scan_from_footplate.inverse()
    places, outward = _places(footplate.outline_mm)
    low = float(footplate.outline_mm[:, 1].min())
    later = Later(_body, to_footplate.points(wall.points_mm), wall.faces, low, places, wall.blur_mm)
    rim = _body(to_footplate.points(np.asarray(surface.vertices_mm)), surface.faces, low, places, blur_mm)
    other = later.result()
    if rim is None or other is None:
        return None
    along, lifted = _distances(rim, other, (places, outward), _LEAST_SIGMAS * wall.blur_mm)
    there = np.isfinite(along)
    share = float(np.mean(there))
    if share < _LEAST_SHARE:
        return None
    widths = along[there]
    median = float(np.median(widths))
    sd = _deviation(float(np.median(lifted[there])), median, wall)
    if sd > _MOST_SD * median:
        return None
    return WindowGap(
        median_mm=median,
        sd_mm=sd,
        harmonic_mm=float(1.0 / np.mean(1.0 / widths)),
        spread_mm=float(np.std(widths)),
        rim_share=share,
        outline_mm=places,
        along_mm=along,
    )


def _deviation(lifted_mm: float, gap_mm: float, wall: WindowWall) -> float:
    """Return the standard deviation of the gap, mm.

    Parameters
    ----------
    lifted_mm : float
        Shift of both surfaces that corrects the blur.
    gap_mm : float
    wall : WindowWall

    Notes
    -----
    Part of what was moved is not known, for edges as sharp as the blur come back in part. A level of bone
    that errs by a share e of the contrast moves the half level of both surfaces by e sqrt(pi / 2) blur, and
    what is not known of the tail Phi(-gap / blur) of either body moves the other by its share of
    sqrt(2 pi) blur.
    """
    level = np.sqrt(2.0 * np.pi) * wall.blur_mm * wall.level_sd
    over = 0.0 if wall.blur_mm == 0.0 else float(normal_cdf(-gap_mm / wall.blur_mm))
    tail = 2.0 * np.sqrt(2.0 * np.pi) * wall.blur_mm * wall.tail_sd * over
    return float(np.sqrt((_REST_SD * lifted_mm) ** 2 + level**2 + tail**2 + _LEAST_SD_MM**2))


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


def _body(
    points: Array, faces: NDArray[np.integer], low: float, places: Array, blur_mm: float
) -> _Body | None:
    """Return the part of a surface near the rim, corrected for the blur."""
    margin = 2.0 * NORMAL_SCALE_MM
    high = (points[:, 1] > low - _BELOW_MM - margin) & (points[:, 1] < low + _HEIGHT_MM + margin)
    across = points[high][:, [0, 2]]
    to_place = across - places[_nearest_points(across, places, _FARTHEST_MM + margin)]
    near = np.zeros(len(points), dtype=bool)
    near[high] = np.linalg.norm(to_place, axis=1) < _FARTHEST_MM + margin
    part = Mesh(points, np.asarray(faces)).part(near)
    if len(part.faces) == 0:
        return None
    part = refine_edges(part, EDGE_MM if blur_mm == 0.0 else SEEN_EDGE_MM)
    diffusion = Diffusion(part, NORMAL_SCALE_MM)
    normals = unit(diffusion.normals())
    sunk = np.zeros(len(normals)) if blur_mm == 0.0 else blur_displacement(diffusion, blur_mm, normals)
    return _Body(part.points + sunk[:, None] * normals, normals, np.abs(sunk))


def _distances(rim: _Body, wall: _Body, outline: tuple[Array, Array], least_mm: float) -> tuple[Array, Array]:
    """Return the gap at each place (n,), NaN without a wall, and how far the surfaces were moved there."""
    places, outward = outline
    owner = _nearest_points(rim.points[:, [0, 2]], places)
    facing = np.sum(rim.normals[:, [0, 2]] * outward[owner], axis=1) > _FACING
    points, normals, owner = rim.points[facing], rim.normals[facing], owner[facing]
    nearest = _nearest_points(points, wall.points, _FARTHEST_MM + EDGE_MM)
    step, against = wall.points[nearest] - points, wall.normals[nearest]
    across = -np.sum(step * against, axis=1)
    length = np.linalg.norm(step, axis=1)
    beside = np.sqrt(np.maximum(length**2 - across**2, 0.0))
    # Within a triangle of the nearest vertex the wall is plane; farther, an edge of the wall is nearest.
    distance = np.hypot(across, np.maximum(beside - EDGE_MM, 0.0))
    ahead = np.sum(step[:, [0, 2]] * outward[owner], axis=1) > _FACING * length
    opposite = np.sum(against * normals, axis=1) < -_FACING
    seen = np.flatnonzero(ahead & opposite & (across > 0.0) & (distance < _FARTHEST_MM))
    low = seen[_smallest(distance[seen], owner[seen])]
    many = np.bincount(owner[low], minlength=len(places))
    lifted = rim.lifted_mm[facing] + wall.lifted_mm[nearest]
    means = [np.bincount(owner[low], v[low], len(places)) / np.maximum(many, 1) for v in (distance, lifted)]
    return np.where((many > 0) & (means[0] > least_mm), means[0], np.nan), means[1]


def _nearest_points(points: Array, others: Array, reach_mm: float = np.inf) -> NDArray[np.intp]:
    """Return which of the others (m, k) is nearest to each point (n, k); any one where none is within reach.

    Notes
    -----
    They are compared as they lie along the first axis. A tree (scipy.spatial) would compare fewer, but its
    import alone takes ten times as long.
    """
    nearest = np.zeros(len(points), dtype=np.intp)
    if len(points) == 0:
        return nearest
    order = np.argsort(others[:, 0])
    along = others[order, 0]
    for some in np.array_split(np.argsort(points[:, 0]), len(points) // _AT_A_TIME + 1):
        ends = points[some[[0, -1]], 0] + (-reach_mm, reach_mm)
        close = order[slice(*np.searchsorted(along, ends))]
        if len(close):
            square = np.zeros((len(some), len(close)))
            for k in range(points.shape[1]):
                square += np.square(points[some, None, k] - others[close, k])
            nearest[some] = close[np.argmin(square, axis=1)]
    return nearest


def _smallest(distance: Array, owner: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return which distances are the smallest tenth of their owner's.

    The single smallest would be the one that noise brought nearest.
    """
    order = np.lexsort((distance, owner))
    many = np.bincount(owner)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(many) - many, many)
    return order[rank < np.ceil(_NEAREST * many)[owner[order]]]

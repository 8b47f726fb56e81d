"""Necks: planes of least cross-section near an end of a long body, where something has grown onto it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.stapeskit.arrays import Array

# Normals of the planes that are tried: on cones about the axis, 12 degrees apart, with 12 directions each,
# then on finer ones about the best, which reach beyond half of that.
_LEAN_DEG = (0.0, 12.0, 24.0, 36.0)
_TURNS = 12
_FINER_DEG = (0.0, 2.5, 5.0, 8.0)
_FROM_END_MM = calibrated("necks.from_end_mm")
_WIDENS_WITHIN_MM = calibrated("necks.widens_within_mm")
_LEAST_BEYOND_MM3 = calibrated("necks.least_beyond_mm3")
_MOST_BEYOND = calibrated("necks.most_beyond")
_NARROWER = calibrated("necks.narrower")
_GROWN = calibrated("necks.grown")
_HEAD_MM = calibrated("necks.head_mm")
# Ratio of the edges of voxels up to which they count as cubes; spacings rounded in headers differ far less.
_CUBES = 1.05
_APART_MM = calibrated("necks.apart_mm")
# Limits of the computing time: necks kept at each end, and voxels of a body that areas are counted from.
_MOST = 4
MOST_POINTS = 60_000


@dataclass(frozen=True)
class Neck:
    """A plane through a neck.

    Attributes
    ----------
    normal : ndarray, (3,)
        x, y, z, towards the nearer end.
    height_mm : float
        Of the plane along the normal.
    area_mm2 : float
        Of the cross-section.
    share : float
        Its area over the lesser of the widest sections on either side.
    beyond_mm : float
        How far the body reaches beyond it.
    """

    normal: Array
    height_mm: float
    area_mm2: float
    share: float
    beyond_mm: float

    @property
    def narrow(self) -> bool:
        """It is narrower than most necks of a head: something may have grown onto the body."""
        return self.share < _GROWN

    @property
    def longer_than_head(self) -> bool:
        """The body reaches further beyond it than a head does."""
        return self.beyond_mm > _HEAD_MM


def necks(points_mm: Array, spacing_mm: Array, count: int | None = None) -> list[Neck]:
    """Return the necks near both ends of a body, the most marked first.

    Parameters
    ----------
    points_mm : ndarray, (n, 3)
        Centres of its voxels, x, y, z, or of some drawn from them.
    spacing_mm : ndarray, (3,)
    count : int, optional
        How many voxels it has, where the points are some of them.

    Notes
    -----
    For directions within 36 degrees of the longest principal axis the area of the cross-section follows
    from a histogram of the heights of the voxels; a neck is a minimum that is at least 15 % narrower than
    the body is on either side of it.
    """
    count = count or len(points_mm)
    if len(points_mm) > MOST_POINTS:
        points_mm = np.random.default_rng(0).choice(points_mm, MOST_POINTS, replace=False)
    middle = points_mm.mean(axis=0)
    points = points_mm - middle
    voxel = float(np.prod(spacing_mm)) * count / len(points)
    cubes = bool(spacing_mm.max() < _CUBES * spacing_mm.min())
    # Areas are means over three steps: at least two layers of voxels.
    step = float(max(np.mean(spacing_mm), 2.0 / 3.0 * spacing_mm.max()))
    grain = _Grain(voxel, step, voxel * len(points), cubes)
    _, axes = np.linalg.eigh(np.cov(points.T))
    candidates: list[Neck] = []
    for end in (1.0, -1.0):
        axis = end * axes[:, 2]
        height = points @ axis
        near = points[height > height.max() - _FROM_END_MM]
        every = [_find_along(normal, near, grain) for normal in _lean_axis(axis, _LEAN_DEG)]
        best = _apart(sorted((neck for some in every for neck in some), key=lambda neck: neck.share))
        candidates += [_lean_to_least(neck, near, grain) for neck in best]
    candidates = [
        replace(neck, height_mm=neck.height_mm + float(neck.normal @ middle)) for neck in candidates
    ]
    return sorted(candidates, key=lambda neck: neck.share)


def _lean_axis(axis: Array, lean_deg: tuple[float, ...]) -> list[Array]:
    side = np.linalg.svd(axis[None])[2][1]
    other = np.cross(axis, side)
    directions = [axis]
    for lean in np.radians(lean_deg[1:]):
        for turn in 2.0 * np.pi * np.arange(_TURNS) / _TURNS:
            across = np.cos(turn) * side + np.sin(turn) * other
            directions.append(np.cos(lean) * axis + np.sin(lean) * across)
    return directions


@dataclass(frozen=True)
class _Grain:
    """Volume per sample point, mm3; thickness of a section, mm; volume of the body, mm3; voxel edges, mm."""

    voxel_mm3: float
    step_mm: float
    total_mm3: float
    cubes: bool


def _find_along(normal: Array, near: Array, grain: _Grain) -> list[Neck]:
    """Return the narrow places along one direction, from the points (n, 3) near an end."""
    voxel, step = grain.voxel_mm3, grain.step_mm
    height = near @ normal
    low = float(height.min())
    counts = _count((height - low) / step, grain.cubes)
    # Lists: of some tens of numbers, arrays would take most of the time.
    area = (np.convolve(counts, np.full(3, 1.0 / 3.0), mode="same") * voxel / step).tolist()
    beyond = (np.cumsum(counts[::-1])[::-1] * voxel).tolist()
    reach = max(2, round(_WIDENS_WITHIN_MM / step))
    minima = []
    for k in range(reach, len(area) - 3):
        if not _LEAST_BEYOND_MM3 < beyond[k] < _MOST_BEYOND * grain.total_mm3:
            continue
        if area[k] > min(area[k - 1 : k + 2]):
            continue
        wide = min(max(area[k - reach : k]), max(area[k + 1 : k + 1 + reach]))
        if area[k] < _NARROWER * wide:
            at, share = low + (k + 0.5) * step, area[k] / wide
            minima.append(Neck(normal, at, area[k], share, float(height.max()) - at))
    return minima


def _count(place: Array, cubes: bool) -> Array:
    """Return how many points lie in each bin; each is shared by two bins where voxels are no cubes.

    Layers of voxels that are farther apart than a bin beat with it: by a fifth of a section at 0.036 mm along
    one axis and 0.048 mm along others.
    """
    low = place.astype(np.intp)
    if cubes:
        return np.bincount(low).astype(float)
    low = np.floor(place + 0.5).astype(np.intp)
    upper = place + 0.5 - low
    size = int(low.max()) + 1
    shared = np.bincount(low, 1.0 - upper, size + 1)
    shared[1:] += np.bincount(low, upper, size)
    # The first bin of these lies half below the lowest point.
    return np.asarray(np.concatenate([[shared[0] + shared[1]], shared[2:]]))


def _apart(necks: list[Neck]) -> list[Neck]:
    """Keep the most marked of those that cut at about the same height."""
    kept: list[Neck] = []
    for neck in necks:
        if all(abs(neck.height_mm - other.height_mm) > _APART_MM for other in kept):
            kept.append(neck)
    return kept[:_MOST]


def _lean_to_least(neck: Neck, near: Array, grain: _Grain) -> Neck:
    """Lean the plane until its cross-section is least."""
    start = neck.height_mm
    for _ in range(2):
        around = [
            other
            for normal in _lean_axis(neck.normal, _FINER_DEG)
            for other in _find_along(normal, near, grain)
            if abs(other.height_mm - start) < _APART_MM
        ]
        best = min(around, key=lambda other: other.area_mm2, default=neck)
        if best.area_mm2 >= neck.area_mm2:
            break
        neck = best
    return neck

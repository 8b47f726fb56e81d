"""Necks: planes of least cross-section near an end of a long body, where something has grown onto it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ct_inertia.calibrated import calibrated
from stapeskit.arrays import Array

_LEAN_DEG, _TURNS = (12.0, 24.0, 36.0), 12  # cones about the axis and directions on each
_FINER_DEG = (2.5, 5.0, 8.0)  # cones about the best: they reach beyond half of the distance of the wide ones
_FROM_END_MM = 1.6  # a head, its neck and as much of an incus as leaves more than half to the stapes
_LEAST_BEYOND_MM3, _MOST_BEYOND = 0.03, 0.4  # volume beyond: more than a chip, less than the body
_NARROWER, _GROWN = calibrated("necks.narrower"), calibrated("necks.grown")
_HEAD_MM = calibrated("necks.head_mm")
_APART_MM = 0.15  # two minima that are nearer are those of one neck
_MOST = 4  # necks kept at each end
_MOST_POINTS = 60_000  # voxels of a body that areas are counted from


@dataclass(frozen=True)
class Neck:
    """A plane through a neck, in the coordinates of the points that it was found in.

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

    def grown_on(self, at_border: bool) -> bool:
        """Return whether what lies beyond is no head: a narrow neck, and longer or cropped by the scan."""
        return self.share < _GROWN and (at_border or self.beyond_mm > _HEAD_MM)


@dataclass(frozen=True)
class _End:
    """Points (n, 3) near an end of a body; volume per point; thickness of a section; volume of the body."""

    points: Array
    voxel_mm3: float
    step_mm: float
    total_mm3: float


def find_necks(points_mm: Array, spacing_mm: Array) -> list[Neck]:
    """Return the necks near both ends of a body, the most marked first.

    Parameters
    ----------
    points_mm : ndarray, (n, 3)
        Centres of its voxels, x, y, z.
    spacing_mm : ndarray, (3,)

    Notes
    -----
    For directions within 36 degrees of the longest principal axis the area of the cross-section follows from
    a histogram of the heights of the voxels; a neck is a minimum that is at least 15 % narrower than the body
    is on either side of it. The plane leans until its cross-section is least.
    """
    total = len(points_mm) * float(np.prod(spacing_mm))
    if len(points_mm) > _MOST_POINTS:
        points_mm = np.random.default_rng(0).choice(points_mm, _MOST_POINTS, replace=False)
    middle = points_mm.mean(axis=0)
    points = points_mm - middle
    step = float(max(np.mean(spacing_mm), 2.0 / 3.0 * spacing_mm.max()))
    long_axis = np.linalg.eigh(np.cov(points.T))[1][:, 2]
    found: list[Neck] = []
    for axis in (long_axis, -long_axis):
        height = points @ axis
        near = points[height > height.max() - _FROM_END_MM]
        end = _End(near, total / len(points), step, total)
        kept: list[Neck] = []
        for neck in sorted(_minima(end, _cone(axis, _LEAN_DEG)), key=lambda one: one.share):
            if all(abs(neck.height_mm - other.height_mm) > _APART_MM for other in kept):
                kept.append(neck)
        found += [_lean(neck, end) for neck in kept[:_MOST]]
    found = [replace(neck, height_mm=neck.height_mm + float(neck.normal @ middle)) for neck in found]
    return sorted(found, key=lambda neck: neck.share)


def _cone(axis: Array, lean_deg: tuple[float, ...]) -> list[Array]:
    """Return an axis and directions that lean from it by so many degrees."""
    side = np.linalg.svd(axis[None])[2][1]
    other = np.cross(axis, side)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    around = [np.cos(turn) * side + np.sin(turn) * other for turn in turns]
    return [axis, *(np.cos(a) * axis + np.sin(a) * one for a in np.radians(lean_deg) for one in around)]


def _minima(end: _End, normals: list[Array]) -> list[Neck]:
    """Return the narrow places along some directions.

    Each point is shared by two bins: layers of voxels that are farther apart than a bin would beat with it.
    """
    step, minima = end.step_mm, []
    for normal in normals:
        height = end.points @ normal
        low = float(height.min())
        place = (height - low) / step + 0.5
        lower = place.astype(np.intp)
        part = place - lower
        counts = np.bincount(lower, 1.0 - part, int(lower.max()) + 2)
        counts[1:] += np.bincount(lower, part, int(lower.max()) + 1)
        area = np.convolve(counts, np.full(3, 1.0 / 3.0), mode="same") * end.voxel_mm3 / step
        beyond = np.cumsum(counts[::-1])[::-1] * end.voxel_mm3
        reach = max(2, round(_HEAD_MM / step))
        for k in range(reach, len(area) - 3):
            enough = _LEAST_BEYOND_MM3 < beyond[k] < _MOST_BEYOND * end.total_mm3
            if not enough or area[k] > min(area[k - 1], area[k + 1]):
                continue
            wide = min(area[k - reach : k].max(), area[k + 1 : k + 1 + reach].max())
            if area[k] < _NARROWER * wide:
                at = low + k * step
                minima.append(
                    Neck(normal, at, float(area[k]), float(area[k] / wide), float(height.max()) - at)
                )
    return minima


def _lean(neck: Neck, end: _End) -> Neck:
    """Lean the plane until its cross-section is least."""
    start = neck.height_mm
    for _ in range(2):
        around = [
            other
            for other in _minima(end, _cone(neck.normal, _FINER_DEG))
            if abs(other.height_mm - start) < _APART_MM
        ]
        best = min(around, key=lambda other: other.area_mm2, default=neck)
        if best.area_mm2 >= neck.area_mm2:
            break
        neck = best
    return neck

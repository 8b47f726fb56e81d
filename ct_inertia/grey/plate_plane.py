"""The face of a plate near the stapes, held to a plane; a face that is not flat is that of a fluid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.bodies import Grey, Mask
from ct_inertia.calibrated import calibrated
from ct_inertia.find.distance import used_box
from ct_inertia.grey.fields import smooth
from ct_inertia.grey.start import Start
from stapeskit.arrays import Array

_MARGIN_MM = 0.3  # around the box of the stapes in which the face is looked at
_LEAST_POINTS = 300  # crossings of the half level: the plane's height is known to 0.05 of a voxel's noise
_MOST_POINTS = 20_000
_TRIALS = 100  # planes through three points: with half of the points on one face all fail with 1e-6
_WITHIN_VOXELS = 0.7  # of the plane: scatter of crossings by the grid
_FLATNESS = calibrated("plate_plane.least_flatness")
_CONTACT_SIGMAS = 2.0  # widths of the blur around the plate's mask in which its body follows the plane


@dataclass(frozen=True)
class FacePlane:
    """A plane face of the plate on the grid of a scene's part.

    Attributes
    ----------
    normal : ndarray, (3,)
        Along z, y, x; unit in mm; from air into plastic.
    offset_mm : float
        The face is ``normal . r = offset``, r from the middle of voxel 0, 0, 0.
    scatter_mm : float
        Standard deviation of single crossings about it.
    count : int
        Number of crossings.
    flatness : float
        Share of all crossings that lie on it.
    """

    normal: Array
    offset_mm: float
    scatter_mm: float
    count: int
    flatness: float

    @property
    def sd_mm(self) -> float:
        """Standard deviation of the face's height: ten crossings share their noise."""
        return self.scatter_mm * float(np.sqrt(10.0 / self.count))

    def depth(self, shape: tuple[int, ...], spacing: Array, start: tuple[int, ...]) -> Grey:
        """Return the depth below the face, mm, positive in plastic, in a window that begins at ``start``."""
        z, y, x = (
            (np.arange(n) + first) * edge * part
            for n, first, edge, part in zip(shape, start, spacing, self.normal, strict=True)
        )
        return (z[:, None, None] + y[:, None] + x - self.offset_mm).astype(np.float32)


def face_plane(start: Start) -> FacePlane | None:
    """Fit a plane to the face of the plate where only air is near; None where too little of it is seen.

    Notes
    -----
    Linear crossings of the half level between plastic and air. The best of planes through three of them is
    refined on those within 0.7 voxels or three median deviations.
    """
    if "plate" not in start.masks:
        return None
    points = _crossings(start)
    if len(points) < _LEAST_POINTS:
        return None
    generator = np.random.default_rng(0)
    points = points[generator.permutation(len(points))[:_MOST_POINTS]]
    reach = _WITHIN_VOXELS * float(start.spacing.mean())
    few, best, most = points[:2000], (np.array([1.0, 0.0, 0.0]), 0.0), -1
    for _ in range(_TRIALS):
        a, b, c = few[generator.choice(len(few), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            continue
        hits = int(np.count_nonzero(np.abs((few - a) @ normal) < reach * length))
        if hits > most:
            most, best = hits, (normal / length, float(a @ normal) / length)
    normal, offset = best
    away = (points - offset * normal) @ normal
    for turn in range(12):
        spread = 3.0 * 1.4826 * float(np.median(np.abs(away[np.abs(away) < reach])))
        near = np.abs(away) < (reach if turn == 0 else min(max(spread, 0.02 * reach), reach))
        if np.count_nonzero(near) < _LEAST_POINTS // 3:
            return None
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        away = (points - middle) @ normal
        offset = float(middle @ normal)
    near = np.abs(away) < reach
    inside = np.argwhere(start.masks["plate"])[::97] * start.spacing
    if np.median(inside @ normal) < offset:
        normal, offset = -normal, -offset
    return FacePlane(normal, offset, float(away[near].std()), int(near.sum()), float(near.mean()))


def is_flat(plane: FacePlane | None) -> bool:
    """Return whether the face is that of a plate: nearly all of it lies on one plane."""
    return plane is not None and plane.flatness >= _FLATNESS


def beside_stapes(start: Start, window: tuple[slice, ...], sigma_mm: float) -> Mask:
    """Return where the plate's body follows its plane: near the stapes, and near the plate's own mask."""
    wide = np.float32(_CONTACT_SIGMAS * sigma_mm + 2.0 * start.spacing.max())
    close = start.distances["stapes"][window] <= np.float32(start.reach_mm)
    return np.asarray(close & (start.distances["plate"][window] <= wide))


def _crossings(start: Start) -> Array:
    """Return places (n, 3) along z, y, x, mm, at which plastic turns to air towards the stapes.

    The half level between the two, linear between voxels, on the box of the stapes and a margin.
    """
    half = (start.grey - np.float32(start.air)) * np.float32(1.0 / start.contrasts["plate"]) - np.float32(0.5)
    free = start.distances["plate"] < np.float32(3.0 * start.spacing.max())
    for name in start.masks:
        if name != "plate":
            free &= start.distances[name] > np.float32(start.reach_mm)
    used = used_box(start.masks["stapes"]) or (slice(0, 1),) * 3
    middle = [0.5 * (part.start + part.stop) for part in used]
    margin = np.ceil(_MARGIN_MM / start.spacing).astype(int)
    wide = tuple(slice(max(0, part.start - m), part.stop + m) for part, m in zip(used, margin, strict=True))
    first = np.array([part.start for part in wide])
    calm = min(8.0 * start.noise / start.contrasts["plate"], 1.5)
    half, free = smooth(np.ascontiguousarray(half[wide]), np.full(3, max(calm, 0.5))), free[wide]
    places = []
    for axis in range(3):
        values, good = np.moveaxis(half, axis, 0), np.moveaxis(free, axis, 0)
        low, high = values[:-1], values[1:]
        index = np.argwhere((low * high < 0.0) & good[:-1] & good[1:])
        at = tuple(index.T)
        part = low[at] / (low[at] - high[at])
        place = index.astype(float)
        place[:, 0] += part
        place = np.insert(place[:, 1:], axis, place[:, 0], axis=1) + first
        facing = np.where(low[at] > 0.0, 1.0, -1.0) * (middle[axis] - place[:, axis]) > 0.0
        places.append(place[facing])
    return np.concatenate(places) * start.spacing

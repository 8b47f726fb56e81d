"""Fit a plane to the face of the plate near the stapes; a face that is not flat belongs to a fluid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.grey.start import Start
from ct_inertia.voxels.fields import Grey, smooth
from ct_inertia.voxels.masks import Mask, used_box, widened
from stapeskit.arrays import Array

_MARGIN_MM = 0.3  # around the box of the stapes in which the face is looked at
_LEAST_POINTS = 300  # crossings of the half level: the plane's height is known to 0.05 of a voxel's noise
_MOST_POINTS = 20_000
_TRIALS = 100  # planes through three points: with half of the points on one face all fail with 1e-6
_WITHIN_VOXELS = 0.7  # of the plane: scatter of crossings by the grid
_ROUNDS = 12  # of the fit to the points near the plane
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
    wets : bool
        The stapes lies behind it: the far side of a fluid, for a plate faces the stapes.
    """

    normal: Array
    offset_mm: float
    wets: bool = False

    def depth(self, shape: tuple[int, ...], spacing: Array, start: tuple[int, ...]) -> Grey:
        """Return the depth below the face, mm, positive in plastic, in a window that begins at ``start``."""
        z, y, x = (
            (np.arange(n) + first) * edge * part
            for n, first, edge, part in zip(shape, start, spacing, self.normal, strict=True)
        )
        return (z[:, None, None] + y[:, None] + x - self.offset_mm).astype(np.float32)


def flat_face(start: Start) -> FacePlane | None:
    """Fit a plane to the face of the plate where only air is near; None where too little of it is flat.

    Notes
    -----
    Linear crossings of the half level between plastic and air. The best of planes through three of them is
    refined on those within 0.7 voxels or three median deviations.
    """
    points = _crossings(start)
    if len(points) < _LEAST_POINTS:
        return None
    generator = np.random.default_rng(0)
    points = points[generator.permutation(len(points))[:_MOST_POINTS]]
    reach = _WITHIN_VOXELS * float(start.spacing.mean())
    few = points[:2000]
    corners = few[[generator.choice(len(few), 3, replace=False) for _ in range(_TRIALS)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    corners, normals = corners[length[:, 0] > 1e-9], (normals / np.maximum(length, 1e-9))[length[:, 0] > 1e-9]
    if len(normals) == 0:
        return None
    away = np.abs(few @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    best = int(np.argmax(np.count_nonzero(away < reach, axis=0)))
    normal, away, within = normals[best], (points - corners[best, 0]) @ normals[best], reach
    for _ in range(_ROUNDS):
        near = np.abs(away) < within
        if np.count_nonzero(near) < _LEAST_POINTS // 3:
            return None
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        away = (points - middle) @ normal
        spread = 3.0 * 1.4826 * float(np.median(np.abs(away[np.abs(away) < reach])))
        within = float(np.clip(spread, 0.02 * reach, reach))
    if np.mean(np.abs(away) < reach) < _FLATNESS:
        return None
    offset = float(middle @ normal)
    plastic, stapes = (
        float(np.median(np.argwhere(start.masks[name])[::97] * start.spacing @ normal)) - offset
        for name in ("plate", "stapes")
    )
    sign = -1.0 if plastic < 0.0 else 1.0
    return FacePlane(sign * normal, sign * offset, wets=plastic * stapes > 0.0)


def beside_stapes(start: Start, window: tuple[slice, ...], sigma_mm: float) -> Mask:
    """Return where the plate's body follows its plane: near the stapes, and near the plate's own mask."""
    wide = np.float32(_CONTACT_SIGMAS * sigma_mm + 2.0 * start.spacing.max())
    return np.asarray(start.within_reach[window] & (start.distances["plate"][window] <= wide))


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
    wide = widened(used, np.ceil(_MARGIN_MM / start.spacing))
    first = np.array([part.start for part in wide])
    calm = np.clip(8.0 * start.noise / start.contrasts["plate"], 0.5, 1.5)
    half, free = smooth(np.ascontiguousarray(half[wide]), np.full(3, calm)), free[wide]
    places = []
    for axis in range(3):
        values, good = np.moveaxis(half, axis, 0), np.moveaxis(free, axis, 0)
        low, high = values[:-1], values[1:]
        index = np.argwhere((low * high < 0.0) & good[:-1] & good[1:])
        at = tuple(index.T)
        place = index.astype(float)
        place[:, 0] += low[at] / (low[at] - high[at])
        place = np.insert(place[:, 1:], axis, place[:, 0], axis=1) + first
        facing = np.where(low[at] > 0.0, 1.0, -1.0) * (middle[axis] - place[:, axis]) > 0.0
        places.append(place[facing])
    return np.concatenate(places) * start.spacing

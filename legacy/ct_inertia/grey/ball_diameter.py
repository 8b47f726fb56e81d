"""The diameter of a ball in a scan, by the integral of its grey values."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

# Radii in diameters. The surface is at 0.5; inside and outside are read at least 0.15 diameters away from it,
# that is one voxel of the smallest ball and most of its blur.
_INSIDE, _AROUND, _EMPTY = 0.3, 0.65, 0.8
# Grey values around a ball may vary by this share of its contrast; a neighbour's blurred edge varies by more.
_EVEN = calibrated("ball.even_surroundings")
# Standard deviation of the levels inside and outside, from cupping and scatter, as a share of the contrast.
_LEVEL_SD = calibrated("ball.level_sd")
# Diameter in voxels. Below, the inside (0.6 diameters) is narrower than the blur on both its sides.
_LEAST_VOXELS = 6.0


def ball_diameter(volume: Volume, place_mm: Array, diameter_mm: float) -> tuple[float, float]:
    """Measure a ball near a place (3,), scan mm, of about a diameter; return diameter and sd, mm.

    Notes
    -----
    The integral of (g - outside) / (inside - outside) is the volume of the ball whatever the blur. The
    place is corrected by the centroid of the grey values first.

    Raises
    ------
    CtInertiaError
        The ball is cut by the border of the scan, smaller than six voxels, or something else is near it.
    """
    if diameter_mm < _LEAST_VOXELS * float(volume.spacing_mm.max()):
        raise _ball_error(
            f"{diameter_mm / float(volume.spacing_mm.max()):.2g} voxels", "larger than six voxels"
        )
    centre = place_mm
    for _ in range(3):
        grey, away = _crop(volume, centre, _EMPTY * diameter_mm)
        radius = np.linalg.norm(away, axis=-1) / diameter_mm
        outside, inside = grey[(radius > _AROUND) & (radius < _EMPTY)], grey[radius < _INSIDE]
        low, high = float(np.median(outside)), float(np.median(inside))
        near = radius < _AROUND
        share = (grey[near] - low) / (high - low) if high != low else grey[near] * 0.0
        total = float(share.sum())
        if total <= 0.0:
            raise _ball_error(
                f"grey values {high:g} inside and {low:g} around", "apart from what is around it"
            )
        centre = centre + share @ away[near] / total
    spread = float(np.percentile(outside, 97.5) - np.percentile(outside, 2.5))
    noise = 4.0 * float(np.std(inside))
    if spread > max(_EVEN * abs(high - low), 1.5 * noise):
        raise _ball_error("other material within 0.8 diameters of its centre", "alone")
    size_mm = (6.0 * total * volume.voxel_mm3 / np.pi) ** (1.0 / 3.0)
    return float(size_mm), float(size_mm * _LEVEL_SD / 3.0)


def _crop(volume: Volume, centre_mm: Array, reach_mm: float) -> tuple[Array, Array]:
    """Return the grey values of a box around a point, and their places relative to it, mm."""
    middle, steps = volume.index_points(centre_mm), np.ceil(reach_mm / volume.spacing_mm) + 1
    low, high = np.floor(middle - steps).astype(int), np.ceil(middle + steps).astype(int) + 1
    if np.any(low < 0) or np.any(high > volume.size):
        raise _ball_error("cut by the border of the scan", "whole within the scan, with air around it")
    grey = np.asarray(volume.array[low[2] : high[2], low[1] : high[1], low[0] : high[0]], dtype=float)
    z, y, x = np.indices(grey.shape)
    index = np.stack([x, y, z], axis=-1).reshape(-1, 3) + low
    return grey, (volume.scan_points(index) - centre_mm).reshape(*grey.shape, 3)


def _ball_error(got: str, expected: str) -> CtInertiaError:
    return CtInertiaError.of(
        "the ball of {scale_ball}", expected, got, next_step="Check its place (scan mm) and diameter (mm)"
    )

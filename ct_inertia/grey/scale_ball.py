"""The diameter of a ball in a scan, by the integral of its grey values: what checks the voxel size."""

from __future__ import annotations

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

# Radii in diameters. The surface is at 0.5; inside and outside are read at least 0.15 diameters away from it,
# that is one voxel of the smallest ball and most of its blur.
_INSIDE, _AROUND, _EMPTY = 0.3, 0.65, 0.8
_EVEN = calibrated("ball.even_surroundings")
_LEVEL_SD = calibrated("ball.level_sd")
_LEAST_VOXELS = 6.0  # of the diameter; below, the inside is narrower than the blur on both its sides


def ball_diameter(scan: Scan, place_mm: Array, diameter_mm: float) -> tuple[float, float]:
    """Measure a ball near a place (3,), scan mm, of about a diameter; return diameter and sd, mm.

    Notes
    -----
    The integral of (g - outside) / (inside - outside) is the volume of the ball whatever the blur. The place
    is corrected by the centroid of the grey values first.

    Raises
    ------
    StapeskitError
        The ball is cut by the border of the scan, smaller than six voxels, or something else is near it.
    """
    largest = float(scan.spacing_mm.max())
    if diameter_mm < _LEAST_VOXELS * largest:
        raise _error(f"{diameter_mm / largest:.2g} voxels", "larger than six voxels")
    centre, total = np.asarray(place_mm, dtype=float), 0.0
    for _ in range(3):
        grey, away = _crop(scan, centre, _EMPTY * diameter_mm)
        radius = np.linalg.norm(away, axis=1) / diameter_mm
        outside, inside = grey[(radius > _AROUND) & (radius < _EMPTY)], grey[radius < _INSIDE]
        low, high = float(np.median(outside)), float(np.median(inside))
        near = radius < _AROUND
        share = (grey[near] - low) / (high - low) if high != low else np.zeros(np.count_nonzero(near))
        total = float(share.sum())
        if total <= 0.0:
            raise _error(f"grey values {high:g} inside and {low:g} around", "apart from what is around it")
        centre = centre + share @ away[near] / total
    spread = float(np.percentile(outside, 97.5) - np.percentile(outside, 2.5))
    if spread > max(_EVEN * abs(high - low), 6.0 * float(np.std(inside))):
        raise _error("other material within 0.8 diameters of its centre", "alone")
    size_mm = (6.0 * total * scan.voxel_mm3 / np.pi) ** (1.0 / 3.0)
    return float(size_mm), float(size_mm * _LEVEL_SD / 3.0)


def _crop(scan: Scan, centre_mm: Array, reach_mm: float) -> tuple[Array, Array]:
    """Return the grey values (n,) of a box around a point, and their places (n, 3) relative to it, mm."""
    middle, steps = scan.index_points(centre_mm), np.ceil(reach_mm / scan.spacing_mm) + 1
    low, high = np.floor(middle - steps).astype(int), np.ceil(middle + steps).astype(int) + 1
    if np.any(low < 0) or np.any(high > scan.size):
        raise _error("cut by the border of the scan", "whole within the scan, with air around it")
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    grey = scan.read((z, y, x)).astype(float)
    index = np.indices(grey.shape)[::-1].reshape(3, -1).T + low
    return grey.ravel(), scan.scan_points(index) - centre_mm


def _error(got: str, expected: str) -> StapeskitError:
    return StapeskitError.of(
        "the ball of known size", expected, got, next_step="Check its place (scan mm) and diameter (mm)"
    )

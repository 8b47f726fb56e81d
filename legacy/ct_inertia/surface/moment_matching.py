"""Closed iso surfaces whose volume, centre and second moments are given ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.surface.isosurface import crop_field, part_above, place_surface
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface, enclosed_moments
from legacy.stapeskit.arrays import Array

Grey = NDArray[np.float32]

_LEAST_SHARE, _MOST_SHARE = calibrated("isosurface.shares")
# Most steps of Newton's method, which squares its error each time; the best one is kept.
_ROUNDS = 6
# Relative to the volume, to the extent of the body and to its second moments.
_CLOSE = 2e-4
# Only where shares differ by less from the mean level is the surface near.
_RIM = 0.4
# Half the width of the band of shares over which the area of the surface is counted, and how many voxels.
_BAND, _ENOUGH = 0.1, 100_000
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def moment_matched(field: Grey, moments: Moments, scan_from_index: Array) -> tuple[Surface, float]:
    """Return the iso surface with given volume, centre and second moments, and its mean level.

    Parameters
    ----------
    field : ndarray of float32, [z, y, x]
        Share of bone, 0 to 1 and noise.
    moments : Moments
        Those of the body.
    scan_from_index : ndarray, (4, 4)

    Notes
    -----
    At the half level a blurred body encloses too little where it is convex and at thin walls. The level
    is therefore a polynomial of the second degree in position, with ten coefficients for the ten moments:
    of all small displacements of the surface along its normals that restore the moments, the least in the
    mean square has this form. The surface remains an iso surface of one continuous field, so that it is
    closed and does not intersect itself. The moments of phi_j change with coefficient k by minus the
    integral of phi_j phi_k over the surface per gradient (coarea formula), counted over the voxels in a band
    about the level; Newton's method with this matrix, and with the exact moments of the triangles.
    """
    corner, part = crop_field(field, _LEAST_SHARE)
    rim = _Rim.about(part, *_in_index(moments, scan_from_index, corner))
    coefficients = np.zeros(10)
    coefficients[0] = rim.level
    least, surface = np.inf, part_above(rim.lowered(part, coefficients), 0.0)
    points, faces = surface
    for _ in range(_ROUNDS):
        off = rim.wanted - rim.integrals(*enclosed_moments(points, faces))
        fault = float(np.max(np.abs(off)) / rim.wanted[0])
        if fault < least:
            least, surface = fault, (points, faces)
        if fault < _CLOSE or fault > 2.0 * least:
            break
        coefficients = coefficients - rim.inverse @ off
        points, faces = part_above(rim.lowered(part, coefficients), 0.0)
    return place_surface(surface[0] + corner, surface[1], scan_from_index), rim.level


def _in_index(moments: Moments, scan_from_index: Array, corner: Array) -> tuple[float, Array, Array]:
    """Return volume, centroid and second moments in voxels of the part that begins at a corner."""
    axes = scan_from_index[:3, :3]
    back, voxel = np.linalg.inv(axes), float(np.abs(np.linalg.det(axes)))
    centroid = back @ (moments.centroid_mm - scan_from_index[:3, 3]) - corner
    return moments.volume_mm3 / voxel, centroid, back @ moments.second_mm5 @ back.T / voxel


@dataclass(frozen=True)
class _Rim:
    """The voxels near a surface, and the moments that the surface shall have.

    ``places`` (3, n) are their coordinates x, y, z from the centre of the body in units of ``size`` (3,),
    its standard deviations; ``inverse`` (10, 10) turns missing moments into coefficients of the level.
    """

    index: NDArray[np.intp]
    places: Grey
    centre: Array
    size: Array
    level: float
    wanted: Array
    inverse: Array

    @classmethod
    def about(cls, part: Grey, volume: float, centre: Array, second: Array) -> _Rim:
        """Find the mean level by the count of voxels, and the voxels near it."""
        size = np.sqrt(np.diag(second) / volume)
        level = _level_above_which(part, volume)
        index = np.flatnonzero(np.abs(part - np.float32(level)) < _RIM)
        z, y, x = np.unravel_index(index, part.shape)
        places = np.stack([(k - c) / s for k, c, s in zip((x, y, z), centre, size, strict=True)])
        near = np.flatnonzero(np.abs(part.ravel()[index] - np.float32(level)) < _BAND)
        step = max(1, len(near) // _ENOUGH)
        phi = _polynomials(places[:, near[::step]])
        density = phi @ phi.T * (step / (2.0 * _BAND))
        wanted = _integrals(volume, centre, second, centre, size)
        inverse = np.linalg.pinv(density, rcond=1e-5)
        near_places = places.astype(np.float32)
        return cls(index, near_places, centre, size, level, wanted, np.asarray(inverse, dtype=float))

    def lowered(self, part: Grey, coefficients: Array) -> Grey:
        """Return the field minus its level, which is a polynomial near the surface."""
        c = coefficients.astype(np.float32)
        x, y, z = self.places
        level = c[0] + x * (c[1] + c[4] * x + c[7] * y) + y * (c[2] + c[5] * y + c[8] * z)
        level += z * (c[3] + c[6] * z + c[9] * x)
        np.clip(level, np.float32(_LEAST_SHARE), np.float32(_MOST_SHARE), out=level)
        field = part - np.float32(self.level)
        field.ravel()[self.index] = part.ravel()[self.index] - level
        return field

    def integrals(self, volume: float, centroid: Array, second: Array) -> Array:
        """Return the integrals (10,) of the polynomials over a body."""
        return _integrals(volume, centroid, second, self.centre, self.size)


def _polynomials(places: Array) -> Array:
    """Return 1, x, y, z, xx, yy, zz, xy, yz, xz at places (3, n): (10, n)."""
    return np.stack([np.ones(places.shape[1]), *places, *(places[i] * places[j] for i, j in _PAIRS)])


def _integrals(volume: float, centroid: Array, second: Array, centre: Array, size: Array) -> Array:
    away = (centroid - centre) / size
    square = second / np.outer(size, size) + volume * np.outer(away, away)
    return np.array([volume, *(volume * away), *(square[i, j] for i, j in _PAIRS)])


def _level_above_which(part: Grey, count: float) -> float:
    """Return the share above which about so many voxels lie, within the limits of levels."""
    edges = np.linspace(_LEAST_SHARE, _MOST_SHARE, 161)
    inside = part[(part > edges[0]) & (part <= edges[-1])]
    bins = np.histogram(inside, edges)[0]
    above = np.count_nonzero(part > edges[-1]) + np.append(np.cumsum(bins[::-1])[::-1], 0.0)
    return float(np.interp(count, above[::-1], edges[::-1]))

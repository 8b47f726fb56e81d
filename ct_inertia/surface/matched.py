"""Closed iso surfaces whose volume, centre and second moments are given ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Moments
from ct_inertia.surface.contour import padded_part, placed, zero_surface
from ct_inertia.surface.surface import Surface, enclosed_moments
from stapeskit.arrays import Array

_MOST_LEVEL = 0.4  # of the contrast: a surface at another level is none of the body's edge
_ROUNDS = 6  # of Newton's method, which squares its error each time; the best one is kept
_CLOSE = 2e-4  # relative to the volume, to the extent of the body and to its second moments
_BAND, _ENOUGH = 0.1, 100_000  # half width of the band in which the area is counted, and how many voxels
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def moment_matched(field: Grey, moments: Moments, scan_from_index: Array) -> Surface:
    """Return the iso surface near zero with given volume, centre and second moments.

    ``field`` [z, y, x] is the share of the body less one half, positive inside; ``moments`` are those of the
    body; ``scan_from_index`` (4, 4) maps the field's index x, y, z to scan coordinates, mm.

    Raises
    ------
    StapeskitError
        Nothing is positive.

    Notes
    -----
    A surface cut from blurred values encloses too little where it is convex and at thin walls. The level is
    therefore a polynomial of the second degree in position, with ten coefficients for the ten moments: of
    all small displacements of the surface along its normals that restore the moments, the least in the mean
    square has this form. The surface remains an iso surface of one continuous field, closed and without
    intersections. The moment of phi_j changes with coefficient k by minus the integral of phi_j phi_k over
    the surface per gradient (coarea formula), counted over the voxels in a band about the level; Newton's
    method with this matrix, and with the exact moments of the triangles.
    """
    first, part = padded_part(field)
    rim = _Rim.about(part, moments, scan_from_index, first)
    coefficients = np.zeros(10)
    points, faces = zero_surface(part)
    least, best = np.inf, (points, faces)
    for _ in range(_ROUNDS):
        off = rim.wanted - rim.integrals(*enclosed_moments(points, faces))
        fault = float(np.max(np.abs(off)) / rim.wanted[0])
        if fault < least:
            least, best = fault, (points, faces)
        if fault < _CLOSE or fault > 2.0 * least:
            break
        coefficients = coefficients - rim.inverse @ off
        points, faces = zero_surface(rim.lowered(part, coefficients))
    return placed(best[0] + first, best[1], scan_from_index, field.shape)


@dataclass(frozen=True)
class _Rim:
    """The voxels near a surface, and the moments that the surface shall have.

    ``places`` (3, n) are their coordinates x, y, z from the centre of the body in units of ``size`` (3,), its
    standard deviations; ``inverse`` (10, 10) turns missing moments into coefficients of the level.
    """

    index: NDArray[np.intp]
    places: Grey
    centre: Array
    size: Array
    wanted: Array
    inverse: Array

    @classmethod
    def about(cls, part: Grey, moments: Moments, scan_from_index: Array, first: Array) -> _Rim:
        """Return the rim of a padded field that begins at an index x, y, z."""
        axes = scan_from_index[:3, :3]
        back, voxel = np.linalg.inv(axes), float(np.abs(np.linalg.det(axes)))
        volume = moments.volume_mm3 / voxel
        centre = back @ (moments.centroid_mm - scan_from_index[:3, 3]) - first
        second = back @ moments.second_mm5 @ back.T / voxel
        size = np.sqrt(np.diag(second) / volume)
        index = np.flatnonzero(np.abs(part) < np.float32(_MOST_LEVEL))
        z, y, x = np.unravel_index(index, part.shape)
        places = np.stack([(k - c) / s for k, c, s in zip((x, y, z), centre, size, strict=True)])
        near = np.flatnonzero(np.abs(part.ravel()[index]) < np.float32(_BAND))
        step = max(1, len(near) // _ENOUGH)
        phi = _polynomials(places[:, near[::step]])
        density = phi @ phi.T * (step / (2.0 * _BAND))
        inverse = np.asarray(np.linalg.pinv(density, rcond=1e-5), dtype=float)
        wanted = _integrals(volume, centre, second, centre, size)
        return cls(index, places.astype(np.float32), centre, size, wanted, inverse)

    def lowered(self, part: Grey, coefficients: Array) -> Grey:
        """Subtract from the field a level that is a polynomial in space."""
        c = coefficients.astype(np.float32)
        x, y, z = self.places
        level = c[0] + x * (c[1] + c[4] * x + c[7] * y) + y * (c[2] + c[5] * y + c[8] * z)
        level += z * (c[3] + c[6] * z + c[9] * x)
        np.clip(level, -np.float32(_MOST_LEVEL), np.float32(_MOST_LEVEL), out=level)
        field = part.copy()
        field.ravel()[self.index] -= level
        for axis in range(3):  # the padding stays outside
            for end in (0, -1):
                side = np.moveaxis(field, axis, 0)[end]
                np.minimum(side, np.float32(-1e-6), out=side)
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

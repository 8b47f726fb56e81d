"""The thirteen errors that a channel can have, as tangents of its readings, and sets of such parameters.

A channel reads ``f_c b_c . z`` at every line: a factor f_c, a row b_c = [d, p x d] of its position p and beam
d, and the motion z. Everything that can be wrong with it, or is known with an error only, is a parameter: a
mask of channels, one of these tangents, and a standard deviation that is finite where something is known.

Shapes: c channels, p parameters, G groups of lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import cross, point_rows

GAIN, PHASE, DELAY, GAIN_DRIFT, PHASE_DRIFT, BEAM_U, BEAM_V = range(7)
SHIFT = (7, 8, 9)
TURN = (10, 11, 12)
COUNT = 13
"""Tangents: factor 1 + g + i h (gain, phase), delay in s, both growing from -1 at the first line to 1 at the
last (drift), a beam turned towards its two normals (u, v; rad), the point shifted along x, y, z (m), all
beams turned about x, y, z (rad)."""


def normals(directions: Array) -> tuple[Array, Array]:
    """Return two unit vectors (c, 3) each, normal to each beam and to each other."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    u = cross(directions, least)
    u /= np.linalg.norm(u, axis=1)[:, None]
    return u, cross(directions, u)


@dataclass(frozen=True)
class Parameters:
    """Parameters of channels.

    Attributes
    ----------
    mask : ndarray, (p, c)
        1 where a channel depends on a parameter.
    tangent : ndarray, (p,), int
    sd : ndarray, (p,)
        Standard deviation of what is known of it beforehand (about 0); infinite for a free parameter.
    """

    mask: Array
    tangent: NDArray[np.intp]
    sd: Array

    @classmethod
    def of(cls, channels: int, entries: Sequence[tuple[Sequence[int], int, float]] = ()) -> Parameters:
        """Build parameters of (channels, tangent, sd) out of so many channels."""
        mask = np.zeros((len(entries), channels))
        for row, (own, _, _) in enumerate(entries):
            mask[row, list(own)] = 1.0
        tangent = np.array([entry[1] for entry in entries], dtype=np.intp)
        return cls(mask, tangent, np.array([entry[2] for entry in entries], dtype=float))

    def __len__(self) -> int:
        return len(self.tangent)

    def __add__(self, other: Parameters) -> Parameters:
        return Parameters(
            np.vstack([self.mask, other.mask]),
            np.concatenate([self.tangent, other.tangent]),
            np.concatenate([self.sd, other.sd]),
        )

    @property
    def prior(self) -> Array:
        """Inverse variances (p,); 0 for free parameters."""
        return np.asarray(self.sd**-2.0)

    @cached_property
    def by_channel(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Parameters of each channel, (c, k), filled up with 0, and which of them are any, (c, k)."""
        own = self.mask.T != 0.0
        most = int(np.max(own.sum(axis=1), initial=0))
        order = np.argsort(~own, axis=1, kind="stable")[:, :most]
        return order, np.take_along_axis(own, order, axis=1)


@dataclass(frozen=True)
class Geometry:
    """What is assumed of the channels.

    Attributes
    ----------
    positions_m : ndarray, (c, 3)
        Relative to any point near the body.
    directions : ndarray, (c, 3)
    factor : ndarray, (G, c), complex
        What the values are multiplied with; G is 1 where it is the same at all lines.
    slope : ndarray, (G, c), complex, or None
        Derivative of the factor by a gain; None: the factor itself, as where no gain has changed it.
    """

    positions_m: Array
    directions: Array
    factor: ComplexArray
    slope: ComplexArray | None = None

    def rows(self) -> Array:
        """Return the observation rows (c, 6)."""
        return point_rows(self.positions_m, self.directions)

    def moved(self, parameters: Parameters, values: Array, tau: Array, omega: Array) -> Geometry:
        """Return the geometry with parameters (p,) of the given values.

        ``tau`` (G,) runs from -1 to 1 over the lines, ``omega`` (G,) is in rad/s. Factors
        multiply as 1 + x, so that -2 reverses a sign.
        """
        sums = np.zeros((COUNT, len(self.positions_m)))
        np.add.at(sums, parameters.tangent, parameters.mask * np.asarray(values, dtype=float)[:, None])
        used = np.zeros(COUNT, dtype=bool)
        used[parameters.tangent] = True
        positions = self.positions_m + sums[list(SHIFT)].T if used[list(SHIFT)].any() else self.positions_m
        directions = self.directions
        if used[[BEAM_U, BEAM_V, *TURN]].any():
            u, v = normals(directions)
            directions = directions + sums[BEAM_U][:, None] * u + sums[BEAM_V][:, None] * v
            directions = directions + cross(sums[list(TURN)].T, self.directions)
            directions = directions / np.linalg.norm(directions, axis=1)[:, None]
        factor, slope = self.factor, None
        if used[:BEAM_U].any():
            change, slope = 1.0 + sums[GAIN] + 1j * sums[PHASE], factor
            if used[[DELAY, GAIN_DRIFT, PHASE_DRIFT]].any():
                change = change + (sums[GAIN_DRIFT] + 1j * sums[PHASE_DRIFT]) * tau[:, None]
                slope = factor * np.exp(-1j * sums[DELAY] * omega[:, None])
            factor = slope * change
        return Geometry(positions, directions, factor, slope)

    def row_tangents(self, tangent: int) -> Array:
        """Return d rows / d parameter (c, 6) of a tangent of beams or positions."""
        if tangent in (BEAM_U, BEAM_V):
            beams = normals(self.directions)[tangent - BEAM_U]
            return point_rows(self.positions_m, beams)
        axis = np.eye(3)[tangent - (SHIFT[0] if tangent in SHIFT else TURN[0])]
        if tangent in SHIFT:
            zero = np.zeros_like(self.directions)
            return np.hstack([zero, cross(axis[None], self.directions)])
        return point_rows(self.positions_m, cross(axis[None], self.directions))

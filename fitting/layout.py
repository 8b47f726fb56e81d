"""Vibrometer points of one body, each seen by three beams: its motion, noise and errors."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stapeskit.arrays import Array
from stapeskit.frames import cross_matrix
from stapeskit.spatial import point_rows, shifted_point_rows

STAPES_POINTS_MM = (
    *((1.2, 0.15, 0.0), (-1.2, 0.15, 0.0), (0.5, 0.15, 0.5), (0.5, 0.15, -0.5), (-0.5, 0.15, 0.5)),
    *((-0.5, 0.15, -0.5), (0.9, 1.5, 0.1), (-0.8, 1.6, -0.1), (0.1, 3.2, 0.2)),
)
BASE_POINTS_MM = tuple(
    (x, 0.3, z) for x, z in ((2.5, 0), (-2.5, 0), (0, 2), (0, -2), (2, 1.5), (-2, 1.5), (2, -1.5), (-2, -1.5))
)
"""Nine points on a stapes and eight on the bone around it, footplate frame."""


CONE_DEG = 20.0
"""Usual angle between each of three laser heads and the middle of their view."""


def cone_beams(cone_deg: float) -> Array:
    """Return three beams (3, 3), one a row, at an angle from the y axis and evenly spread around it."""
    cone, around = np.radians(cone_deg), np.radians([90.0, 210.0, 330.0])
    across = np.sin(cone) * np.column_stack([np.cos(around), np.sin(around)])
    return np.column_stack([across[:, 0], np.full(3, np.cos(cone)), across[:, 1]])


@dataclass(frozen=True)
class Layout:
    """Points that three laser heads see.

    Attributes
    ----------
    points_mm : ndarray, (n, 3)
        About the footplate centre in footplate axes.
    beams : ndarray, (3, 3)
        Directions towards the heads, one a row, footplate axes.
    """

    points_mm: Array
    beams: Array = field(default_factory=lambda: cone_beams(CONE_DEG))

    @cached_property
    def directions(self) -> Array:
        """Directions of the readings (3 n, 3), point by point."""
        return np.tile(self.beams, (len(self.points_mm), 1))

    @cached_property
    def rows(self) -> Array:
        """Observation rows (3 n, 6), point by point."""
        return point_rows(np.repeat(np.asarray(self.points_mm) * 1e-3, 3, axis=0), self.directions)

    @cached_property
    def inverse(self) -> Array:
        """What takes readings to the six degrees of freedom by least squares, (6, 3 n)."""
        return np.asarray(np.linalg.pinv(self.rows))

    @property
    def determines(self) -> bool:
        """Whether the points determine all six degrees of freedom."""
        norms = np.linalg.norm(self.rows, axis=0)
        return bool(np.all(norms > 0.0) and np.linalg.svd(self.rows / norms, compute_uv=False)[-1] > 1e-6)

    def position_maps(self) -> Array:
        """Return the maps (3 n, 6, 6) of the motion by an error of 1 m of each coordinate of each point."""
        maps = []
        for reading in range(len(self.rows)):
            place, axis = divmod(reading, 3)
            shift = np.zeros((len(self.rows), 3))
            shift[3 * place : 3 * place + 3] = np.eye(3)[axis]
            maps.append(-self.inverse @ shifted_point_rows(self.directions, shift))
        return np.array(maps)

    def laser_maps(self) -> Array:
        """Return the maps (3, 6, 6) of the motion by a relative error of each laser."""
        return np.array([self.inverse[:, beam::3] @ self.rows[beam::3] for beam in range(3)])


def frame_maps() -> Array:
    """Return the maps (6, 6, 6) of the motion by a displacement of its frame, per m and rad."""
    maps = []
    for axis in range(6):
        arm, change = cross_matrix(np.eye(3)[axis % 3]), np.zeros((6, 6))
        if axis < 3:
            change[:3, 3:] = -arm
        else:
            change[:3, :3] = change[3:, 3:] = -arm
        maps.append(change)
    return np.array(maps)

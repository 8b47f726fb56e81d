"""Vibrometer points of one body: what they make of its motion, and how their noise enters it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices, point_rows

# Nine points on a stapes (footplate rim, crura, head) and eight on the bone around it, mm, footplate frame.
STAPES_POINTS_MM = np.array(
    [
        [1.2, 0.15, 0.0],
        [-1.2, 0.15, 0.0],
        [0.5, 0.15, 0.5],
        [0.5, 0.15, -0.5],
        [-0.5, 0.15, 0.5],
        [-0.5, 0.15, -0.5],
        [0.9, 1.5, 0.1],
        [-0.8, 1.6, -0.1],
        [0.1, 3.2, 0.2],
    ]
)
BASE_POINTS_MM = np.array(
    [
        [x, 0.3, z]
        for x, z in ((2.5, 0), (-2.5, 0), (0, 2), (0, -2), (2, 1.5), (-2, 1.5), (2, -1.5), (-2, -1.5))
    ]
)


@dataclass(frozen=True)
class Layout:
    """Vibrometer points of one body, each seen along three axes.

    Attributes
    ----------
    points_mm : ndarray, (points, 3)
        About the footplate centre, in footplate axes.
    """

    points_mm: Array

    def covariance(self, dof: tuple[str, ...], noise_m: ArrayLike) -> Array:
        """Return the covariance (lines, n, n) of the rigid motion for complex noise of variance noise_m^2.

        Parameters
        ----------
        dof : tuple of str
            Degrees of freedom that the rigid fit solves for.
        noise_m : array_like, (lines,)
            Root of E|noise|^2 of a channel, m.
        """
        used = self._rows(dof)
        return np.asarray(noise_m, dtype=float)[:, None, None] ** 2 * np.linalg.inv(used.T @ used)

    def signal(self, dof: tuple[str, ...], q: ComplexArray) -> float:
        """Return the root mean square over channels and lines of what a rigid motion q (lines, n) makes."""
        return float(np.sqrt(np.mean(np.abs(q @ self._rows(dof).T) ** 2)))

    def determines(self, dof: tuple[str, ...]) -> bool:
        """Return whether the points determine these degrees of freedom."""
        rows = self._rows(dof)
        norms = np.linalg.norm(rows, axis=0)
        if len(rows) < len(dof) or np.any(norms == 0.0):
            return False
        return bool(np.linalg.svd(rows / norms, compute_uv=False)[-1] > 1e-6)

    def rows(self) -> Array:
        """Return the observation rows (3 points, 6) of all channels, point by point along x, y and z."""
        arms = np.repeat(self.points_mm * 1e-3, 3, axis=0)
        return point_rows(arms, np.tile(np.eye(3), (len(self.points_mm), 1)))

    def inverse(self, dof: tuple[str, ...]) -> Array:
        """Return what takes readings to the motion in ``dof`` by least squares, (n, 3 points).

        All six degrees of freedom are solved for where the points determine them, as points2dof does.
        """
        solved = DOF_NAMES if self.determines(DOF_NAMES) else dof
        inverse = np.asarray(np.linalg.pinv(self.rows()[:, dof_indices(solved)]), dtype=float)
        return inverse[[solved.index(name) for name in dof]]

    def _rows(self, dof: tuple[str, ...]) -> Array:
        """Return the observation rows (channels, n) of the channels that see any of the motion."""
        rows = self.rows()[:, dof_indices(dof)]
        return rows[np.any(rows != 0.0, axis=1)]

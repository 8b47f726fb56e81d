"""Simulated experiments: the motion that vibrometer points with noise make of a known M, K and D.

For tests, benchmarks and for planning a measurement; nothing here is a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from fitting.model.damping import VISCOUS, DampingLaw
from fitting.model.model import simulate
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion import RigidMotion
from stapeskit.spatial import DOF_NAMES, DOF_UNITS, dof_indices, point_rows

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


def simulated_motion(
    mass: Array,
    stiffness: Array,
    damping: Array,
    dof: tuple[str, ...],
    freq_hz: Array,
    base: ComplexArray,
    noise: float,
    rng: Generator | None,
    law: DampingLaw = VISCOUS,
) -> RigidMotion:
    """Simulate runs of an experiment with white velocity noise on every channel.

    Parameters
    ----------
    mass, stiffness, damping : ndarray, (n, n)
        SI.
    dof : tuple of str
        Degrees of freedom of the matrices and of the motion.
    freq_hz : ndarray, (lines,)
        Hz.
    base : ndarray, (runs, lines, n), complex
        Motion of the base at the footplate centre, m and rad.
    noise : float
        Noise of a channel relative to the root mean square velocity of its body's points.
    rng : Generator or None
        None: the covariance is stated but no noise is added.

    Returns
    -------
    RigidMotion
        Bodies ``stapes`` and ``base``.
    """
    omega = 2.0 * np.pi * freq_hz
    runs, lines, n = base.shape
    q = np.empty((runs, 2, lines, n), dtype=complex)
    covariance = np.empty((runs, 2, lines, n, n), dtype=complex)
    for run in range(runs):
        q[run, 0] = simulate(mass, stiffness, damping, freq_hz, base[run], law=law)
        q[run, 1] = base[run]
        for body, points in enumerate((STAPES_POINTS_MM, BASE_POINTS_MM)):
            layout = Layout(points)
            level = noise * layout.signal(dof, q[run, body] * omega[:, None]) / omega
            covariance[run, body] = layout.covariance(dof, level)
    if rng is not None:
        draws = rng.standard_normal((2, *q.shape)) * np.sqrt(0.5)
        root = np.linalg.cholesky(covariance)
        q = q + np.einsum("rblij,rblj->rbli", root, draws[0] + 1j * draws[1])
    none = np.full((runs, 2, lines), np.nan)
    return RigidMotion(
        tuple(str(run + 1) for run in range(runs)),
        ("stapes", "base"),
        dof,
        freq_hz,
        q,
        covariance,
        none,
        none,
    )


def driven_base(
    freq_hz: Array, dof: tuple[str, ...], driven: str = "y", others: float = 0.05
) -> ComplexArray:
    """Return a base motion of constant velocity along one axis with a little of the others, (1, lines, n).

    Parameters
    ----------
    freq_hz : ndarray, (lines,)
        Hz.
    dof : tuple of str, (n,)
    driven : str
        The one that the shaker moves: 250 nm at 400 Hz.
    others : float
        Motion in the others relative to it; rotations at a radius of 1 mm.
    """
    level = 1e-4 / freq_hz
    motion = np.zeros((1, len(freq_hz), len(dof)), dtype=complex)
    for place, name in enumerate(dof):
        share = others * np.exp(1j * (1.0 + DOF_NAMES.index(name)) * freq_hz / freq_hz.max())
        if DOF_UNITS[name] == "rad":
            share = share * 1e3
        motion[0, :, place] = level * (1.0 if name == driven else share)
    return motion

"""Simulated motion of a stapes and the bone around it, of a known M, K and D. Nothing here is measured."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.fitting.model.model import simulate
from legacy.fitting.model.point_layout import BASE_POINTS_MM, STAPES_POINTS_MM, Layout
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES, DOF_UNITS


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

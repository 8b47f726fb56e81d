"""Closed forms that tests compare with. Nothing here imports the packages under test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SolidMoments:
    """Volume, and second central moments: the integral of r r^T about the centroid, (3, 3).

    Units follow those of the lengths: mm3 and mm5 for mm.
    """

    volume: float
    second: np.ndarray

    @property
    def inertia(self):
        """Inertia tensor about the centroid at density 1, (3, 3)."""
        return np.trace(self.second) * np.eye(3) - self.second


def box_moments(lengths):
    """Moments of a box with edges along x, y, z: V a^2 / 12 along each axis."""
    lengths = np.asarray(lengths, dtype=float)
    volume = float(lengths.prod())
    return SolidMoments(volume, volume / 12.0 * np.diag(lengths**2))


def ellipsoid_moments(semi_axes):
    """Moments of an ellipsoid: V = 4/3 pi a b c, V a^2 / 5 along each axis."""
    semi_axes = np.asarray(semi_axes, dtype=float)
    volume = float(4.0 / 3.0 * np.pi * semi_axes.prod())
    return SolidMoments(volume, volume / 5.0 * np.diag(semi_axes**2))

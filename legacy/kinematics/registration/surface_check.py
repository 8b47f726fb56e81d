"""Measured points against the surface that they must lie on: what the comparison found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice


@dataclass(frozen=True)
class SurfaceCheck:
    """Measured points of one body against the surface that they must lie on.

    Attributes
    ----------
    points : tuple of str, (n,)
    distance_mm : ndarray, (n,)
        Signed distance from the surface, outside positive.
    expected_sd_mm : ndarray, (n,)
        What position, surface and registration let expect.
    chi2, n_dof, p_value : float, int, float
        Of all distances with their joint covariance; with estimated sd (``stated`` False) the p-value is that
        of the shift against the scatter around it.
    shift_mm : ndarray, (3,)
        Translation of the points relative to the surface that explains the distances, in footplate axes, at
        the centroid of the points; without what is open.
    turn_deg : ndarray, (3,)
    shift_sd_mm, turn_sd_deg : ndarray, (3,)
    size_mm : (float, float)
        Length of the shift, and its standard deviation along itself.
    open_motions : tuple of str
        Motions that these distances do not show.
    """

    body: str
    surface: str
    points: tuple[str, ...]
    distance_mm: Array
    expected_sd_mm: Array
    chi2: float
    n_dof: int
    p_value: float
    stated: bool
    shift_mm: Array
    turn_deg: Array
    shift_sd_mm: Array
    turn_sd_deg: Array
    size_mm: tuple[float, float]
    open_motions: tuple[str, ...] = ()
    notices: tuple[Notice, ...] = ()

    @property
    def rms_mm(self) -> float:
        """Root mean square distance from the surface."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))


def shift_words(check: SurfaceCheck) -> str:
    """Write the shift of a check: its size, its sd and its direction in footplate axes."""
    size, sd = (1e3 * value for value in check.size_mm)
    if size == 0.0:
        return "none seen"
    along = ", ".join(f"{value:.2f}" for value in check.shift_mm / check.size_mm[0])
    return f"{size:.0f} ± {sd:.0f} µm along ({along})"

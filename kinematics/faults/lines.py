"""The residuals of every line of a body, for faults that compressed lines do not show.

Shapes: c channels, N lines of all runs, r motions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kinematics.fit.lsq import solve
from kinematics.joint.estimate import State
from kinematics.joint.pack import Readings
from stapeskit.arrays import Array, ComplexArray


@dataclass(frozen=True)
class LineResiduals:
    """What the rigid motion leaves of the readings at every line.

    Attributes
    ----------
    motion : ndarray, (r, N), complex
    scaled : ndarray, (c, N), complex
        Residuals over their noise; NaN where missing.
    size : ndarray, (c, N)
        |Fitted value| over the noise.
    own : ndarray, (c,)
        Share of the noise of a channel that stays in its residual, in the mean.
    """

    motion: ComplexArray
    scaled: ComplexArray
    size: Array
    own: Array


def line_residuals(readings: Readings, state: State) -> LineResiduals:
    """Fit the motion of every line under the geometry of a state."""
    rows = state.rows @ state.packed.visible
    factor = readings.geometry.factor.T
    live = np.isfinite(readings.noise_factor)[:, None]
    value = np.where(live, readings.value / np.where(factor == 0.0, 1.0, factor), np.nan)
    sd = readings.sd * np.where(live, readings.noise_factor[:, None], 1.0)
    found = solve(rows, value, sd)
    fitted = rows @ found.z
    own = found.freedom / (2.0 * np.maximum(found.used, 1))
    return LineResiduals(found.z, (value - fitted) / sd, np.abs(fitted) / sd, own)

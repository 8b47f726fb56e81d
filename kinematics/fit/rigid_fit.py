"""The rigid motion of one body at every line, with covariance, residuals and weights.

Shapes: c channels, m degrees of freedom, L lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import BeamSet
from kinematics.fit.lsq import Solution, solve
from stapeskit.arrays import Array, ComplexArray

Lines = slice | NDArray[np.intp]
_WHOLE = slice(None)


@dataclass(frozen=True)
class LineFit:
    """The fit of one body in one run.

    Attributes
    ----------
    q : ndarray, (L, m), complex
        Displacement amplitudes, m and rad; NaN at lines whose channels do not determine it.
    covariance : ndarray, (L, m, m)
        E[dq dq^H], which is real here; channel noise only. NaN where the noise is unknown.
    chi2 : ndarray, (L,)
        Sum of |residual / sd|^2; NaN where q is.
    n_dof : ndarray, (L,), int
        2 (channels - m).
    value : ndarray, (c, L), complex
        The data, in units of the measured quantity; not a copy.
    sd : ndarray, (c, L)
        Standard deviation of its real part, up to ``factor``; a view where it is alike for all.
    factor : ndarray, (L,)
        What ``sd`` is multiplied with.
    per_displacement : ndarray, (L,), complex
        Measured quantity over displacement.
    """

    beams: BeamSet
    q: ComplexArray
    covariance: Array
    chi2: Array
    n_dof: NDArray[np.int64]
    value: ComplexArray
    sd: Array
    factor: Array
    per_displacement: ComplexArray
    solution: Solution

    @property
    def channel_rms_m(self) -> Array:
        """Root mean square of |residual| over the lines as displacement, (c,), m; NaN without lines."""
        used = self.solution.used
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(used > 0, np.sqrt(self.solution.square / used), np.nan))

    def with_line_noise(self, factor: Array) -> LineFit:
        """Return the fit of least squares for other factors (L,) of the noise: its motion is the same."""
        change = (factor / self.factor) ** 2
        covariance = self.covariance * change[:, None, None]
        return replace(self, covariance=covariance, chi2=self.chi2 / change, factor=factor)

    def residual(self, lines: Lines = _WHOLE) -> ComplexArray:
        """Return measured minus fitted displacement, (c, n), m; NaN where missing."""
        left = self.value[:, lines] - self.beams.basis @ self.solution.z[:, lines]
        return np.asarray(left / self.per_displacement[lines])

    def sd_m(self, lines: Lines = _WHOLE) -> Array:
        """Return the standard deviation of the real part as displacement, (c, n), m."""
        return np.asarray(self.sd[:, lines] * (self.factor / np.abs(self.per_displacement))[lines])


def fit_lines(
    beams: BeamSet,
    value: ComplexArray,
    sd: Array,
    per_displacement: ComplexArray,
    robust: str = "none",
    factor: Array | None = None,
) -> LineFit:
    """Fit the motion of one body at all lines.

    Parameters
    ----------
    value : ndarray, (c, L), complex
        Measured quantity along the beams; NaN where missing.
    sd : ndarray, broadcastable to (c, L)
        Standard deviation of its real part; positive, NaN or infinite where the value is not to be used.
    per_displacement : ndarray, (L,), complex
        Measured quantity over displacement.
    robust : str
        ``none``, ``huber`` or ``t4``.
    factor : ndarray, (L,), optional
        Multiplies ``sd``.
    """
    sd = np.broadcast_to(sd, value.shape)
    factor = np.ones(value.shape[1]) if factor is None else factor
    spread = sd if np.all(factor == 1.0) else sd * factor
    solution = solve(beams.basis, value, spread, robust, np.abs(per_displacement) ** -2.0)
    size = len(beams.dof)
    q = np.ascontiguousarray(((beams.to_dof @ solution.z) / per_displacement).T)
    covariance = beams.to_dof @ solution.covariance @ beams.to_dof.T
    covariance /= (np.abs(per_displacement) ** 2)[:, None, None]
    n_dof = np.where(solution.good, 2 * (solution.count - size), 0)
    return LineFit(beams, q, covariance, solution.chi2, n_dof, value, sd, factor, per_displacement, solution)


def refit(beams: BeamSet, fit: LineFit) -> LineFit:
    """Fit the same data with other degrees of freedom and the same noise, by least squares."""
    return fit_lines(beams, fit.value, fit.sd, fit.per_displacement, factor=fit.factor)

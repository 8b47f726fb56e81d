"""How noise of unknown size runs over frequency, from what a rigid fit leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.rigid_fit import LineFit

Array = NDArray[np.float64]
_LEAST_LINES = 12
_SURE = 20.0
_ROUNDS = 5
_CLIP = 3.0


def noise_course(fit: LineFit, freq_hz: Array) -> Array | None:
    """Return a smooth factor (freq,) of the noise as stated; None when residuals show no course.

    Parameters
    ----------
    fit : LineFit
    freq_hz : ndarray, (freq,)

    Notes
    -----
    The logarithm of the residual level is fitted by a parabola over the logarithm of the frequency: white
    noise of velocities that were written as displacements or accelerations falls or rises by a power of the
    frequency. Levels are means of n squares, whose logarithm has the variance trigamma(n / 2); lines that
    stand out by more than three standard deviations are bounded, so that motion that is not rigid at some
    lines is not taken for noise.
    """
    from scipy.special import digamma, polygamma

    half = fit.n_dof / 2.0
    good = (fit.n_dof > 0) & np.isfinite(fit.chi2) & (np.where(np.isfinite(fit.chi2), fit.chi2, 0.0) > 0.0)
    if np.sum(good) < _LEAST_LINES:
        return None
    factor = np.ones(len(half)) if fit.noise.factor is None else fit.noise.factor
    half, chi2 = half[good], fit.chi2[good]
    levels = np.log(chi2 * factor[good] ** 2 / 2.0) - digamma(half)
    sd = np.sqrt(polygamma(1, half))
    logs = np.log(freq_hz)
    place = 2.0 * (logs - logs[0]) / max(float(logs[-1] - logs[0]), 1e-9) - 1.0
    base = np.polynomial.legendre.legvander(place, 2)
    rows = base[good]
    weight = sd**-2.0
    spread = sd
    curve = np.full(len(levels), float(np.median(levels)))
    for _ in range(_ROUNDS):
        clipped = curve + np.clip(levels - curve, -_CLIP * spread, _CLIP * spread)
        found = np.linalg.solve(rows.T @ (weight[:, None] * rows), rows.T @ (weight * clipped))
        curve = rows @ found
        wide = float(np.median(np.abs(levels - curve) / sd)) / 0.6745
        spread = sd * max(1.0, wide)
    flat = np.full(len(levels), float(np.average(curve, weights=weight)))
    if float(np.sum(((curve - flat) / spread) ** 2)) < _SURE:
        return None
    return np.asarray(np.exp(0.5 * (base @ found - found[0])))

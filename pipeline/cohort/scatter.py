"""The intrinsic scatter about a law, apart from the errors of measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.cohort.pairs import LogPairs

Array = NDArray[np.float64]


def scatter_interval(pairs: LogPairs, exponent: float, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of the intrinsic standard deviation of ln y about a law by its Q-profile.

    Q(s) = sum (r_i - r_w)^2 / (s^2 + w_i) with r = y - b x and w_i the variance of its measurement error
    follows chi2 at the true s (Viechtbauer 2007, doi:10.1002/sim.2514).
    """
    from scipy.special import chdtri

    outside = 0.5 * (1.0 - level)
    low, high = (
        _scatter_at(pairs, exponent, float(chdtri(pairs.degrees, p))) for p in (outside, 1.0 - outside)
    )
    return low, high


def _scatter_at(pairs: LogPairs, exponent: float, target: float) -> float:
    """Return the s at which Q is the target; 0 where Q is below it already."""
    own = pairs.own
    error = own[:, 1, 1] - 2.0 * exponent * own[:, 0, 1] + exponent**2 * own[:, 0, 0]
    residual = pairs.y - exponent * pairs.x
    design = np.concatenate([np.ones((pairs.n, 1)), pairs.covariates], axis=1)
    floor = 1e-12 * max(float(np.var(residual)), 1e-300)

    def q(variance: float) -> float:
        weight = 1.0 / (error + variance + floor)
        coefficients = np.linalg.solve(design.T * weight @ design, design.T * weight @ residual)
        return float(np.sum(weight * (residual - design @ coefficients) ** 2))

    if q(0.0) <= target:
        return 0.0
    from scipy.optimize import brentq

    high = 100.0 * float(np.var(residual)) * pairs.n / target + 1e-12
    return float(np.sqrt(brentq(lambda variance: q(variance) - target, 0.0, high, xtol=1e-14)))

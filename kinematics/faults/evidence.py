"""Weigh fitted faults against each other: how well each explains the data, and how likely its size is."""

from __future__ import annotations

from math import exp, lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_model import FaultFit

Array = NDArray[np.float64]


def log_evidence(fit: FaultFit, level: float, places: int) -> float:
    """Return the logarithm of the Bayes factor of a fault against none.

    Parameters
    ----------
    fit : FaultFit
    level : float
        Noise variance over the stated one.
    places : int
        At how many places this kind of fault could be.

    Notes
    -----
    Laplace's approximation (MacKay 2003, Information theory, inference and learning algorithms, ch. 27-28)
    with a
    multivariate Cauchy prior of the parameters in units of Fault.scale; a factor has half its prior around
    -1. Information that the prior holds is added, so that a fault of which the data say nothing has a factor
    of 1, however many parameters it has.
    """
    gain = fit.drop / level - log(max(places, 1))
    size = fit.fault.size
    if size == 0:
        return gain
    information = np.linalg.pinv(fit.covariance * level, rcond=1e-12, hermitian=True)
    even = information * np.outer(fit.fault.scale, fit.fault.scale)
    values = np.linalg.eigvalsh(even)
    densest = lgamma(0.5 * (1 + size)) - lgamma(0.5) - 0.5 * size * log(pi)
    unseen = 2.0 * pi * exp(2.0 * densest / size)
    width = 0.5 * size * log(2.0 * pi) - 0.5 * float(np.sum(np.log(np.maximum(values, 0.0) + unseen)))
    return gain + _log_prior(fit) + width


def _log_prior(fit: FaultFit) -> float:
    """Return the log density of the parameters in units of their scale."""
    size = fit.fault.size
    p = fit.parameters / fit.fault.scale
    norm = lgamma(0.5 * (1 + size)) - lgamma(0.5) - 0.5 * size * log(pi)
    distance = float(p @ p)
    if fit.fault.kind in ("gain", "phase", "drift"):
        turned = p.copy()
        turned[0] += 2.0 / fit.fault.scale[0]
        distance = min(distance, float(turned @ turned))
        norm -= log(2.0)
    return norm - 0.5 * (1 + size) * log(1.0 + distance)

"""Errors with a stated size, estimated from the data: how they are shown, and whether they agree with it."""

from __future__ import annotations

import numpy as np

from legacy.stapeskit.arrays import Array

# By the head of a parameter's name: what it is, and the unit in which it is shown with the factor from SI.
SHOWN = {
    "laser_gain": ("gain", 100.0, "%"),
    "laser_phase": ("phase", 180.0 / np.pi, "°"),
    "laser_delay": ("delay", 1e6, "us"),
    "gain": ("gain", 100.0, "%"),
    "position": ("position", 1e6, "um"),
}
_TURN = ("turn", 180.0 / np.pi, "°")
# Directions in which the data gain less than this share of the prior variance say nothing.
LEAST_GAINED = 0.05


def shown(name: str) -> tuple[str, float, str]:
    """Return what a parameter is, the factor from SI to its unit, and this unit."""
    return SHOWN.get(name.partition(".")[0], _TURN)


def compare_with_priors(
    values: Array, covariance: Array, prior_sd: Array, estimated: Array
) -> tuple[float, int, float]:
    """Return chi2 of an estimate under its priors, the directions that the data show, and its probability.

    Parameters
    ----------
    values, prior_sd : ndarray, (p,)
    covariance : ndarray, (p, p)
        Of the estimate.
    estimated : ndarray, (p, p)
        Projection to the errors that were estimated; the identity for all.

    Notes
    -----
    If the priors hold, the estimate has the covariance prior - posterior.
    """
    from scipy.special import chdtrc

    gained, vectors = np.linalg.eigh(estimated - covariance / np.outer(prior_sd, prior_sd))
    observed = gained > LEAST_GAINED
    along = vectors.T @ (values / prior_sd)
    chi2, count = float(np.sum(along[observed] ** 2 / gained[observed])), int(np.sum(observed))
    return chi2, count, float(chdtrc(count, chi2)) if count else 1.0

"""Entries of K that the data hardly determine: chi2 is no parabola there, and is followed to its limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting.entries import diagonal
from fitting.likelihood import Likelihood
from fitting.solve import Fit, minimise
from stapeskit.arrays import Array

# Relative sd of a diagonal entry from which chi2 is no parabola: 1 / K differs from normal by it.
_WEAK = 0.25
_FARTHEST = 20.0  # sd or values that a weak entry is followed


def weak_spread(found: Fit) -> Array:
    """Return columns E (p, k): by E E^T the mean square error of weak entries exceeds the covariance.

    Where the deflection drowns in the noise, a stiffness that is much too small lowers chi2 by no more than
    noise does, and its sd falls with it. Chi2 is followed over each such entry of the diagonal of K to where
    it has risen by that of a 95 % interval, with the largest information on the way that is noise of the
    regressor (it grows with the entry); all unknowns move along.
    """
    places = diagonal(found.likelihood.n)
    sd = np.sqrt(np.diag(found.covariance)[places])
    if np.all(sd < _WEAK * np.abs(found.theta[places])) or found.weights is not None:
        return np.zeros((len(found.theta), 0))
    columns = [_reach(found, place, float(own)) for place, own in zip(places, sd, strict=True)]
    kept = [column for column in columns if column is not None]
    return np.stack(kept, axis=1) if kept else np.zeros((len(found.theta), 0))


def _reach(found: Fit, place: int, sd: float) -> Array | None:
    """Return the column of one entry; None where the interval of its sd holds as much."""
    covariance, inverse, model = found.covariance, found.inverse, found.likelihood.model
    value = float(np.sum(found.likelihood.residuals(found.theta) ** 2))
    along = covariance[:, place] / covariance[place, place]
    overstated = covariance[place, place] / inverse[place, place]
    farthest = _FARTHEST * max(sd, abs(found.theta[place]))
    near, low, far, theta = 0.0, 0.0, 1.96 * sd, found.theta
    while True:
        held = replace(model, held=(*model.held, (place, found.theta[place] + far, 1e-2 * sd)))
        likelihood = Likelihood(found.data, held, found.noise)
        try:
            theta, risen, _, _ = minimise(likelihood, theta + (far - near) * along, 1e-5, 25)
            there, known = found.likelihood.covariance(theta)
        except np.linalg.LinAlgError:
            return None
        overstated = max(overstated, there[place, place] / known[place, place])
        target, high = 1.96 * np.sqrt(overstated), float(np.sqrt(max(risen - value, 0.0)))
        if high >= target or far >= farthest:
            break
        near, low, far = far, high, min(2.0 * far, farthest)
    share = (near + (far - near) * (target - low) / (high - low)) / far if high > target else 1.0
    beyond = (share * far / 1.96) ** 2 - sd**2
    return np.sqrt(beyond) * (theta - found.theta) / far if beyond > 0.0 else None

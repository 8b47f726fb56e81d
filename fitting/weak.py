"""How far weak entries may lie from their estimate: where chi2 is no parabola, it is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting import entries
from fitting.likelihood import Likelihood
from fitting.solve import Fit, minimise
from stapeskit.arrays import Array

_WEAK = 0.25  # relative sd of K: the deflection goes with 1 / K, which departs from linear by its square, 6 %
_FARTHEST = 20.0  # sd or values that a weak entry is followed
_CLOSE = 0.8  # of a point inside an interval to one outside, between which its end is taken
_LOSS_FACTOR = 1.0  # to which damping follows a weak stiffness: of soft tissue it is below


def weak_spread(found: Fit) -> Array:
    """Return columns E (p, k): by E E^T the mean square error of weak entries exceeds the covariance.

    Where the deflection drowns in the noise, a stiffness that is much too small lowers chi2 by no more than
    noise does, and its sd falls with it. Chi2 is followed over each such entry of the diagonal of K to where
    it has risen by that of a 95 % interval. All unknowns move along, each no farther than by one of these
    ways, or by its own; entries that are not weak keep their sd.
    """
    n = found.likelihood.n
    places = np.array(entries.diagonals(n))
    sd = np.sqrt(np.diag(found.covariance)[places])
    weak = sd >= _WEAK * np.abs(found.theta[places])
    columns = np.zeros((len(found.theta), n))
    for number in np.flatnonzero(weak[:n]) if found.weights is None else ():
        columns[:, number] = _reach(found, int(places[number]), float(sd[number]))
    size = np.linalg.norm(columns, axis=1)
    most = np.max(np.abs(columns), axis=1)
    own, lossy = places[:n], places[n:]
    most[own] = np.diag(columns[own])
    most[lossy] = np.minimum(most[lossy], _LOSS_FACTOR * (np.abs(found.theta[own]) + most[own]))
    share = most / np.where(size > 0.0, size, 1.0)
    roots = np.sqrt(np.where(weak, share[places], 0.0)).reshape(2, n)
    share[found.at["entries"]] = np.ravel([entries.vector(np.outer(root, root)) for root in roots])
    return share[:, None] * columns[:, np.any(columns, axis=0)]


def _reach(found: Fit, place: int, sd: float) -> Array:
    """Return the column (p,) of one entry; zeros where the interval of its sd holds as much.

    Chi2 has to rise by that of 95 % times what the information is overstated by, noise of the regressor,
    which grows with the entry.
    """
    model, overstated = found.likelihood.model, found.covariance[place, place] / found.inverse[place, place]
    value = float(np.sum(found.likelihood.residuals(found.theta) ** 2))
    farthest = _FARTHEST * max(sd, abs(found.theta[place]))
    way = found.covariance[:, place] / found.covariance[place, place]
    first = far = 1.96 * sd
    inside, outside = 0.0, np.inf
    while inside < farthest and far < _CLOSE * outside:
        held = replace(model, held=(*model.held, (place, found.theta[place] + far, 1e-2 * sd)))
        likelihood = Likelihood(found.data, held, found.noise)
        try:
            theta, risen, _, _ = minimise(likelihood, found.theta + far * way, 1e-4, 40)
            there, known = found.likelihood.covariance(theta)
            more = max(overstated, there[place, place] / known[place, place])
        except np.linalg.LinAlgError:
            risen, more = np.inf, overstated
        if risen - value < 1.96**2 * more:
            inside, way, overstated = far, (theta - found.theta) / far, more
        else:
            outside = far
        far = min(2.0 * far, farthest) if outside == np.inf else float(np.sqrt(max(inside, first) * outside))
    return np.sqrt(max((far / 1.96) ** 2 - sd**2, 0.0)) * way

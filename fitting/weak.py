"""How far weak entries may lie from their estimate: where chi2 is no parabola, it is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting import entries
from fitting.likelihood import Likelihood
from fitting.solve import Fit, minimise
from stapeskit.arrays import Array

_WEAK = 0.25  # relative sd of K: the deflection goes with 1 / K, which departs from linear by its square, 6 %
_FARTHEST = 1e3  # sd or values that a weak entry is followed: noise makes a K 1/100 of the true one
_STRIDE = 4.0  # of one try to the next as long as none was too far: five tries to the farthest
_CLOSE = 0.8  # of a point inside an interval to one outside, between which its end is taken
_LOSS_FACTOR = 1.0  # to which damping follows a weak stiffness: of soft tissue it is below


def weak_spread(found: Fit) -> Array:
    """Return columns E (p, k): by E E^T the mean square error of weak entries exceeds the covariance.

    Where the deflection drowns in the noise, a stiffness that is much too small lowers chi2 by no more than
    noise does, and its sd falls with it. Chi2 is followed over each such entry of the diagonal of K to where
    it has risen by more than noise lets it between two such points. All unknowns move along, each no farther
    than by one of these ways, or by its own; entries that are not weak keep their sd.
    """
    n = found.likelihood.n
    places = np.array(entries.diagonals(n))
    sd = np.sqrt(np.diag(found.covariance)[places])
    weak = sd >= _WEAK * np.abs(found.theta[places])
    columns = np.zeros((len(found.theta), n))
    for number in np.flatnonzero(weak[:n]) if found.weights is None else ():
        columns[:, number] = _reach(found, int(number), int(places[number]), float(sd[number]))
    size = np.linalg.norm(columns, axis=1)
    most = np.max(np.abs(columns), axis=1)
    own, lossy = places[:n], places[n:]
    most[own] = np.diag(columns[own])
    most[lossy] = np.minimum(most[lossy], _LOSS_FACTOR * (np.abs(found.theta[own]) + most[own]))
    share = most / np.where(size > 0.0, size, 1.0)
    roots = np.sqrt(np.where(weak, share[places], 0.0)).reshape(2, n)
    share[found.at["entries"]] = np.ravel([entries.vector(np.outer(root, root)) for root in roots])
    return share[:, None] * columns[:, np.any(columns, axis=0)]


def _reach(found: Fit, number: int, place: int, sd: float) -> Array:
    """Return the column (p,) of one entry; zeros where the interval of its sd holds as much."""
    farthest = _FARTHEST * max(sd, abs(found.theta[place]))
    way = found.covariance[:, place] / found.covariance[place, place]
    first = far = 1.96 * sd
    inside, outside = 0.0, np.inf
    while inside < farthest and far < _CLOSE * outside:
        stiffer = _stiffened(found, number, 1.0 + far / max(found.theta[place], 1e-3 * sd))
        for start in (found.theta + far * way, stiffer):
            theta = _held(found, place, far, sd, start)
            if theta is not None:
                inside, way = far, (theta - found.theta) / far
                break
        else:
            outside = far
        far = (
            min(_STRIDE * far, farthest)
            if outside == np.inf
            else float(np.sqrt(max(inside, first) * outside))
        )
    return np.sqrt(max((far / 1.96) ** 2 - sd**2, 0.0)) * way


def _stiffened(found: Fit, number: int, factor: float) -> Array:
    """Return theta with K and D of one degree of freedom times a factor."""
    root = np.ones(found.likelihood.n)
    root[number] = np.sqrt(factor)
    theta = found.theta.copy()
    theta[found.at["entries"]] *= np.tile(entries.vector(np.outer(root, root)), 2)
    return theta


def _held(found: Fit, place: int, far: float, sd: float, start: Array) -> Array | None:
    """Return theta where one entry lies far from its estimate and all else fits, where noise allows that."""
    own = found.likelihood
    held = replace(own.model, held=(*own.model.held, (place, found.theta[place] + far, 1e-2 * sd)))
    try:
        theta, risen, _, _ = minimise(Likelihood(found.data, held, found.noise), start, 1e-4, 40)
        risen -= float(np.sum(own.residuals(found.theta) ** 2))
        return theta if risen < _rise_by_noise(own, found.theta, theta) else None
    except np.linalg.LinAlgError:
        return None


def _rise_by_noise(likelihood: Likelihood, near: Array, far: Array) -> float:
    """Return by how much chi2 may rise from a minimum to the truth, in 95 % of cases.

    At either point chi2 is 2 n^H P n of the noise n, with projectors P, P' of rank n; the two differ by
    noise alone with the variance V = 8 sum(n - |P P'|^2), and where a signal raises chi2 by S at the wrong
    point, by -S +- sqrt(4 S + V). Of all S this is largest where 4 S + V = 4 * 1.96^2: 1.96^2 + V / 4; with
    more noise at S = 0: 1.96 sqrt(V).
    """
    _, whitening, _, _ = likelihood.look(far)
    cross = whitening @ likelihood.act(far, likelihood.look(near)[2])
    varied = 8.0 * max(likelihood.n * likelihood.data.count - float(np.sum(np.abs(cross) ** 2)), 0.0)
    return float(1.96**2 + 0.25 * varied if varied < 4.0 * 1.96**2 else 1.96 * np.sqrt(varied))

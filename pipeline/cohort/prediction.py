"""The response of an ear that was not measured, from its predictor: a predictive distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.cohort.law import Profile
from pipeline.cohort.likelihood import RestrictedLikelihood, covariance_between_ears
from pipeline.cohort.pairs import LogPairs

Array = NDArray[np.float64]

# Points of the grid over (ln tau, b, ln sigma). Twice as many of each change no limit by more than 1 % of its
# distance from the middle.
_GRID = (15, 25, 15)
# Normal prior of exponents, mean 0: power laws of mechanics have exponents of a few.
_PRIOR_EXPONENT = 5.0
# Points of less than this share of the weight are left out.
_LEAST_WEIGHT = 2e-5
# Ears up to which the law is refitted without each person.
_REFITTED = 60


@dataclass(frozen=True)
class Prediction:
    """Where ln y of a further ear lies.

    Attributes
    ----------
    median : float
    interval : tuple of float
        95 %.
    """

    median: float
    interval: tuple[float, float]


class Predictor:
    """A law's predictive distribution for further ears.

    Bayes' theorem on a deterministic grid of (ln tau, b, ln sigma), the means integrated out: the marginal
    likelihood is the exponential of the restricted one. tau and sigma have flat priors, b a wide normal
    one: a flat one would be improper where tau may be zero. The correlation of ears of one person is kept
    at its estimate.

    Parameters
    ----------
    pairs : LogPairs
    """

    def __init__(self, pairs: LogPairs) -> None:
        self._origin = (float(pairs.x.mean()), float(pairs.y.mean()))
        centred = pairs.centred()
        profile = Profile(centred)
        grid, weight = _grid(centred, profile)
        likelihood = RestrictedLikelihood(centred)
        value = np.concatenate([likelihood(part) for part in np.array_split(grid, 8)])
        log_weight = np.log(weight) - value - 0.5 * (grid[:, 1] / _PRIOR_EXPONENT) ** 2
        weight = np.exp(log_weight - log_weight.max())
        keep = weight > _LEAST_WEIGHT * weight.sum()
        self._points, self._weight = grid[keep], weight[keep] / weight[keep].sum()
        _, self._means, self._covariance = likelihood.means(self._points)
        self._psi = covariance_between_ears(self._points)

    def predict(self, x: float, own_variance: float = 0.0, shared_variance: float = 0.0) -> Prediction:
        """Predict ln y of an ear.

        Parameters
        ----------
        x : float
            Measured ln x of the ear.
        own_variance : float
            Variance of its measurement error.
        shared_variance : float
            Variance of what all ears' ln y have in common (density, voxel scale), where the true y is asked
            for and not what these laboratories would measure.
        """
        psi, extra = self._psi, self._covariance
        gain = (psi[:, 0, 1] + extra[:, 0, 1]) / (psi[:, 0, 0] + own_variance + extra[:, 0, 0])
        mean = self._means[:, 1] + gain * (x - self._origin[0] - self._means[:, 0])
        variance = psi[:, 1, 1] + extra[:, 1, 1] - gain * (psi[:, 0, 1] + extra[:, 0, 1]) + shared_variance
        sd = np.sqrt(np.maximum(variance, 1e-300))
        low, median, high = (self._quantile(mean, sd, p) for p in (0.025, 0.5, 0.975))
        return Prediction(median + self._origin[1], (low + self._origin[1], high + self._origin[1]))

    def tolerance(self) -> tuple[float, float]:
        """Return the 95 % range of ln y of ears of this population, whatever their predictor."""
        sd = np.sqrt(self._psi[:, 1, 1] + self._covariance[:, 1, 1])
        low, high = (self._quantile(self._means[:, 1], sd, p) for p in (0.025, 0.975))
        return low + self._origin[1], high + self._origin[1]

    def _quantile(self, mean: Array, sd: Array, share: float) -> float:
        """Return a quantile of a mixture of normal distributions by bisection."""
        from scipy.special import ndtr

        low, high = float(np.min(mean - 9.0 * sd)), float(np.max(mean + 9.0 * sd))
        while high - low > 1e-7 * (1.0 + abs(low) + abs(high)):
            middle = 0.5 * (low + high)
            below = float(self._weight @ ndtr((middle - mean) / sd)) < share
            low, high = (middle, high) if below else (low, middle)
        return 0.5 * (low + high)


def _grid(pairs: LogPairs, profile: Profile) -> tuple[Array, Array]:
    """Return the points of the grid (g, 3 or 4) and their volumes (g,)."""
    best = profile.best.point
    wide = 2.6 / np.sqrt(pairs.n / 8.0)
    spread = float(np.std(pairs.x, ddof=1))
    error = float(np.sqrt(np.median(pairs.own[:, 0, 0])))
    noise = float(np.sqrt(np.median(pairs.own[:, 1, 1])))
    left = profile.standard_error * spread * np.sqrt(pairs.n)
    high = max(best[0], np.log(0.5 * spread)) + 0.65 * wide
    low = max(min(best[0], np.log(spread)) - 0.5 * wide, np.log(1e-3 * spread))
    if np.exp(best[0]) < 0.5 * spread:
        low = np.log(0.02 * spread)
    tau = np.linspace(low, high, _GRID[0])
    high = max(best[2], np.log(0.5 * left)) + 0.7 * wide
    low = best[2] - 0.6 * wide
    if np.exp(best[2]) < max(1.5 * noise, 0.6 * left):
        low = np.log(0.03 * left)
    sigma = np.linspace(low, high, _GRID[2])
    reach, bend = profile.standard_error * (9.0 if pairs.n < 12 else 6.5), 3.0
    if np.exp(best[0]) < 1.5 * error:
        reach, bend = 3.0 * reach, 4.0
    u = np.linspace(-1.0, 1.0, _GRID[1])
    b = best[1] + reach * np.sinh(bend * u) / np.sinh(bend)
    points = np.stack([axis.ravel() for axis in np.meshgrid(tau, b, sigma, indexing="ij")], axis=1)
    volume = np.broadcast_to(np.cosh(bend * u)[None, :, None], _GRID).ravel()
    # Flat in tau and sigma, on a grid of their logarithms.
    volume = volume * np.exp(points[:, 0] + points[:, 2])
    if len(best) > 3:
        points = np.column_stack([points, np.full(len(points), best[3])])
    return points, volume


def left_out_errors(pairs: LogPairs) -> Array:
    """Return ln y of every ear less its prediction from the ears of all other persons, (n,)."""
    centred = pairs.centred()
    whole = Profile(centred).best.point
    if pairs.n > _REFITTED:
        return _left_out_of_many(centred, whole)
    errors = np.full(pairs.n, np.nan)
    for subject in np.unique(pairs.subject):
        out = pairs.subject == subject
        rest = centred.select(~out)
        if rest.degrees < 2:
            continue
        point = Profile(rest.centred(), whole[: 4 if rest.has_pairs() else 3]).best.point
        mean = RestrictedLikelihood(rest).means(point)[1][0]
        errors[out] = _residual(centred, point, mean)[out]
    return errors


def _left_out_of_many(pairs: LogPairs, point: Array) -> Array:
    """Return the same with tau, b and sigma of all ears, which one of many hardly changes."""
    weight = np.linalg.inv(covariance_between_ears(point[None])[0] + pairs.own)
    weighted = np.einsum("nij,nj->ni", weight, pairs.values)
    errors = np.empty(pairs.n)
    for subject in np.unique(pairs.subject):
        out = pairs.subject == subject
        mean = np.linalg.solve(weight[~out].sum(axis=0), weighted[~out].sum(axis=0))
        errors[out] = _residual(pairs.select(out), point, mean)
    return errors


def _residual(pairs: LogPairs, point: Array, mean: Array) -> Array:
    """Return ln y less its expectation at the measured ln x, (n,)."""
    psi = covariance_between_ears(point[None])[0]
    gain = psi[0, 1] / (psi[0, 0] + pairs.own[:, 0, 0])
    return np.asarray(pairs.y - mean[1] - gain * (pairs.x - mean[0]))

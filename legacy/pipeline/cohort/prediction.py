"""The response of an ear that was not measured, from its predictor: a predictive distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.pipeline.cohort.likelihood import RestrictedLikelihood, covariance_between_ears
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.power_law import Profile
from legacy.stapeskit.arrays import Array

# Points of the grid over (ln tau, b, ln sigma). Twice as many of each change no limit by more than 1 % of its
# distance from the middle.
_GRID = (15, 25, 15)
# Normal prior of exponents, mean 0: power laws of mechanics have exponents of a few.
_PRIOR_EXPONENT = 5.0
# Points of less than this share of the weight are left out.
_LEAST_WEIGHT = 2e-5
# Ears up to which the law is refitted without each person.
_REFITTED = 30


@dataclass(frozen=True)
class Prediction:
    """Where the response y of a further ear lies.

    Attributes
    ----------
    median : float
        Of ln y.
    interval : tuple of float
        95 %, of ln y.
    """

    median: float
    interval: tuple[float, float]

    @property
    def value_si(self) -> float:
        """The median of y."""
        return float(np.exp(self.median))

    @property
    def interval_si(self) -> tuple[float, float]:
        """The 95 % interval of y."""
        return float(np.exp(self.interval[0])), float(np.exp(self.interval[1]))


class Predictor:
    """A law's predictive distribution for further ears.

    Bayes' theorem on a deterministic grid of (ln tau, b, ln sigma), the means integrated out: the marginal
    likelihood is the exponential of the restricted one. tau and sigma have flat priors, b a wide normal
    one: a flat one would be improper where tau may be zero. The correlation of ears of one person is kept
    at its estimate.
    """

    def __init__(self, pairs: LogPairs) -> None:
        self._origin = (float(pairs.x.mean()), float(pairs.y.mean()))
        centred = pairs.centred().without_common_errors()
        profile = Profile(centred)
        grid, weight = _grid(centred, profile)
        likelihood = profile.likelihood
        value = np.concatenate([likelihood(part) for part in np.array_split(grid, 8)])
        log_weight = np.log(weight) - value - 0.5 * (grid[:, 1] / _PRIOR_EXPONENT) ** 2
        weight = np.exp(log_weight - log_weight.max())
        keep = weight > _LEAST_WEIGHT * weight.sum()
        self._points, self._weight = grid[keep], weight[keep] / weight[keep].sum()
        self._likelihood = likelihood
        self._psi = covariance_between_ears(self._points)
        self._mean_ear = likelihood.means(self._points)

    def predict(
        self,
        x: float,
        own_variance: float = 0.0,
        shared_variance: float = 0.0,
        covariates: Array | None = None,
    ) -> Prediction:
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
        covariates : ndarray, (c,), optional
            Of the ear; the mean over the cohort when left out.
        """
        known = self._mean_ear
        _, means, extra = known if covariates is None else self._likelihood.means(self._points, covariates)
        psi = self._psi
        gain = (psi[:, 0, 1] + extra[:, 0, 1]) / (psi[:, 0, 0] + own_variance + extra[:, 0, 0])
        mean = means[:, 1] + gain * (x - self._origin[0] - means[:, 0])
        variance = psi[:, 1, 1] + extra[:, 1, 1] - gain * (psi[:, 0, 1] + extra[:, 0, 1]) + shared_variance
        sd = np.sqrt(np.maximum(variance, 1e-300))
        low, median, high = (self._quantile(mean, sd, p) for p in (0.025, 0.5, 0.975))
        return Prediction(median + self._origin[1], (low + self._origin[1], high + self._origin[1]))

    def tolerance(self, shared_variance: float = 0.0) -> tuple[float, float]:
        """Return the 95 % range of ln y of ears of this population, whatever their predictor.

        ``shared_variance`` is that of `predict`: with it the range is one of true y, without it one of what
        these laboratories would measure.
        """
        _, means, extra = self._mean_ear
        sd = np.sqrt(self._psi[:, 1, 1] + extra[:, 1, 1] + shared_variance)
        low, high = (self._quantile(means[:, 1], sd, p) for p in (0.025, 0.975))
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
    residual_sd = profile.standard_error * spread * np.sqrt(pairs.n)
    high = max(best[0], np.log(0.5 * spread)) + 0.65 * wide
    low = max(min(best[0], np.log(spread)) - 0.5 * wide, np.log(1e-3 * spread))
    if np.exp(best[0]) < 0.5 * spread:
        low = np.log(0.02 * spread)
    tau = np.linspace(low, high, _GRID[0])
    high = max(best[2], np.log(0.5 * residual_sd)) + 0.7 * wide
    low = best[2] - 0.6 * wide
    if np.exp(best[2]) < max(1.5 * noise, 0.6 * residual_sd):
        low = np.log(0.03 * residual_sd)
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


@dataclass(frozen=True)
class LeftOut:
    """Each ear predicted from the ears of all other persons.

    Attributes
    ----------
    errors : ndarray, (n,)
        ln y less its prediction; NaN where the others are too few.
    exponents : ndarray, (n,)
        The exponent without the ear; NaN where there are so many ears that one hardly changes it.
    """

    errors: Array
    exponents: Array

    @property
    def rms(self) -> float:
        """Root mean square of the errors; NaN where there are none."""
        known = self.errors[np.isfinite(self.errors)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def left_out(pairs: LogPairs) -> LeftOut:
    """Predict every ear from the ears of all other persons."""
    centred = pairs.centred().without_common_errors()
    whole = Profile(centred).best.point
    exponents = np.full(pairs.n, np.nan)
    if pairs.n > _REFITTED:
        return LeftOut(_left_out_of_many(centred, whole), exponents)
    errors = np.full(pairs.n, np.nan)
    for subject in np.unique(pairs.subject):
        out = pairs.subject == subject
        rest = centred.select(~out)
        if rest.degrees < 2 or not rest.covariates_are_independent():
            continue
        point = Profile(rest.centred(), whole[: 4 if rest.has_pairs() else 3]).best.point
        likelihood = RestrictedLikelihood(rest)
        rows = centred.covariates[out]
        means = np.concatenate([likelihood.means(point, row)[1] for row in rows])
        errors[out], exponents[out] = _residuals(centred.select(out), point, means), point[1]
    return LeftOut(errors, exponents)


def _left_out_of_many(pairs: LogPairs, point: Array) -> Array:
    """Return the errors with tau, b and sigma of all ears, which one of many hardly changes."""
    weight = np.linalg.inv(covariance_between_ears(point[None])[0] + pairs.own)
    design = np.einsum("nc,ij->nicj", np.column_stack([np.ones(pairs.n), pairs.covariates]), np.eye(2))
    design = design.reshape(pairs.n, 2, -1)
    weighted = np.einsum("nia,nij->naj", design, weight)
    subjects, place = np.unique(pairs.subject, return_inverse=True)
    information = np.zeros((len(subjects), design.shape[2], design.shape[2]))
    score = np.zeros((len(subjects), design.shape[2]))
    np.add.at(information, place, weighted @ design)
    np.add.at(score, place, np.einsum("naj,nj->na", weighted, pairs.values))
    rest = information.sum(axis=0) - information, score.sum(axis=0) - score
    effects = np.linalg.solve(rest[0], rest[1][:, :, None])[:, :, 0][place]
    return _residuals(pairs, point, np.einsum("nia,na->ni", design, effects))


def _residuals(pairs: LogPairs, point: Array, means: Array) -> Array:
    """Return ln y less its expectation at the measured ln x, (k,), with the means (k, 2) of x and y."""
    psi = covariance_between_ears(point[None])[0]
    gain = psi[0, 1] / (psi[0, 0] + pairs.own[:, 0, 0])
    return np.asarray(pairs.y - means[:, 1] - gain * (pairs.x - means[:, 0]))

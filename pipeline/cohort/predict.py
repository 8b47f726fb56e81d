"""The response of an ear that was not measured, from its predictor; and each ear from all others.

Bayes' theorem on a deterministic grid of (ln tau, b, ln sigma), the means integrated out: their marginal
likelihood is the exponential of the restricted one. tau and sigma have flat priors, b a wide normal one,
since a flat one would be improper where tau may be zero. The correlation of ears of one person is kept at
its estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.cohort.law import LogPairs, Profile, covariance_between_ears
from stapeskit.arrays import Array

# Points over (ln tau, b, ln sigma). Twice as many of each change no limit by more than 1 % of its distance
# from the middle.
_GRID = (15, 25, 15)
# Standard deviation of the prior of exponents, mean 0: power laws of mechanics have exponents of a few.
_PRIOR_EXPONENT = 5.0
# Points of less than this share of the weight are left out.
_LEAST_WEIGHT = 2e-5


@dataclass(frozen=True)
class Prediction:
    """Where the response y of a further ear lies: median and 95 % interval of ln y."""

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
    """A law's predictive distribution for further ears."""

    def __init__(self, pairs: LogPairs) -> None:
        self._origin = (float(pairs.x.mean()), float(pairs.y.mean()))
        profile = Profile(pairs.shifted(*self._origin))
        grid, volume = _grid(profile)
        pieces = [profile.likelihood.means(part) for part in np.array_split(grid, 40)]
        value, means, covariance = (np.concatenate(part) for part in zip(*pieces, strict=True))
        log_weight = np.log(volume) - value - 0.5 * (grid[:, 1] / _PRIOR_EXPONENT) ** 2
        weight = np.exp(log_weight - log_weight.max())
        keep = weight > _LEAST_WEIGHT * weight.sum()
        self._weight = weight[keep] / weight[keep].sum()
        self._means, self._covariance = means[keep], covariance[keep]
        self._psi = covariance_between_ears(grid[keep])

    def predict(self, x: float, own_variance: float = 0.0, shared_variance: float = 0.0) -> Prediction:
        """Predict ln y of an ear whose ln x was measured.

        ``own_variance`` is that of the error of ln x that the ears of the law do not have, the shared one
        that of the error of ln y that all ears of the law share: the true y scatters by it.
        """
        psi, means, extra = self._psi, self._means, self._covariance
        gain = (psi[:, 0, 1] + extra[:, 0, 1]) / (psi[:, 0, 0] + extra[:, 0, 0] + own_variance)
        mean = means[:, 1] + gain * (x - self._origin[0] - means[:, 0])
        variance = psi[:, 1, 1] + extra[:, 1, 1] - gain * (psi[:, 0, 1] + extra[:, 0, 1]) + shared_variance
        low, median, high = (self._quantile(mean, variance, p) for p in (0.025, 0.5, 0.975))
        return Prediction(median + self._origin[1], (low + self._origin[1], high + self._origin[1]))

    def _quantile(self, mean: Array, variance: Array, share: float) -> float:
        """Return a quantile of the mixture of normal distributions over the grid."""
        from scipy.optimize import brentq
        from scipy.special import ndtr

        sd = np.sqrt(np.maximum(variance, 1e-300))
        low, high = float(np.min(mean - 9.0 * sd)), float(np.max(mean + 9.0 * sd))
        return float(brentq(lambda y: float(self._weight @ ndtr((y - mean) / sd)) - share, low, high))


def _grid(profile: Profile) -> tuple[Array, Array]:
    """Return points (g, 3 or 4) that cover the likelihood, and their volumes (g,)."""
    best, pairs = profile.best, profile.pairs
    wide = 2.6 / np.sqrt(pairs.n / 8.0)
    spread = float(np.std(pairs.x, ddof=1))
    error, noise = (float(np.sqrt(np.median(pairs.own[:, k, k]))) for k in (0, 1))
    residual_sd = profile.standard_error * spread * np.sqrt(pairs.n)
    high = max(best[0], np.log(0.5 * spread)) + 0.65 * wide
    low = max(min(best[0], np.log(spread)) - 0.5 * wide, np.log(1e-3 * spread))
    tau = np.linspace(np.log(0.02 * spread) if np.exp(best[0]) < 0.5 * spread else low, high, _GRID[0])
    high = max(best[2], np.log(0.5 * residual_sd)) + 0.7 * wide
    small = np.exp(best[2]) < max(1.5 * noise, 0.6 * residual_sd)
    sigma = np.linspace(np.log(0.03 * residual_sd) if small else best[2] - 0.6 * wide, high, _GRID[2])
    unresolved = np.exp(best[0]) < 1.5 * error
    reach = profile.standard_error * (9.0 if pairs.n < 12 else 6.5) * (3.0 if unresolved else 1.0)
    bend = 4.0 if unresolved else 3.0
    u = np.linspace(-1.0, 1.0, _GRID[1])
    b = best[1] + reach * np.sinh(bend * u) / np.sinh(bend)
    points = np.stack([axis.ravel() for axis in np.meshgrid(tau, b, sigma, indexing="ij")], axis=1)
    volume = np.broadcast_to(np.cosh(bend * u)[None, :, None], _GRID).ravel()
    volume = volume * np.exp(points[:, 0] + points[:, 2])  # flat in tau and sigma, a grid of logarithms
    if len(best) > 3:
        points = np.column_stack([points, np.full(len(points), best[3])])
    return points, volume


def left_out(pairs: LogPairs, profile: Profile) -> tuple[Array, Array]:
    """Predict every ear from the ears of all other persons; ``profile`` is that of all about their means.

    Returned are ln y less its prediction (n,), and the two-sided p-value (n,) of such an error where the ear
    is one like the others (externally studentised residual: Cook and Weisberg 1982, section 2.2.1); NaN
    where the others are too few.
    """
    from scipy.special import stdtr

    centred = pairs.shifted(float(pairs.x.mean()), float(pairs.y.mean()))
    errors, p_values = np.full(pairs.n, np.nan), np.full(pairs.n, np.nan)
    for subject in np.unique(pairs.subject):
        out = centred.subject == subject
        rest = centred.select(~out)
        if rest.degrees < 2:
            continue
        near = profile.best if len(np.unique(rest.subject)) < rest.n else profile.best[:3]
        fitted = Profile(rest, near)
        _, means, covariance = fitted.likelihood.means(fitted.best)
        psi = covariance_between_ears(fitted.best[None])[0]
        ear, (mean_x, mean_y) = centred.select(out), means[0]
        gain = psi[0, 1] / (psi[0, 0] + ear.own[:, 0, 0])
        errors[out] = ear.y - mean_y - gain * (ear.x - mean_x)
        across = np.stack([-gain, np.ones_like(gain)], axis=1)
        variance = np.einsum("ni,nij,nj->n", across, psi + covariance[0] + ear.own, across)
        # two ears of one person may scatter alike: the scatter is known by persons, not by ears
        degrees = max(len(np.unique(rest.subject)) - 2, 1)
        p_values[out] = 2.0 * stdtr(degrees, -np.abs(errors[out]) / np.sqrt(variance))
    return errors, p_values

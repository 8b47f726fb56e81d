"""The exponent of a power law between two quantities of an ear, both measured with errors."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from legacy.pipeline.cohort.intrinsic_scatter import scatter_interval
from legacy.pipeline.cohort.likelihood import HIGHEST, LOWEST, RestrictedLikelihood
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.minimise import Minimum, minimise
from legacy.stapeskit.arrays import Array

# A side of an interval that is not closed within so many widenings of 1.7 is called unbounded: the widest is
# some thousand times the standard error of least squares.
_WIDENINGS = 14


@dataclass(frozen=True)
class Law:
    """ln y = a + b ln x + scatter, from the ears of a cohort.

    Attributes
    ----------
    n : int
        Ears.
    exponent : float
        b.
    interval : tuple of float
        95 %; a side that the data do not bound is infinite.
    p_value : float
        Of b = 0, two-sided.
    tau : float
        Standard deviation of the true ln x over ears.
    sigma : float
        Intrinsic standard deviation of ln y about the law: what is no measurement error.
    sigma_interval : tuple of float
        95 % (Q-profile at the fitted exponent).
    rho : float
        Correlation of ears of one person; 0 where no person has two.
    reliability : float
        tau^2 / (tau^2 + s^2) with s^2 the median variance of the errors of ln x: at 1 the predictor is
        exact, near 0 it is not resolved.
    mean : tuple of float
        Estimated means of ln x and ln y.
    """

    n: int
    exponent: float
    interval: tuple[float, float]
    p_value: float
    tau: float
    sigma: float
    sigma_interval: tuple[float, float]
    rho: float
    reliability: float
    mean: tuple[float, float]

    @property
    def unbounded(self) -> bool:
        """Whether the data leave the exponent open on a side: the predictor is not resolved."""
        return not np.all(np.isfinite(self.interval))

    @property
    def intercept(self) -> float:
        """a: ln y at x = 1."""
        return self.mean[1] - self.exponent * self.mean[0]


def fit_law(pairs: LogPairs, level: float = 0.95) -> Law:
    """Estimate the exponent by restricted likelihood, its interval by the profile, its scatter by Q.

    Parameters
    ----------
    level : float
        Of the intervals.

    Raises
    ------
    ValueError
        There are fewer ears than the law has unknowns.

    Notes
    -----
    w(b) = 2 [l(max) - l(b)] is turned into t^2 = k (exp(w / (k + 1)) - 1) with k degrees of freedom: exact
    where nothing is measured with error, the interval of least squares then.
    """
    if pairs.degrees < 1:
        raise ValueError(f"a law of {2 + pairs.covariates.shape[1]} unknowns needs more ears; got {pairs.n}")
    profile = Profile(pairs.centred().without_common_errors())
    best = profile.best
    from scipy.special import stdtrit

    k = pairs.degrees
    limit = (k + 1) * np.log1p(stdtrit(k, 0.5 * (1.0 + level)) ** 2 / k)
    interval = (profile.side(-1.0, limit), profile.side(1.0, limit))
    tau, b, sigma = np.exp(best.point[0]), best.point[1], np.exp(best.point[2])
    _, mean, _ = profile.likelihood.means(best.point)
    error = float(np.median(pairs.own[:, 0, 0]))
    rho = 0.0
    if profile.likelihood.paired:
        from legacy.pipeline.cohort.likelihood import correlation_of_pairs

        rho = float(correlation_of_pairs(best.point[None])[0])
    return Law(
        n=pairs.n,
        exponent=float(b),
        interval=(float(interval[0]), float(interval[1])),
        p_value=profile.p_value(),
        tau=float(tau),
        sigma=float(sigma),
        sigma_interval=scatter_interval(pairs, float(b), level, rho),
        rho=rho,
        reliability=float(tau**2 / (tau**2 + error)) if error > 0.0 else 1.0,
        mean=(float(mean[0, 0] + pairs.x.mean()), float(mean[0, 1] + pairs.y.mean())),
    )


class Profile:
    """The restricted likelihood as a function of the exponent alone.

    Parameters
    ----------
    pairs : LogPairs
        Centred.
    near : ndarray, optional
        The best point of nearly the same ears, to begin at.
    """

    def __init__(self, pairs: LogPairs, near: Array | None = None) -> None:
        self.likelihood = RestrictedLikelihood(pairs)
        self._pairs = pairs
        n, own = pairs.n, pairs.own
        xx, yy, xy = (
            float(a @ b) / (n - 1) for a, b in ((pairs.x, pairs.x), (pairs.y, pairs.y), (pairs.x, pairs.y))
        )
        residual_variance = max(yy - xy**2 / xx, 1e-12)
        self.standard_error = float(np.sqrt(residual_variance / xx / max(n - 2, 1)))
        s_xx, s_xy, s_yy = (float(own[:, i, j].mean()) for i, j in ((0, 0), (0, 1), (1, 1)))
        tau = max(xx - s_xx, 0.2 * xx)
        slope = (xy - s_xy) / tau
        sigma = max(yy - s_yy - slope**2 * tau, 0.1 * residual_variance + 1e-6)
        raw = [0.5 * np.log(xx), xy / xx, 0.5 * np.log(residual_variance)]
        starts = [[0.5 * np.log(tau), slope, 0.5 * np.log(sigma)], raw, [raw[0], slope, raw[2] - 2.0]]
        self._scales = np.array([0.3, self.standard_error, 0.3])
        self._low = np.array([LOWEST, -inf, LOWEST])
        self._high = np.array([HIGHEST, inf, HIGHEST])
        if self.likelihood.paired:
            starts = [[*start, likeness] for start in starts for likeness in (-1.0, 1.0)]
            self._scales = np.r_[self._scales, 0.5]
            self._low, self._high = np.r_[self._low, LOWEST], np.r_[self._high, -LOWEST]
        begin = np.array(starts) if near is None else near
        self.best = minimise(self.likelihood, begin, self._scales, self._low, self._high)

    def at(self, b: float, near: Array | None = None) -> Minimum:
        """Return the least value at a fixed exponent; ``near`` is the point of a neighbouring exponent."""
        rest = [k for k in range(len(self._scales)) if k != 1]

        def function(parameters: Array) -> Array:
            whole = np.empty((len(parameters), len(self._scales)))
            whole[:, rest], whole[:, 1] = parameters, b
            return self.likelihood(whole)

        if near is not None:
            return minimise(function, near, self._scales[rest], self._low[rest], self._high[rest])
        residual = self._pairs.y - b * self._pairs.x
        raw = self.best.point[rest].copy()
        raw[:2] = 0.5 * np.log(np.var(self._pairs.x) + 1e-12), 0.5 * np.log(np.var(residual) + 1e-12)
        starts = np.array([self.best.point[rest], raw])
        return minimise(function, starts, self._scales[rest], self._low[rest], self._high[rest])

    def rise(self, b: float) -> float:
        """Return w(b), twice the drop of the restricted log likelihood."""
        return max(2.0 * (self.at(b).value - self.best.value), 0.0)

    def p_value(self, b: float = 0.0) -> float:
        """Return the two-sided p-value of an exponent, by default of none at all."""
        from scipy.special import stdtr

        k = self._pairs.degrees
        t = np.sqrt(max(k * np.expm1(self.rise(b) / (k + 1)), 0.0))
        return float(2.0 * stdtr(k, -t))

    def side(self, sign: float, limit: float) -> float:
        """Return where w reaches a limit on one side of the estimate; infinite where it does not."""
        inner, width, near = 0.0, 2.0 * self.standard_error + 1e-6, self.best.point[:0]
        centre = float(self.best.point[1])
        for _ in range(_WIDENINGS):
            point = self.at(centre + sign * width)
            near = point.point
            if 2.0 * (point.value - self.best.value) > limit:
                break
            inner, width = width, 1.7 * width
        else:
            return sign * inf
        from scipy.optimize import brentq

        # w is nearly a parabola: its root is nearly straight.
        def excess(distance: float) -> float:
            rise = 2.0 * (self.at(centre + sign * distance, near).value - self.best.value)
            return float(np.sqrt(max(rise, 0.0)) - np.sqrt(limit))

        return centre + sign * float(brentq(excess, inner, width, xtol=1e-5 * width, rtol=1e-8))

"""A power law between two quantities of an ear, both measured with errors, by restricted likelihood.

The logarithms v_i = (x_i, y_i) of ear i follow N(m, Psi + S_i) with Psi = [[tau^2, b tau^2], [b tau^2, b^2
tau^2 + sigma^2]]: x scatters by tau, y about the law by sigma, S_i is the covariance of the measurement.
Ears of one person share a part rho of Psi. Errors that only some ears share are a batch effect G G' in the
covariance of all ears. The means are integrated out (Patterson and
Thompson 1971, doi:10.1093/biomet/58.3.545).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, finite_or_none

# Natural logarithms of scatter are kept within these: e^-9 is far below, e^2.5 far above what ears can show.
_LOWEST, _HIGHEST = -9.0, 2.5
# The largest correlation of two ears of one person: at 1 the second ear would add nothing.
_MOST_ALIKE = 0.97
# Of 1.7, after which an interval has no end: some thousand times the standard error of least squares.
_WIDENINGS = 14


@dataclass(frozen=True)
class LogPairs:
    """Natural logarithms of a predictor x and a response y of n ears."""

    x: Array  # (n,)
    y: Array  # (n,)
    # (n, 2, 2): covariance of the errors of (x, y) of each ear alone, with that of x and y: without it the
    # exponent is pulled towards their ratio
    own: Array
    shared: Array  # (n, 2, s): effect of each of s independent errors of unit variance on (x, y) of every ear
    subject: NDArray[np.int64]  # (n,): which ears belong to one person

    @property
    def n(self) -> int:
        """Number of ears."""
        return len(self.x)

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the scatter about the law."""
        return self.n - 2

    @property
    def shared_variance(self) -> float:
        """Mean variance of ln y by errors that ears share."""
        return float(np.mean(np.sum(self.shared[:, 1] ** 2, axis=1)))

    def select(self, keep: NDArray[np.bool_]) -> LogPairs:
        """Return some of the ears; ``keep`` is (n,)."""
        names = ("x", "y", "own", "shared", "subject")
        return LogPairs(*(getattr(self, name)[keep] for name in names))

    def shifted(self, x: float, y: float) -> LogPairs:
        """Return the same ears with other origins of x and y, which no exponent depends on."""
        return replace(self, x=self.x - x, y=self.y - y)


class RestrictedLikelihood:
    """Minus the restricted log likelihood of the ears, up to a constant, at many parameters at once.

    Parameters are (ln tau, b, ln sigma) and, where persons have two ears, the logit of rho / 0.97.
    """

    def __init__(self, pairs: LogPairs) -> None:
        n = pairs.n
        self._values = np.stack([pairs.x, pairs.y], axis=1).ravel()
        self._design = np.tile(np.eye(2), (n, 1))
        # An error with the same effect on all ears moves the means only.
        common = np.all(np.abs(pairs.shared - pairs.shared[:1]) < 1e-12, axis=(0, 1))
        batch = pairs.shared[:, :, ~common].reshape(2 * n, -1)
        self._errors = batch @ batch.T
        for place, own in enumerate(pairs.own):
            self._errors[2 * place : 2 * place + 2, 2 * place : 2 * place + 2] += own
        self.relatives = (pairs.subject[:, None] == pairs.subject) & ~np.eye(n, dtype=bool)
        self.paired = bool(np.any(self.relatives))

    def means(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Return for rows (g, 3 or 4) the value, the means (g, 2) of x and y, and their covariance."""
        parameters, n = np.atleast_2d(parameters), len(self.relatives)
        psi, rho = covariance_between_ears(parameters), self.correlation(parameters)
        between = np.eye(n) + rho[:, None, None] * self.relatives
        whole = np.einsum("gij,gab->giajb", between, psi).reshape(-1, 2 * n, 2 * n) + self._errors
        root = np.linalg.cholesky(whole)
        right = np.column_stack([self._design, self._values])
        white = np.linalg.solve(root, np.broadcast_to(right, (len(root), *right.shape)))
        columns, values = white[:, :, :-1], white[:, :, -1:]
        information = columns.swapaxes(1, 2) @ columns
        covariance = np.linalg.inv(information)
        means = covariance @ (columns.swapaxes(1, 2) @ values)
        rest = values - columns @ means
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        value = log_det + 0.5 * np.linalg.slogdet(information)[1] + 0.5 * np.sum(rest**2, axis=(1, 2))
        return value, means[:, :, 0], covariance

    def correlation(self, parameters: Array) -> Array:
        """Return rho (g,), what ears of one person have in common; zero where there are none."""
        if not self.paired:
            return np.zeros(len(parameters))
        return _MOST_ALIKE / (1.0 + np.exp(-np.clip(parameters[:, 3], _LOWEST, -_LOWEST)))


def covariance_between_ears(parameters: Array) -> Array:
    """Return Psi (g, 2, 2), the covariance of the true logarithms over ears."""
    tau, sigma = np.exp(2.0 * np.clip(parameters[:, [0, 2]], _LOWEST, _HIGHEST)).T
    b = parameters[:, 1]
    return np.array([[tau, b * tau], [b * tau, b**2 * tau + sigma]]).transpose(2, 0, 1)


class Profile:
    """The restricted likelihood as a function of the exponent alone, of ears about their means.

    It begins at the best point of nearly the same ears, ``near``, where that is known.
    """

    def __init__(self, pairs: LogPairs, near: Array | None = None) -> None:
        self.likelihood, self.pairs = RestrictedLikelihood(pairs), pairs
        (xx, xy), (_, yy) = np.cov(pairs.x, pairs.y)
        residual = max(yy - xy**2 / xx, 1e-12)
        self.standard_error = float(np.sqrt(residual / xx / max(pairs.n - 2, 1)))
        (s_xx, s_xy), (_, s_yy) = pairs.own.mean(axis=0)
        tau = max(xx - s_xx, 0.2 * xx)
        slope = (xy - s_xy) / tau
        sigma = max(yy - s_yy - slope**2 * tau, 0.1 * residual + 1e-6)
        # one start from variances without errors, two from raw ones: the likelihood can have several maxima
        starts = [[0.5 * np.log(tau), slope, 0.5 * np.log(sigma)]]
        starts += [[0.5 * np.log(xx), xy / xx, 0.5 * np.log(residual) - drop] for drop in (0.0, 2.0)]
        self._scales = np.array([0.3, self.standard_error, 0.3])
        if self.likelihood.paired:
            starts = [[*start, likeness] for start in starts for likeness in (-1.0, 1.0)]
            self._scales = np.r_[self._scales, 0.5]
        self.value, self.best = self._minimise(
            [np.array(start) for start in starts] if near is None else [near]
        )
        self._known = {float(self.best[1]): self.best}

    def _minimise(self, starts: list[Array], b: float | None = None) -> tuple[float, Array]:
        """Return least value and its point; at a fixed exponent where one is given."""
        from scipy.optimize import minimize

        free = np.array([k for k in range(len(self._scales)) if b is None or k != 1])
        step = 1e-4 * np.eye(len(free))
        steps = np.concatenate([np.zeros((1, len(free))), step, -step])

        def value_and_slope(scaled: Array, start: Array) -> tuple[float, Array]:
            points = np.tile(start, (len(steps), 1))
            points[:, free] += (scaled + steps) * self._scales[free]
            values = self.likelihood.means(points)[0]
            return values[0], (values[1 : 1 + len(free)] - values[1 + len(free) :]) / 2e-4

        found = []
        for point in (start.copy() for start in starts):
            point[1] = point[1] if b is None else b
            end = minimize(
                value_and_slope, np.zeros(len(free)), (point,), "BFGS", jac=True, options={"gtol": 1e-6}
            )
            point[free] += end.x * self._scales[free]
            found.append((float(end.fun), point))
        return min(found, key=lambda each: each[0])

    def rise(self, b: float) -> float:
        """Return w(b), twice the drop of the restricted log likelihood from its maximum."""
        near = self._known[min(self._known, key=lambda known: abs(known - b))]
        raw = near.copy()
        raw[2] = 0.5 * np.log(np.var(self.pairs.y - b * self.pairs.x) + 1e-12)
        value, self._known[b] = self._minimise([near, raw], b)
        return max(2.0 * (value - self.value), 0.0)

    def p_value(self, b: float = 0.0) -> float:
        """Return the two-sided p-value of an exponent, by default of none at all."""
        from scipy.special import stdtr

        k = self.pairs.degrees
        return float(2.0 * stdtr(k, -np.sqrt(k * np.expm1(self.rise(b) / (k + 1)))))

    def side(self, sign: float, limit: float) -> float:
        """Return where w reaches a limit on one side of the estimate; infinite where it does not."""
        from scipy.optimize import brentq

        centre, inner, width = float(self.best[1]), 0.0, 2.0 * self.standard_error + 1e-6

        def excess(distance: float) -> float:  # w is nearly a parabola: its root is nearly straight
            rise = self.rise(centre + sign * distance) if distance else 0.0
            return float(np.sqrt(rise) - np.sqrt(limit))

        for _ in range(_WIDENINGS):
            if excess(width) > 0.0:
                return centre + sign * float(brentq(excess, inner, width, xtol=1e-5 * width, rtol=1e-8))
            inner, width = width, 1.7 * width
        return sign * inf


@dataclass(frozen=True, kw_only=True)
class PowerLaw:
    """ln y = a + b ln x + scatter, from the ears of a cohort."""

    exponent: float  # b
    interval: tuple[float, float]  # 95 %; a side that the data do not bound is infinite
    p_value: float  # of b = 0, two-sided
    intercept: float  # a: ln y at x = 1
    tau: float  # standard deviation of the true ln x over ears
    sigma: float  # standard deviation of ln y about the law, without measurement errors
    sigma_interval: tuple[float, float]  # 95 %
    rho: float  # correlation of ears of one person; 0 where no person has two
    # tau^2 / (tau^2 + s^2) with s^2 the median variance of the errors of ln x: near 0, x is not resolved
    reliability: float
    pairs: LogPairs = field(repr=False, compare=False)  # the ears that it is fitted to
    response: str = ""
    predictor: str = ""
    family: str = "exploratory"  # or primary: planned
    # (n,): ln of each response less what the ears of all other persons predict, and the p-value of an ear
    # that is like them; NaN where they are too few
    left_out: Array = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    left_out_p: Array = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    q_value: float = float("nan")  # false discovery rate within the family

    @property
    def n(self) -> int:
        """Number of ears."""
        return self.pairs.n

    @property
    def prediction_error(self) -> float:
        """Root mean square of what is left out; NaN where the ears are too few."""
        known = self.left_out[np.isfinite(self.left_out)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def unbounded(self) -> bool:
        """Whether the data leave the exponent open on a side."""
        return not np.all(np.isfinite(self.interval))

    def as_json(self) -> dict[str, Any]:
        """Return the form of cohort.json; open ends of intervals are null."""
        return {
            "response": self.response,
            "predictor": self.predictor,
            "family": self.family,
            "exponent": self.exponent,
            "exponent_interval_95": [finite_or_none(end) for end in self.interval],
            "unbounded": self.unbounded,
            "p_value": self.p_value,
            "q_value": self.q_value,
            "intercept_log": self.intercept,
            "intrinsic_sd_log": self.sigma,
            "intrinsic_sd_log_interval_95": list(self.sigma_interval),
            "predictor_sd_log": self.tau,
            "reliability": self.reliability,
            "correlation_of_pairs": self.rho,
            "prediction_error_log": finite_or_none(self.prediction_error),
            "n": self.n,
        }


def fit_law(pairs: LogPairs, level: float = 0.95) -> tuple[PowerLaw, Profile]:
    """Estimate the exponent by restricted likelihood, its interval by the profile, its scatter by Q.

    The profile that is returned as well is that of the ears, at least five, about their means.

    Notes
    -----
    w(b) = 2 [l(max) - l(b)] is turned into t^2 = k (exp(w / (k + 1)) - 1) with k degrees of freedom: exact
    where nothing is measured with error, the interval of least squares then.
    """
    from scipy.special import stdtrit

    k = pairs.degrees
    origin = np.array([pairs.x.mean(), pairs.y.mean()])
    profile = Profile(pairs.shifted(*origin))
    limit = (k + 1) * np.log1p(stdtrit(k, 0.5 * (1.0 + level)) ** 2 / k)
    tau, b, sigma = float(np.exp(profile.best[0])), float(profile.best[1]), float(np.exp(profile.best[2]))
    mean = profile.likelihood.means(profile.best)[1][0] + origin
    error = float(np.median(pairs.own[:, 0, 0]))
    rho = float(profile.likelihood.correlation(profile.best[None])[0])
    law = PowerLaw(
        exponent=b,
        interval=(profile.side(-1.0, limit), profile.side(1.0, limit)),
        p_value=profile.p_value(),
        intercept=float(mean[1]) - b * float(mean[0]),
        tau=tau,
        sigma=sigma,
        sigma_interval=scatter_interval(pairs, b, level, rho),
        rho=rho,
        reliability=tau**2 / (tau**2 + error) if error > 0.0 else 1.0,
        pairs=pairs,
    )
    return law, profile


def scatter_interval(
    pairs: LogPairs, exponent: float, level: float = 0.95, rho: float = 0.0
) -> tuple[float, float]:
    """Return the interval of the intrinsic standard deviation of ln y about a law by its Q-profile.

    Notes
    -----
    Q(s) = e' V^-1 e with e the residuals of r = y - b x about their weighted means and V = s^2 R + diag(w),
    w_i the variance of the measurement error of r_i and R the correlation of the scatter by ``rho``, follows
    chi2 at the true s (Viechtbauer 2007, doi:10.1002/sim.2514, for R = I).
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri

    residual, ones = pairs.y - exponent * pairs.x, np.ones(pairs.n)
    variance = max(float(np.var(residual)), 1e-300)
    across = np.array([-exponent, 1.0])
    error = across @ pairs.own @ across + 1e-12 * variance
    alike = np.eye(pairs.n) + rho * RestrictedLikelihood(pairs).relatives

    def q(scatter: float) -> float:
        whole = scatter * alike + np.diag(error)
        weights, solved = np.linalg.solve(whole, np.column_stack([ones, residual])).T
        return float(residual @ solved - solved.sum() ** 2 / weights.sum())

    ends = []
    for probability in (0.5 * (1.0 - level), 0.5 * (1.0 + level)):
        target = float(chdtri(pairs.degrees, probability))
        high = 100.0 * variance * pairs.n / target + 1e-12
        at_zero = q(0.0) <= target
        ends.append(0.0 if at_zero else brentq(lambda s, t=target: q(s) - t, 0.0, high, xtol=1e-14) ** 0.5)
    return float(ends[0]), float(ends[1])

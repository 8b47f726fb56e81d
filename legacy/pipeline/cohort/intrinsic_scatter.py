"""The intrinsic scatter about a law, without the errors of measurement."""

from __future__ import annotations

import numpy as np

from legacy.pipeline.cohort.log_pairs import LogPairs


def scatter_interval(
    pairs: LogPairs, exponent: float, level: float = 0.95, rho: float = 0.0
) -> tuple[float, float]:
    """Return the interval of the intrinsic standard deviation of ln y about a law by its Q-profile.

    Parameters
    ----------
    rho : float
        Correlation of the scatter of ears of one person.

    Notes
    -----
    Q(s) = e' V^-1 e with e the residuals of r = y - b x about their weighted means and
    V = s^2 R + diag(w), w_i the variance of the measurement error of r_i and R the correlation of the
    scatter, follows chi2 at the true s (Viechtbauer 2007, doi:10.1002/sim.2514, for R = I).
    """
    from scipy.special import chdtri

    profile = _ScatterProfile(pairs, exponent, rho)
    outside = 0.5 * (1.0 - level)
    low, high = (profile.solve(float(chdtri(pairs.degrees, p))) for p in (outside, 1.0 - outside))
    return low, high


class _ScatterProfile:
    """Q as a function of the variance of the scatter."""

    def __init__(self, pairs: LogPairs, exponent: float, rho: float) -> None:
        own = pairs.own
        self._n = pairs.n
        self._residual = pairs.y - exponent * pairs.x
        self._variance = float(np.var(self._residual))
        error = own[:, 1, 1] - 2.0 * exponent * own[:, 0, 1] + exponent**2 * own[:, 0, 0]
        self._error = error + 1e-12 * max(self._variance, 1e-300)
        self._design = np.column_stack([np.ones(pairs.n), pairs.covariates])
        _, place, count = np.unique(pairs.subject, return_inverse=True, return_counts=True)
        self._groups = []
        for m in np.unique(count):
            ears = np.array([np.flatnonzero(place == subject) for subject in np.flatnonzero(count == m)])
            alike = np.eye(m) + rho * (1.0 - np.eye(m))
            self._groups.append((ears, alike))

    def at(self, variance: float) -> float:
        """Return Q at a variance of the scatter."""
        p = self._design.shape[1]
        information, score, square = np.zeros((p, p)), np.zeros(p), 0.0
        for ears, alike in self._groups:
            block = variance * alike + self._error[ears][:, :, None] * np.eye(len(alike))
            design, residual = self._design[ears], self._residual[ears]
            solved = np.linalg.solve(block, np.concatenate([design, residual[:, :, None]], axis=2))
            information += np.einsum("kmi,kmj->ij", design, solved[:, :, :-1])
            score += np.einsum("kmi,km->i", design, solved[:, :, -1])
            square += float(np.sum(residual * solved[:, :, -1]))
        return square - float(score @ np.linalg.solve(information, score))

    def solve(self, target: float) -> float:
        """Return the standard deviation at which Q is the target; 0 where Q is below it already."""
        from scipy.optimize import brentq

        if self.at(0.0) <= target:
            return 0.0
        high = 100.0 * self._variance * self._n / target + 1e-12
        return float(np.sqrt(brentq(lambda variance: self.at(variance) - target, 0.0, high, xtol=1e-14)))

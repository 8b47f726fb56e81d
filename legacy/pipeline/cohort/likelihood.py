"""The restricted likelihood of a power law with errors in both variables, at many parameters at once.

The logarithms v_i = (x_i, y_i) of ear i follow N(m, Psi + S_i) with
Psi = [[tau^2, b tau^2], [b tau^2, b^2 tau^2 + sigma^2]]: x scatters by tau, y about the law by sigma, and
S_i is the covariance of the measurement. Ears of one person share a part rho of Psi. Errors shared by ears
are random effects of unit variance. The means (and covariates) are integrated out (restricted likelihood,
Patterson and Thompson 1971, doi:10.1093/biomet/58.3.545); with Z the columns of means and shared errors,
ln|V| + ln|X' V^-1 X| = ln|B| + ln|Z' B^-1 Z + diag(0, I)| where B is block diagonal (Harville 1977,
doi:10.1080/01621459.1977.10480998).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.stapeskit.arrays import Array

# Natural logarithms of scatter are kept within these: e^-9 is far below, e^2 far above what ears can show.
LOWEST, HIGHEST = -9.0, 2.5
# The largest correlation of two ears of one person: at 1 the second ear would add nothing.
MOST_ALIKE = 0.97
# Blocks of a batch of parameters that are inverted at once: about 100 MB.
_BATCH_BLOCKS = 200_000


@dataclass(frozen=True)
class _Group:
    """Subjects with the same number m of ears.

    Attributes
    ----------
    ears : int
        m.
    own : ndarray, (k, 2m, 2m)
    products : ndarray, (k 2m 2m, p p + p + 1)
        What the entries of the inverse blocks are multiplied with: products of two columns, of a column and
        the values, and of two values.
    """

    ears: int
    own: Array
    products: Array


class RestrictedLikelihood:
    """Minus the restricted log likelihood of the ears, up to a constant."""

    def __init__(self, pairs: LogPairs) -> None:
        self.pairs = pairs
        n, s = pairs.n, pairs.shared.shape[2]
        means = np.concatenate([np.ones((n, 1)), pairs.covariates], axis=1)
        fixed = np.einsum("nc,ij->nicj", means, np.eye(2)).reshape(n, 2, -1)
        columns = np.concatenate([fixed, pairs.shared], axis=2)
        self._fixed = fixed.shape[2]
        self._ridge = np.diag(np.r_[np.zeros(self._fixed), np.ones(s)])
        self._groups = list(_group(pairs, columns))
        self._paired = pairs.has_pairs()

    @property
    def paired(self) -> bool:
        """Whether ears of one person have a correlation to be estimated."""
        return self._paired

    def __call__(self, parameters: Array) -> Array:
        """Return the value at each row of parameters.

        Parameters
        ----------
        parameters : ndarray, (g, 3) or (g, 4)
            ln tau, b, ln sigma and, with ears of one person, the logit of rho / 0.97.

        Returns
        -------
        ndarray, (g,)
        """
        parameters = np.atleast_2d(np.asarray(parameters, dtype=float))
        size = max(1, _BATCH_BLOCKS // self.pairs.n)
        pieces = [self._piece(parameters[k : k + size])[0] for k in range(0, len(parameters), size)]
        return np.concatenate(pieces)

    def means(self, parameters: Array, covariates: Array | None = None) -> tuple[Array, Array, Array]:
        """Return the value, the estimated means of (x, y) and their covariance at each row of parameters.

        Parameters
        ----------
        parameters : ndarray, (g, 3) or (g, 4)
        covariates : ndarray, (c,), optional
            Where the means are asked for; zero, the mean over the ears, when left out.

        Returns
        -------
        value : ndarray, (g,)
        mean : ndarray, (g, 2)
        covariance : ndarray, (g, 2, 2)
        """
        parameters = np.atleast_2d(parameters)
        size = max(1, _BATCH_BLOCKS // self.pairs.n)
        pieces = [self._piece(parameters[k : k + size]) for k in range(0, len(parameters), size)]
        value, effects, covariance = (np.concatenate(part) for part in zip(*pieces, strict=True))
        at = np.zeros(self._fixed // 2)
        at[0] = 1.0
        if covariates is not None:
            at[1:] = covariates
        design = np.kron(at, np.eye(2))
        fixed = slice(0, self._fixed)
        return value, effects[:, fixed] @ design.T, design @ covariance[:, fixed, fixed] @ design.T

    def _piece(self, parameters: Array) -> tuple[Array, Array, Array]:
        psi = covariance_between_ears(parameters)
        rho = correlation_of_pairs(parameters)
        g, p = len(parameters), len(self._ridge)
        sums, log_det = np.zeros((g, p * p + p + 1)), np.zeros(g)
        for group in self._groups:
            inverse, logs = _inverse(psi, rho, group)
            sums += inverse.reshape(g, -1) @ group.products
            log_det += logs.sum(axis=1)
        information = sums[:, : p * p].reshape(g, p, p) + self._ridge
        score, square = sums[:, p * p : -1], sums[:, -1]
        covariance, log_information = _invert(information)
        solution = np.matmul(covariance, score[:, :, None])[:, :, 0]
        square = square - np.sum(score * solution, axis=1)
        return 0.5 * (log_det + log_information + square), solution, covariance


def covariance_between_ears(parameters: Array) -> Array:
    """Return Psi (g, 2, 2), the covariance of the true logarithms over ears."""
    tau = np.exp(2.0 * np.clip(parameters[:, 0], LOWEST, HIGHEST))
    sigma = np.exp(2.0 * np.clip(parameters[:, 2], LOWEST, HIGHEST))
    b = parameters[:, 1]
    psi = np.empty((len(parameters), 2, 2))
    psi[:, 0, 0] = tau
    psi[:, 0, 1] = psi[:, 1, 0] = b * tau
    psi[:, 1, 1] = b**2 * tau + sigma
    return psi


def correlation_of_pairs(parameters: Array) -> Array:
    """Return rho (g,), what ears of one person have in common; zero where there are none."""
    if parameters.shape[1] < 4:
        return np.zeros(len(parameters))
    return MOST_ALIKE / (1.0 + np.exp(-np.clip(parameters[:, 3], LOWEST, -LOWEST)))


def _group(pairs: LogPairs, columns: Array) -> list[_Group]:
    """Sort the ears into blocks by subject, subjects with the same number of ears together."""
    _, place, count = np.unique(pairs.subject, return_inverse=True, return_counts=True)
    groups = []
    for m in np.unique(count):
        members = [np.flatnonzero(place == subject) for subject in np.flatnonzero(count == m)]
        ears = np.array(members)
        k = len(ears)
        own = np.zeros((k, m, 2, m, 2))
        for j in range(m):
            own[:, j, :, j, :] = pairs.own[ears[:, j]]
        joint = np.concatenate(
            [columns[ears].reshape(k, 2 * m, -1), pairs.values[ears].reshape(k, 2 * m, 1)], 2
        )
        product = joint[:, :, None, :, None] * joint[:, None, :, None, :]
        flat = [product[..., :-1, :-1], product[..., :-1, -1:], product[..., -1:, -1:]]
        products = np.concatenate([part.reshape(k * 4 * m * m, -1) for part in flat], axis=1)
        groups.append(_Group(int(m), own.reshape(k, 2 * m, 2 * m), products))
    return groups


def _inverse(psi: Array, rho: Array, group: _Group) -> tuple[Array, Array]:
    """Return inverses (g, k, 2m, 2m) and logarithms of determinants (g, k) of the blocks of a group."""
    m = group.ears
    if m == 1:
        return _invert(psi[:, None] + group.own[None])
    alike = np.eye(m) + rho[:, None, None] * (1.0 - np.eye(m))
    between = np.einsum("gij,gab->giajb", alike, psi).reshape(len(psi), 2 * m, 2 * m)
    return _invert(between[:, None] + group.own[None])


def _invert(block: Array) -> tuple[Array, Array]:
    """Return inverses and logarithms of determinants of positive definite matrices (..., p, p)."""
    if block.shape[-1] > 2:
        return np.asarray(np.linalg.inv(block)), np.asarray(np.linalg.slogdet(block)[1])
    a, b, c = block[..., 0, 0], block[..., 0, 1], block[..., 1, 1]
    determinant = a * c - b**2
    inverse = np.empty_like(block)
    inverse[..., 0, 0] = c / determinant
    inverse[..., 1, 1] = a / determinant
    inverse[..., 0, 1] = inverse[..., 1, 0] = -b / determinant
    return inverse, np.log(determinant)

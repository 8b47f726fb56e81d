"""How many independent parameters many quantities of the ears have, beyond their measurement errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stapeskit.arrays import Array

# Variation below 5 % between ears is of no use in a model of hearing: such a parameter may be left out.
SMALLEST_SD = 0.05
_REPETITIONS = 199


@dataclass(frozen=True)
class Components:
    """The number of independent parameters."""

    estimate: int  # how many have an intrinsic standard deviation of ln above the smallest that counts
    interval: tuple[int, int]  # 95 %; its upper end is the number of quantities where the ears are too few


def independent_parameters(
    values: Array, own: Array, smallest_sd: float = SMALLEST_SD, seed: int = 1, level: float = 0.95
) -> Components:
    """Count the components of variation between ears that are larger than a smallest one of interest.

    Parameters
    ----------
    values, own : ndarray, (n, p) and (n, p, p)
        Logarithms, and covariances of their measurement errors.
    smallest_sd : float
        Components below it count as none.

    Notes
    -----
    The data are whitened by the mean S; eigenvalue k + 1 is compared with a parametric bootstrap of k
    components with S_i + d^2 I, for k = 0, 1, ... until it is not exceeded. The lower end of the interval
    is the number found so; the upper end excludes k + 1 where eigenvalue k + 1 is below what a component of
    just d would give.
    """
    n, p = values.shape
    rng = np.random.default_rng(seed)
    floor = own + smallest_sd**2 * np.eye(p)
    mean_error = floor.mean(axis=0)
    whitening = np.linalg.inv(np.linalg.cholesky(mean_error))
    roots = np.linalg.cholesky(floor + 1e-15 * np.trace(floor, axis1=1, axis2=2)[:, None, None] * np.eye(p))
    observed, _ = _eigen(values @ whitening.T)
    lower, upper = 0, p
    most = min(p, n - 1)
    for k in range(most):
        between = _components_of(values, whitening, k)
        simulated = _simulate(between, roots, whitening, k, rng)
        if observed[k] <= np.quantile(simulated, level):
            break
        lower = k + 1
    for k in range(lower, most):
        # A further component of just the smallest size of interest, along the direction that the data show.
        between = _components_of(values, whitening, k)
        direction = np.linalg.solve(whitening, _eigen(values @ whitening.T)[1][:, k])
        direction /= np.linalg.norm(direction)
        planted = between + smallest_sd**2 * np.outer(direction, direction)
        simulated = _simulate(planted, roots, whitening, k, rng)
        if observed[k] < np.quantile(simulated, 1.0 - level):
            upper = k
            break
    return Components(lower, (lower, upper))


def _eigen(whitened: Array) -> tuple[Array, Array]:
    """Return eigenvalues, the largest first, and eigenvectors of the covariance of whitened data."""
    roots, axes = np.linalg.eigh(np.cov(whitened.T).reshape(whitened.shape[1], -1))
    return roots[::-1], axes[:, ::-1]


def _components_of(values: Array, whitening: Array, k: int) -> Array:
    """Return the covariance of the k largest components between ears, in the units of the data."""
    roots, axes = _eigen(values @ whitening.T)
    covariance = axes[:, :k] * np.maximum(roots[:k] - 1.0, 0.0) @ axes[:, :k].T
    back = np.linalg.inv(whitening)
    return np.asarray(back @ covariance @ back.T)


def _simulate(between: Array, roots: Array, whitening: Array, k: int, rng: np.random.Generator) -> Array:
    """Return eigenvalue k of simulated cohorts of given variation between ears and measurement errors."""
    n, p = len(roots), len(between)
    sizes, axes = np.linalg.eigh(between)
    spread = axes * np.sqrt(np.maximum(sizes, 0.0))
    data = rng.standard_normal((_REPETITIONS, n, p)) @ spread.T
    data += np.einsum("nij,rnj->rni", roots, rng.standard_normal((_REPETITIONS, n, p)))
    whitened = (data - data.mean(axis=1, keepdims=True)) @ whitening.T
    covariance = np.einsum("rni,rnj->rij", whitened, whitened) / (n - 1)
    return np.asarray(np.linalg.eigvalsh(covariance)[:, p - 1 - k])

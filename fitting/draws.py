"""Normal draws with exact moments, and roots of covariances."""

from __future__ import annotations

import numpy as np

from stapeskit.arrays import Array

_NO_ERROR = 1e-9  # of the largest eigenvalue of a correlation matrix: a combination without an error


def standard_draws(count: int, size: int, seed: int = 0) -> Array:
    """Return normal draws (count, size) of exactly zero mean and unit covariance, in mirrored pairs.

    Odd moments vanish: what is linear in the draws has the covariance that was asked for, without sampling
    error.
    """
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((count // 2, size))
    if count // 2 > size:
        values, vectors = np.linalg.eigh(half.T @ half / len(half))
        half = half @ (vectors / np.sqrt(values)) @ vectors.T
    return np.concatenate([half, -half])


def root_of(covariance: Array) -> Array:
    """Return R (p, p) with R R^T the covariance, which may be singular.

    The symmetric root of the correlation matrix: it follows the covariance continuously, so that draws from
    covariances that rounding alone tells apart are the same. LinAlgError where it is not finite.
    """
    size, values, vectors = _principal(covariance)
    return np.asarray(size[:, None] * (vectors * np.sqrt(values)) @ vectors.T)


def unit_errors(covariance: Array) -> Array:
    """Return the independent errors of unit variance behind a covariance as rows, (k, p): its rank is k."""
    size, values, vectors = _principal(covariance)
    shares = np.sum(np.where(np.diag(covariance)[:, None] > 0.0, vectors**2, 0.0), axis=0) * values
    kept = shares > _NO_ERROR * np.max(shares, initial=0.0)
    return np.asarray((size[:, None] * vectors * np.sqrt(values)).T[kept])


def _principal(covariance: Array) -> tuple[Array, Array, Array]:
    """Return the sizes of a covariance, and eigenvalues and vectors of what is left of it at unit sizes."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = covariance / np.outer(size, size)
    if not np.all(np.isfinite(correlation)):
        raise np.linalg.LinAlgError("an entry has collapsed")
    values, vectors = np.linalg.eigh(correlation)
    return size, np.maximum(values, 0.0), vectors

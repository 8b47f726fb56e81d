"""The part of the Gauss-Newton Hessian of maximum likelihood that comes from noise of the fitted motion.

The corrected motion y' = dq - G Ce^-1 e is independent of the residual e, and its noise has the covariance
C = Spp - G Ce^-1 G^H. So the Hessian H = sum Re(J^H J) that it makes is larger, on average, than that of the
true motion by N_kl = sum over lines of Re[conj(s_k) s_l tr(E_k Ce^-1 E_l C)], which is no information; it is
however the spread of the scores. The covariance of the estimate is therefore (H - N)^-1 H (H - N)^-1 / 2 (the
sandwich of Huber 1967 with both parts known; for errors in variables see Fuller 1987, Measurement Error
Models, section 2.2). Where noise is small against the motion this is the inverse Fisher matrix.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators import ml
from legacy.fitting.model.parameter_vector import basis
from legacy.fitting.model.scaled_lines import Lines, backward, forward
from legacy.stapeskit.arrays import Array, ComplexArray

# Share of the Hessian that must be information for first order to mean anything.
_LEAST = 0.05


def regressor_noise(parameters: Array, lines: Lines) -> Array:
    """Return N (p, p), the part of the Gauss-Newton Hessian that the noise of the motion makes."""
    units = basis(lines.n)
    return noise_products(ml.whiten(parameters, lines), lines, units, units)


def noise_products(
    now: ml.Whitened, lines: Lines, stiffness: Array, damping: Array, weights: Array | None = None
) -> Array:
    """Return N for columns of the regressor that are X y' and s Y y' of any matrices X and Y.

    Parameters
    ----------
    now : Whitened
        The equations of all lines.
    stiffness, damping : ndarray, (k, n, n)
        Real symmetric matrices X and Y.
    weights : ndarray, (lines,), optional
        Of a robust estimate.

    Returns
    -------
    ndarray, (2 k, 2 k)
        Rows and columns of X first.
    """
    n = lines.n
    identity = np.repeat(np.eye(n, dtype=complex)[:, :, None], lines.count, axis=2)
    columns = [backward(now.factor, forward(now.factor, identity[:, place])) for place in range(n)]
    precision = np.stack(columns, axis=1)
    gain = now.state.gain
    explained = np.einsum("ijl,jkl->ikl", gain, precision)
    fitted = lines.spread[:, :n] - np.einsum("ijl,kjl->ikl", explained, gain.conj())
    if weights is not None:
        fitted = fitted * weights
    size = len(stiffness)
    filled = np.empty((2 * size, 2 * size))
    filled[:size, :size] = _traces(precision, fitted, stiffness, stiffness).real
    filled[size:, size:] = _traces(precision, fitted * np.abs(lines.factor) ** 2, damping, damping).real
    filled[:size, size:] = _traces(precision, fitted * lines.factor, stiffness, damping).real
    filled[size:, :size] = filled[:size, size:].T
    return 0.5 * (filled + filled.T)


def _traces(precision: ComplexArray, motion: ComplexArray, left: Array, right: Array) -> ComplexArray:
    """Return sum over lines of tr(X_k Ce^-1 Y_l C) for all pairs of matrices."""
    n = len(precision)
    both = precision.reshape(n * n, -1) @ motion.reshape(n * n, -1).T
    return np.asarray(np.einsum("kab,bcda,lcd->kl", left, both.reshape(n, n, n, n), right, optimize=True))


def information(hessian: Array, noise: Array, level: float) -> tuple[Array, Array]:
    """Return the information (p, p), and the spread of the scores (p, p), of a fit.

    Parameters
    ----------
    hessian : ndarray, (p, p)
        Gauss-Newton, at the estimate.
    noise : ndarray, (p, p)
        Of ``regressor_noise``.
    level : float
        chi2 over its degrees of freedom: how much of the stated noise the data hold. 0 for exact data, whose
        Hessian is all information; above 1 where noise was understated.

    Notes
    -----
    Directions in which less than 5 % of the Hessian is information keep 5 %.
    """
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, 1e-14 * max(float(values[-1]), 1e-300))
    root = (vectors * np.sqrt(values)) @ vectors.T
    inverse = (vectors / np.sqrt(values)) @ vectors.T
    shares, turned = np.linalg.eigh(inverse @ (hessian - level * noise) @ inverse)
    known = root @ (turned * np.maximum(shares, _LEAST)) @ turned.T @ root
    return known, known + noise if level < 1.0 else hessian

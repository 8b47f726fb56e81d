"""What every estimator takes and gives; all quantities are scaled (fitting.model.lines.Scale)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fitting.model.lines import Lines

Array = NDArray[np.float64]
# Multiplications of a matrix product up to which common BLAS libraries start no threads.
_SMALL_PRODUCT = 200_000


@dataclass(frozen=True)
class EstimatorOptions:
    """Choices of an estimator; each reads those that concern it.

    Attributes
    ----------
    robust : str
        ``none``, or ``t4``: Student t with 4 degrees of freedom (ml).
    constraint : str
        ``eigenvalues`` (every eigenvalue of the model in the left half plane) or ``psd`` (K and D positive
        semidefinite) (constrained).
    lower, upper : ndarray, (n (n + 1),), optional
        Bounds of the scaled parameters (constrained).
    passive : bool
        Whether the result must have positive semidefinite K and D (irls, ml).
    tolerance : float
        Largest squared step, in units of the parameters' own uncertainty, that counts as converged.
    """

    robust: str = "none"
    constraint: str = "eigenvalues"
    lower: Array | None = None
    upper: Array | None = None
    passive: bool = True
    tolerance: float = 1e-8


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    Attributes
    ----------
    parameters : ndarray, (n (n + 1),)
        Scaled.
    objective : float
        Value of the estimator's own objective there.
    iterations : int
    converged : bool
    active : tuple of str
        Constraints that hold the estimate back.
    weights : ndarray, (lines,), optional
        Weight of each line of a robust estimator, 1 = full.
    certificate : float or None
        Upper bound of (objective - global optimum) / objective where one is known.
    """

    parameters: Array
    objective: float
    iterations: int
    converged: bool = True
    active: tuple[str, ...] = ()
    weights: Array | None = None
    certificate: float | None = None


class Estimator(Protocol):
    """The interface: one function that fits, one that gives the equations it solves."""

    def estimate(self, lines: Lines, options: EstimatorOptions, start: Array | None = None) -> Estimate:
        """Estimate the scaled parameters."""

    def scores(self, parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:
        """Return the terms, line by line (lines, p), whose sum vanishes at an unconstrained estimate."""


def solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solve H x = b for a positive (semi)definite H, scaled to unit diagonal; least norm when singular."""
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(diagonal, diagonal)
    target = (right.T / diagonal).T
    try:
        root = np.linalg.cholesky(scaled)
        if root.diagonal().min() > 1e-7:
            return (np.linalg.solve(scaled, target).T / diagonal).T
    except np.linalg.LinAlgError:
        pass
    return (np.linalg.lstsq(scaled, target, rcond=1e-13)[0].T / diagonal).T


def times(rows: Array, parameters: Array) -> Array:
    """Return A p without threads, which cost more than they bring at these sizes."""
    return np.asarray(np.einsum("rp,p->r", rows, parameters))


def transposed_times(rows: Array, right: Array) -> Array:
    """Return A^T b without threads."""
    return np.asarray(np.einsum("rp,r->p", rows, right))


def gram(rows: Array) -> Array:
    """Return A^T A in pieces too small for threads."""
    p = rows.shape[1]
    size = max(1, _SMALL_PRODUCT // (p * p))
    return np.asarray(sum(rows[at : at + size].T @ rows[at : at + size] for at in range(0, len(rows), size)))


def least_squares(rows: Array, right: Array) -> Array:
    """Return argmin |A p - b|^2: the pseudo-inverse of A times b, with equilibrated columns.

    Normal equations with two refinements by the residual where the columns are well apart, else QR; the
    least norm (of the equilibrated unknowns) when they are dependent.
    """
    norms = np.sqrt(np.einsum("rp,rp->p", rows, rows))
    norms[norms == 0.0] = 1.0
    scaled = rows / norms
    try:
        root = np.linalg.cholesky(gram(scaled))
        well = root.diagonal().min() > 1e-3
    except np.linalg.LinAlgError:
        well = False
    if well:
        found = np.zeros(len(norms))
        for _ in range(3):
            slope = transposed_times(scaled, right - times(scaled, found))
            found = found + np.linalg.solve(root.T, np.linalg.solve(root, slope))
        return np.asarray(found / norms)
    triangle = np.asarray(np.linalg.qr(np.column_stack([scaled, right]), mode="r"))
    p = rows.shape[1]
    diagonal = np.abs(np.diag(triangle)[:p])
    if len(triangle) >= p and diagonal.min() > 1e-13 * diagonal.max():
        return np.asarray(np.linalg.solve(triangle[:p, :p], triangle[:p, p]) / norms)
    return np.asarray(np.linalg.lstsq(scaled, right, rcond=1e-13)[0] / norms)

"""The interface of the estimators and their linear algebra, in scaled units (`model.scaled_lines.Scale`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from legacy.fitting.model.scaled_lines import Lines, State
from legacy.stapeskit.arrays import Array, ComplexArray

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

    @property
    def student(self) -> bool:
        """Whether lines are weighted by Student's t."""
        return self.robust == "t4"


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    Attributes
    ----------
    parameters : ndarray, (n (n + 1),)
        Scaled.
    objective : float
        Value of the estimator's own objective there.
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


class _Estimates(Protocol):
    def __call__(self, lines: Lines, options: EstimatorOptions, start: Array | None = None) -> Estimate: ...


class _Equations(Protocol):
    def __call__(self, parameters: Array, lines: Lines, options: EstimatorOptions) -> Array: ...


@dataclass(frozen=True)
class Method:
    """The interface of an estimator: how it fits, the equations that it solves, and what it can do.

    Attributes
    ----------
    phrase : str
        What it is called in a paragraph on methods: "K and D were estimated by ...".
    estimate : callable
        Estimate the scaled parameters.
    scores : callable
        Terms, line by line (lines, p), whose sum vanishes at an unconstrained estimate.
    precision : callable
        Weights W of the equations' residuals e, (lines, n, n).
    gradient : callable, optional
        Sum of the scores, where there is a faster way to it.
    likelihood : bool
        Whether it maximises the likelihood of errors in variables: its regressor is the fitted motion, so
        that it has no attenuation bias, its slope is symmetric, and it can start anywhere. Where the plane
        of the ligament is fitted too, the likelihood of all is maximised from its estimate on
        (fitting/ligament/ligament.py).
    robust : tuple of str
        Choices of ROBUST that it can follow.
    bounded : bool
        Whether it takes bounds and a choice of CONSTRAINTS.
    """

    phrase: str
    estimate: _Estimates
    scores: _Equations
    precision: Callable[[Lines, State], ComplexArray]
    gradient: _Equations | None = None
    likelihood: bool = False
    robust: tuple[str, ...] = ("none",)
    bounded: bool = False


def noise_precision(lines: Lines, state: State) -> ComplexArray:  # noqa: ARG001
    """Return the inverse noise covariance of the equations, Ce^-1, (lines, n, n)."""
    return np.asarray(np.linalg.inv(np.moveaxis(state.noise, 2, 0)))


def fixed_precision(row_weights: Array, lines: Lines) -> ComplexArray:
    """Return the same diagonal weights (n,), squared, for every line, (lines, n, n)."""
    return np.broadcast_to(np.diag(row_weights**2).astype(complex), (lines.count, lines.n, lines.n))


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
    """Return A p without threads, which would be slower at these sizes."""
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
        solution = np.zeros(len(norms))
        for _ in range(3):
            slope = transposed_times(scaled, right - times(scaled, solution))
            solution = solution + np.linalg.solve(root.T, np.linalg.solve(root, slope))
        return np.asarray(solution / norms)
    triangle = np.asarray(np.linalg.qr(np.column_stack([scaled, right]), mode="r"))
    p = rows.shape[1]
    diagonal = np.abs(np.diag(triangle)[:p])
    if len(triangle) >= p and diagonal.min() > 1e-13 * diagonal.max():
        return np.asarray(np.linalg.solve(triangle[:p, :p], triangle[:p, p]) / norms)
    return np.asarray(np.linalg.lstsq(scaled, right, rcond=1e-13)[0] / norms)

"""Least squares under signs, bounds and stability: the paper's constrained variant, made unit free.

Minimise |A p - b|^2 (balanced rows) subject to bounds of every entry (diagonals not negative) and to

* ``eigenvalues``: every eigenvalue of the model has a negative real part (the paper's criterion), or
* ``psd``: K and D positive semidefinite, which is sufficient for it and makes the problem convex.

The stable models form a set that is not convex: the best of several paths is taken (fitting.estimators.
stability), and of the ``psd`` solution, which is stable too. Every answer is stable.

The bounded problem without stability is a convex relaxation; where its solution satisfies the constraint it
is the global optimum, and the certificate is zero. For ``psd`` the certificate is the duality gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legacy.fitting.estimators import pinv
from legacy.fitting.estimators.base import Estimate, EstimatorOptions, Method, fixed_precision
from legacy.fitting.estimators.semidefinite import nearest
from legacy.fitting.estimators.semidefinite_roots import active_names, is_positive_definite, nearest_inside
from legacy.fitting.estimators.stability import best_stable, stable_start, state_derivatives, wall_height
from legacy.fitting.model.model import state_matrix
from legacy.fitting.model.parameter_vector import entry_names, pairs, split
from legacy.fitting.model.scaled_lines import Lines, real_rows, regressor
from legacy.stapeskit.arrays import Array

# Relative gap of primal and dual objective at which the optimum is certified: far below any sd.
_GAP = 1e-10
# The stability constraint is not convex: starts beside the convex optimum, of which the best is kept.
_EXTRA_STARTS = 2
# Rows of a piece of QR: at this size common BLAS libraries start no threads.
_PIECE = 128
# Distance to a bound, in scaled units, that counts as leaning on it.
_NEAR = 1e-5


@dataclass(frozen=True)
class Quadratic:
    """|A p - b|^2 / |b|^2 reduced to its triangle: |R p - c|^2 + rest, with bounds and the scaled mass.

    Attributes
    ----------
    triangle : ndarray, (p, p)
    right : ndarray, (p,)
    mass : ndarray, (n, n)
    lower, upper : ndarray, (p,)
    """

    triangle: Array
    right: Array
    rest: float
    mass: Array
    lower: Array
    upper: Array

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return len(self.mass)

    @cached_property
    def state_slopes(self) -> Array:
        """The derivative of the state matrix by every parameter, (p, 2n, 2n)."""
        return state_derivatives(self.mass)

    def value(self, parameters: Array) -> float:
        """Return the objective."""
        return float(np.sum((self.triangle @ parameters - self.right) ** 2)) + self.rest

    def expansion(self, parameters: Array) -> tuple[float, Array, Array]:
        """Return value, gradient and Hessian."""
        residual = self.triangle @ parameters - self.right
        gradient = 2.0 * self.triangle.T @ residual
        return float(residual @ residual) + self.rest, gradient, 2.0 * self.triangle.T @ self.triangle

    def within(self, parameters: Array) -> bool:
        """Return whether the bounds hold."""
        return bool(np.all(parameters >= self.lower) and np.all(parameters <= self.upper))


def reduce(lines: Lines, options: EstimatorOptions) -> Quadratic:
    """Write the constrained problem of some lines."""
    rows = real_rows(regressor(lines.dq, lines.factor))
    right = real_rows(lines.force)
    p = rows.shape[1]
    triangle = _triangle(np.column_stack([rows, right]) / _size(lines))
    lower, upper = _limits(lines, options)
    return Quadratic(triangle[:p, :p], triangle[:p, p], float(triangle[p, p] ** 2), lines.mass, lower, upper)


def _triangle(rows: Array) -> Array:
    """Return the triangle of QR, by pieces too small for threads."""
    columns = rows.shape[1]
    pieces = -(-len(rows) // _PIECE)
    padded = np.zeros((max(pieces, 1) * _PIECE, columns))
    padded[: len(rows)] = rows
    while len(padded) > _PIECE:
        parts = np.asarray(np.linalg.qr(padded.reshape(-1, _PIECE, columns), mode="r")).reshape(-1, columns)
        padded = np.zeros((-(-len(parts) // _PIECE) * _PIECE, columns))
        padded[: len(parts)] = parts
    return np.asarray(np.linalg.qr(padded, mode="r"))


def _size(lines: Lines) -> float:
    return float(np.linalg.norm(real_rows(lines.force))) or 1.0


def _limits(lines: Lines, options: EstimatorOptions) -> tuple[Array, Array]:
    """Return the bounds (p,), diagonals not negative."""
    p = lines.parameters
    half = p // 2
    lower = np.full(p, -np.inf) if options.lower is None else options.lower.copy()
    upper = np.full(p, np.inf) if options.upper is None else options.upper.copy()
    for place, (row, column) in enumerate(pairs(lines.n)):
        if row == column:
            for entry in (place, place + half):
                lower[entry] = max(lower[entry], 0.0)
    return lower, upper


def estimate(lines: Lines, options: EstimatorOptions, start: Array | None = None) -> Estimate:
    """Return the constrained least squares solution and the constraints that hold it."""
    free = pinv.weighted(lines, np.ones(lines.n))
    lower, upper = _limits(lines, options)
    if np.all(free.parameters >= lower) and np.all(free.parameters <= upper):
        violates = not _is_stable(free.parameters, lines.mass)
        if options.constraint == "psd":
            violates = not is_positive_definite(free.parameters, lines.n)
        if not violates:
            value = free.objective / _size(lines) ** 2
            return Estimate(free.parameters, value, 1, True, certificate=0.0)
    problem = reduce(lines, options)
    if options.constraint == "psd":
        return _psd(free.parameters, problem)
    relaxed, active = _solve_bounded(free.parameters, problem)
    if largest_real(relaxed, problem) < 0.0:
        return Estimate(relaxed, problem.value(relaxed), 1, True, active, certificate=0.0)
    convex = _psd(free.parameters, problem)
    inner = _stable_starts(problem, convex.parameters)
    begin = inner[0] if start is None else _interior_start(problem, nearest_inside(start, lines.n))
    parameters, steps, converged = best_stable(problem, stable_start(problem, begin), inner)
    value = problem.value(parameters)
    if convex.objective <= value and largest_real(convex.parameters, problem) < 0.0:
        return Estimate(convex.parameters, convex.objective, steps, converged, convex.active)
    names = (*_at_bounds(parameters, problem), "stability")
    return Estimate(parameters, value, steps, converged, names)


def _stable_starts(problem: Quadratic, convex: Array) -> list[Array]:
    """Return stable starts: the convex solution with K, D >= 0, and others around it, moved inside."""
    generator = np.random.default_rng(0)
    spread = [convex * generator.uniform(0.5, 1.5, len(convex)) for _ in range(_EXTRA_STARTS)]
    starts = [
        _interior_start(problem, nearest_inside(matrices, problem.n, 0.1)) for matrices in (convex, *spread)
    ]
    return [start for start in starts if np.isfinite(wall_height(start, problem))] or [
        stable_start(problem, starts[0])
    ]


def _is_stable(parameters: Array, mass: Array) -> bool:
    """Return whether all eigenvalues lie in the left half plane."""
    if is_positive_definite(parameters, len(mass)):
        return True
    return bool(np.linalg.eigvals(state_matrix(mass, *split(parameters, len(mass)))).real.max() < 0.0)


def _solve_bounded(free: Array, problem: Quadratic) -> tuple[Array, tuple[str, ...]]:
    """Solve the convex problem of signs and bounds alone."""
    if problem.within(free):
        return free, ()
    from scipy.optimize import lsq_linear

    bounded = lsq_linear(
        problem.triangle, problem.right, (problem.lower, problem.upper), method="bvls", tol=1e-14
    ).x
    return bounded, _at_bounds(bounded, problem)


def _psd(free: Array, problem: Quadratic) -> Estimate:
    """Solve the convex problem with K >= 0 and D >= 0, which the free solution does not fulfil."""
    begin = _interior_start(problem, nearest_inside(free, problem.n))
    zero = np.where(problem.lower == 0.0, -np.inf, problem.lower)
    hessian, linear = 2.0 * problem.triangle.T @ problem.triangle, 2.0 * problem.triangle.T @ problem.right
    parameters, gap, steps = nearest(hessian, linear, begin, problem.n, _GAP, zero, problem.upper)
    level = problem.value(parameters)
    active = (*_at_bounds(parameters, problem), *active_names(parameters, problem.n))
    return Estimate(parameters, level, steps, True, active, certificate=gap / max(level, _GAP))


def _interior_start(problem: Quadratic, begin: Array) -> Array:
    """Move a positive definite start strictly between the bounds, towards an uncoupled model."""
    diagonal = np.array([row == column for row, column in pairs(problem.n)] * 2)
    low = np.where(np.isfinite(problem.lower), problem.lower, -1e6)
    high = np.where(np.isfinite(problem.upper), problem.upper, 1e6)
    margin = 1e-3 * np.minimum(high - low, 1.0)
    clipped = np.clip(begin, low + margin, high - margin)
    for share in (1.0, 0.5, 0.1, 0.0):
        trial = np.where(diagonal, clipped, np.clip(share * clipped, low + margin, high - margin))
        if is_positive_definite(trial, problem.n):
            return trial
    from legacy.fitting.errors import FittingError

    raise FittingError.of(
        "the bounds",
        "wide enough for positive semidefinite K and D",
        "bounds that exclude them",
        next_step="Widen {lower} or {upper}",
    )


def largest_real(parameters: Array, problem: Quadratic) -> float:
    """Return the largest real part of the eigenvalues, in units of the reference frequency."""
    state = state_matrix(problem.mass, *split(parameters, problem.n))
    return float(np.linalg.eigvals(state).real.max())


def _at_bounds(parameters: Array, problem: Quadratic) -> tuple[str, ...]:
    names = entry_names(problem.n)
    near = _NEAR
    low = [f"{name}_lower" for name, gap in zip(names, parameters - problem.lower, strict=True) if gap < near]
    high = [
        f"{name}_upper" for name, gap in zip(names, problem.upper - parameters, strict=True) if gap < near
    ]
    return (*low, *high)


def scores(parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:  # noqa: ARG001
    """Return Re(A^H e) of every line, (lines, p)."""
    return pinv.weighted_scores(parameters, lines, np.ones(lines.n))


METHOD = Method(
    "least squares of the equations of motion with bounds and stability (CURAC 2019, p. 98 ff.)",
    estimate,
    scores,
    lambda lines, _: fixed_precision(np.ones(lines.n), lines),
    bounded=True,
)

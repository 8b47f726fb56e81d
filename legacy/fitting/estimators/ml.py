"""Maximum likelihood with errors in all variables: sum of e^H Ce^-1 e, e = B(p) y, Ce = B S B^H.

S is the full covariance of the measured motions of both bodies at a line. The corrected regressor takes the
fitted motion ``yhat = y - S B^H Ce^-1 e``; with it the Gauss-Newton step's right side is the exact gradient,
so that the iteration ends at the true optimum (Pintelon and Schoukens 2012, System Identification, ch. 9).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import irls
from legacy.fitting.estimators.base import (
    Estimate,
    EstimatorOptions,
    Method,
    gram,
    noise_precision,
    solve_symmetric,
    transposed_times,
)
from legacy.fitting.estimators.likelihood_kernel import CORRECTED, DISTANCES, Expansion, expanded
from legacy.fitting.estimators.semidefinite_roots import active_names, is_positive_definite, minimise
from legacy.fitting.model.scaled_lines import (
    Lines,
    State,
    backward,
    cholesky,
    evaluate,
    forward,
    real_rows,
    regressor,
)
from legacy.stapeskit.arrays import Array, ComplexArray

# A fit that needs more is reported as not converged.
_MOST_ITERATIONS = 60
# Degrees of freedom of the t distribution of --robust t4 (Lange, Little and Taylor 1989,
# doi:10.2307/2290063).
_STUDENT = 4.0
# Scaled parameters (1 is usual) beyond which a fit runs away.
_LARGEST = 1e4


@dataclass(frozen=True)
class Whitened:
    """Residual and corrected regressor in units of their noise.

    Attributes
    ----------
    distance : ndarray, (lines,)
        e^H Ce^-1 e.
    residual : ndarray, (n, lines), complex
        L^-1 e with Ce = L L^H.
    factor : ndarray, (n, n, lines), complex
        L.
    """

    distance: Array
    residual: ComplexArray
    state: State
    factor: ComplexArray

    def select(self, keep: NDArray[Any]) -> Whitened:
        """Return some of the lines."""
        state = State(self.state.residual[:, keep], self.state.gain[:, :, keep], self.state.noise[:, :, keep])
        return Whitened(self.distance[keep], self.residual[:, keep], state, self.factor[:, :, keep])

    def corrected(self, lines: Lines) -> ComplexArray:
        """Return the whitened corrected regressor, (n, lines, p)."""
        with np.errstate(all="ignore"):
            multiplier = backward(self.factor, self.residual)
            fitted = lines.dq - np.einsum("ijl,jl->il", self.state.gain, multiplier)
            return forward(self.factor, regressor(fitted, lines.factor))


def whiten(parameters: Array, lines: Lines) -> Whitened:
    """Evaluate the equations and divide them by their noise.

    Where rounding leaves no positive definite noise, far away from any estimate, distances are infinite.
    """
    with np.errstate(all="ignore"):
        state = evaluate(parameters, lines)
        factor = cholesky(state.noise)
        residual = forward(factor, state.residual)
        distance = np.sum(residual.real**2 + residual.imag**2, axis=0)
    distance = np.where(np.isnan(distance), np.inf, distance)
    return Whitened(distance, residual, state, factor)


@dataclass(frozen=True)
class _Merit:
    """What is minimised as a function of the distances of the lines: their sum, or Student's t."""

    robust: bool
    dimension: int
    spread: float = 1.0

    def value(self, distance: Array) -> float:
        if not self.robust:
            return float(np.sum(distance))
        tail = np.log1p(2.0 * distance / (_STUDENT * self.spread))
        return float(0.5 * (_STUDENT + self.dimension) * np.sum(tail))

    def weights(self, distance: Array) -> Array:
        if not self.robust:
            return np.ones(len(distance))
        return (_STUDENT + self.dimension) / (_STUDENT * self.spread + 2.0 * distance)


def estimate(lines: Lines, options: EstimatorOptions, start: Array | None = None) -> Estimate:
    """Minimise by Gauss-Newton with step control; within K >= 0, D >= 0 when the free optimum is outside."""
    merit = _Merit(options.student, 2 * lines.n)
    begin = irls.quick_start(lines) if start is None else start
    if merit.robust:
        joint = _iterate_with_spread(lines, options, Estimate(begin, 0.0, 0))
        if joint is None:
            joint = _with_spread(lines, options, _descend(lines, options, begin, merit), merit)
        best, merit = joint
    else:
        best = _descend(lines, options, begin, merit)
    if options.passive and not is_positive_definite(best.parameters, lines.n):
        best = _minimise_within(lines, best, merit)
    weights = None
    if merit.robust:
        weights = merit.weights(distances(best.parameters, lines))
        weights = weights * (_STUDENT * merit.spread) / (_STUDENT + merit.dimension)
    return replace(best, weights=weights)


def distances(parameters: Array, lines: Lines) -> Array:
    """Return e^H Ce^-1 e of every line, (lines,); infinite where the noise is not positive definite."""
    expansion = expanded(parameters, lines, DISTANCES)
    return whiten(parameters, lines).distance if expansion is None else expansion.distance


def normal_equations(parameters: Array, lines: Lines) -> tuple[Array, Array]:
    """Return the Gauss-Newton Hessian (p, p) and the gradient (p,) of the sum of e^H Ce^-1 e, halved."""
    now = _expand(parameters, lines, _Merit(False, 2 * lines.n))
    return now.hessian, now.gradient


def _expand(parameters: Array, lines: Lines, merit: _Merit) -> Expansion:
    """Return distances, weighted Gauss-Newton Hessian and gradient: compiled, or by numpy."""
    expansion = expanded(parameters, lines, CORRECTED, 4.0 * merit.spread if merit.robust else 0.0)
    if expansion is not None:
        return expansion
    now = whiten(parameters, lines)
    return Expansion(now.distance, *_normal(now, lines, merit.weights(now.distance)))


def _normal(now: Whitened, lines: Lines, weights: Array) -> tuple[Array, Array]:
    root = np.sqrt(weights)
    rows = real_rows(now.corrected(lines) * root[:, None])
    return gram(rows), transposed_times(rows, real_rows(now.residual * root))


def _descend(lines: Lines, options: EstimatorOptions, start: Array, merit: _Merit) -> Estimate:
    """Gauss-Newton steps, damped after Levenberg when a step does not lower the objective.

    The decrement (squared step in units of the parameters' uncertainty) falls by a nearly constant factor, so
    that the last two foretell the next.
    """
    parameters = np.array(start)
    now = _expand(parameters, lines, merit)
    value = _bounded_value(parameters, now.distance, merit)
    if not np.isfinite(value):
        return Estimate(parameters, value, 0, False)
    damping, iterations, converged, previous = 0.0, 0, False, 1e-300
    while iterations < _MOST_ITERATIONS and not converged:
        hessian, gradient = now.hessian, now.gradient
        while iterations < _MOST_ITERATIONS:
            iterations += 1
            step = -solve_symmetric(hessian + damping * np.diag(np.diag(hessian)), gradient)
            decrement = float(step @ hessian @ step)
            trial = _expand(parameters + step, lines, merit)
            reached = _bounded_value(parameters + step, trial.distance, merit)
            converged = decrement * min(decrement / previous, 1.0) < options.tolerance
            if reached <= value or (converged and reached <= value * (1.0 + 1e-9)):
                parameters, now, value = parameters + step, trial, reached
                damping = damping / 10.0 if damping > 1e-6 else 0.0
                previous = decrement
                break
            if converged:
                break
            damping = max(10.0 * damping, 1e-3)
    return Estimate(parameters, value, iterations, converged)


def _bounded_value(parameters: Array, distance: Array, merit: _Merit) -> float:
    """Return the merit, infinite where entries are so large that only noise can have led there.

    The objective saturates for ever larger parameters, so that weak data could send a descent to infinity.
    """
    if not np.max(np.abs(parameters)) < _LARGEST:
        return float("inf")
    return merit.value(distance)


def _iterate_with_spread(
    lines: Lines, options: EstimatorOptions, first: Estimate
) -> tuple[Estimate, _Merit] | None:
    """Iterate parameters and spread of Student's t together; None when that does not settle."""
    dimension = 2 * lines.n
    parameters, spread = first.parameters, 1.0
    for count in range(1, _MOST_ITERATIONS):
        distance = distances(parameters, lines)
        if not np.isfinite(_bounded_value(parameters, distance, _Merit(False, dimension))):
            return None
        following = _spread(distance, lines, spread, 1e-5)
        merit = _Merit(True, dimension, following)
        now = _expand(parameters, lines, merit)
        hessian = now.hessian
        step = -solve_symmetric(hessian, now.gradient)
        settled = abs(following - spread) < 1e-4 * spread
        parameters, spread = parameters + step, following
        if settled and float(step @ hessian @ step) < options.tolerance:
            value = merit.value(distances(parameters, lines))
            return Estimate(parameters, value, first.iterations + count, True), merit
    return None


def _with_spread(
    lines: Lines, options: EstimatorOptions, best: Estimate, merit: _Merit
) -> tuple[Estimate, _Merit]:
    """Alternate between the parameters, with step control, and the spread of Student's t."""
    for _ in range(20):
        distance = distances(best.parameters, lines)
        spread = _spread(distance, lines, merit.spread, 1e-6)
        done = abs(spread - merit.spread) < 1e-4 * spread
        merit = _Merit(True, merit.dimension, spread)
        best = _descend(lines, options, best.parameters, merit)
        if done:
            break
    return best, merit


def _minimise_within(lines: Lines, free: Estimate, merit: _Merit) -> Estimate:
    """Minimise within the positive semidefinite K and D."""

    def value(parameters: Array) -> float:
        return _bounded_value(parameters, distances(parameters, lines), merit)

    def expansion(parameters: Array) -> tuple[float, Array, Array]:
        now = _expand(parameters, lines, merit)
        return merit.value(now.distance), 2.0 * now.gradient, 2.0 * now.hessian

    parameters, converged, steps = minimise(expansion, value, np.empty(0), lines.n)
    if not np.isfinite(value(parameters)):
        raise FittingError.of(
            "the motions",
            "such that K and D have a likelihood",
            "none, for any start",
            next_step="Check the noise variances, or give fewer degrees of freedom with {dof}",
        )
    names = active_names(parameters, lines.n)
    return Estimate(parameters, value(parameters), free.iterations + steps, converged, names)


def scores(parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:
    """Return Re(Jhat^H Ce^-1 e) of every line, (lines, p): half the exact gradient, weighted when robust."""
    now = whiten(parameters, lines)
    weights = np.ones(lines.count)
    if options.student:
        merit = _Merit(True, 2 * lines.n, _spread(now.distance, lines))
        weights = merit.weights(now.distance)
    corrected = now.corrected(lines)
    return np.einsum("ilp,il->lp", corrected.conj(), now.residual * weights).real


def gradient(parameters: Array, lines: Lines, options: EstimatorOptions) -> Array:
    """Return the sum of the scores, (p,)."""
    robust = options.student
    spread = _spread(distances(parameters, lines), lines) if robust else 1.0
    return _expand(parameters, lines, _Merit(robust, 2 * lines.n, spread)).gradient


def _spread(distance: Array, lines: Lines, spread: float = 1.0, tolerance: float = 1e-12) -> float:
    """Return the spread of Student's t that its weighted distances have, by Newton steps in its logarithm."""
    dimension = 2 * lines.n
    wanted = lines.count * dimension - lines.parameters
    for _ in range(100):
        scaled = _STUDENT * spread
        share = 2.0 * distance / (scaled + 2.0 * distance)
        excess = (_STUDENT + dimension) * float(np.sum(share)) - wanted
        slope = (_STUDENT + dimension) * float(np.sum(share * (1.0 - share)))
        change = min(max(excess / max(slope, 1e-300), -2.0), 2.0)
        spread *= float(np.exp(change))
        if abs(change) < tolerance:
            break
    return spread


def robust_slope(distance: Array, terms: Array, lines: Lines) -> tuple[Array, Array]:
    """Return weights (lines,) and the slope (lines, p) of the robust scores by the lines' distances.

    Parameters
    ----------
    distance : ndarray, (lines,)
    terms : ndarray, (lines, p)
        Scores before they are weighted.

    Notes
    -----
    A line's distance moves its own weight, and through the spread, which the distances define, all weights.
    """
    dimension = 2 * lines.n
    spread = _spread(distance, lines)
    merit = _Merit(True, dimension, spread)
    weights = merit.weights(distance)
    whole = _STUDENT * spread + 2.0 * distance
    share = 2.0 * distance / whole
    own = -2.0 * weights / whole
    by_spread = -_STUDENT * weights / whole
    along = 2.0 * _STUDENT * spread / whole**2
    spread_slope = spread * along / float(np.sum(share * (1.0 - share)))
    return weights, terms * own[:, None] + np.outer(spread_slope, by_spread @ terms)


METHOD = Method(
    "maximum likelihood with errors in all variables (Pintelon and Schoukens 2012)",
    estimate,
    scores,
    noise_precision,
    gradient,
    likelihood=True,
    robust=("none", "t4"),
)

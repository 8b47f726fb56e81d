"""Where the uncertainty of K and D comes from: noise of the lines, and errors common to all of them.

Common errors theta (mass parameters, registration, frames, ...) move the estimate by implicit differentiation
of its estimating equations g(p; theta) = 0: dp = -(dg/dp)^-1 (dg/dtheta) dtheta. The displacement of the
footplate frame moves motion and mass together and is joined before it is propagated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import Estimate, solve_symmetric
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.estimators.regressor_noise import information, regressor_noise
from legacy.fitting.model.parameter_vector import basis
from legacy.fitting.model.scaled_lines import Lines, evaluate
from legacy.fitting.uncertainty.sensitivity import contract, slope_by_motion
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import DOF_NAMES

NOISE = "channel_noise"
ATTENUATION = "attenuation"
JOINED_FRAME = "footplate_frame"
# Relative step of central differences: the third root of rounding, where both errors are smallest.
_STEP = 1e-5
# Rounds of the fixed point for the bias by noise in the regressor.
_BIAS_ROUNDS = 6


@dataclass(frozen=True)
class SharedEffect:
    """How one group of common errors moves the result.

    Attributes
    ----------
    source : str
        Name in the budget.
    names : tuple of str, (k,)
        Parameters.
    covariance : ndarray, (k, k)
        SI.
    parameters : ndarray, (p, k)
        Derivative of the SI parameter vector.
    mass : ndarray, (k, n, n)
        Derivative of M_rr.
    """

    source: str
    names: tuple[str, ...]
    covariance: Array
    parameters: Array
    mass: Array


def noise_covariance(problem: Problem, lines: Lines, estimate: Estimate) -> tuple[Array, float, str]:
    """Return the covariance of the scaled parameters from channel noise alone.

    Returns
    -------
    covariance : ndarray, (p, p)
    scale : float
        The factor by which it was widened because chi2 exceeded its degrees of freedom.
    method : str

    Notes
    -----
    ml: inverse Fisher matrix times max(1, chi2 / dof), with what the noise of the fitted motion feigns of
    information subtracted and its spread added (`fitting.estimators.regressor_noise`).
    The others and Student's t: the
    sandwich H^-1 (sum g g^T) H^-T of the lines' scores g (White 1982, doi:10.2307/1912526).
    """
    if problem.method.likelihood and not problem.options.student:
        level = chi2(estimate.parameters, lines) / max(degrees(lines), 1)
        known, spread = known_and_spread(estimate.parameters, lines, level)
        inverse = invert(known)
        widened = max(1.0, level)
        return 0.5 * widened * inverse @ spread @ inverse, widened, "fisher"
    slope = _invert_general(score_slope(problem, lines, estimate.parameters))
    terms = problem.method.scores(estimate.parameters, lines, problem.options)
    terms = terms - terms.mean(axis=0)
    equations = 2 * lines.n * lines.count
    spread = terms.T @ terms * (equations / max(equations - lines.parameters, 1))
    return slope @ spread @ slope.T, 1.0, "sandwich"


def known_and_spread(parameters: Array, lines: Lines, level: float) -> tuple[Array, Array]:
    """Return the information of the lines (p, p), and twice the covariance of the scores.

    ``level`` is chi2 over its degrees of freedom; see fitting.estimators.regressor_noise.information.
    """
    hessian, _ = ml.normal_equations(parameters, lines)
    return information(hessian, regressor_noise(parameters, lines), level)


def chi2(parameters: Array, lines: Lines) -> float:
    """Return the sum of squared normalised residuals over real and imaginary parts."""
    return float(2.0 * np.sum(ml.distances(parameters, lines)))


def degrees(lines: Lines) -> int:
    """Return 2 n lines - p."""
    return 2 * lines.n * lines.count - lines.parameters


def invert(hessian: Array) -> Array:
    """Invert a positive semidefinite matrix; combinations that it does not see get a huge variance."""
    diagonal = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(diagonal, diagonal))
    values = np.maximum(values, 1e-14 * values[-1])
    return np.asarray((vectors / values) @ vectors.T / np.outer(diagonal, diagonal))


def _invert_general(matrix: Array) -> Array:
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    return np.asarray(np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-13) / np.outer(scale, scale))


def score_slope(problem: Problem, lines: Lines, parameters: Array) -> Array:
    """Return the derivative (p, p) of the estimating equations by the scaled parameters."""
    columns = []
    for place in range(len(parameters)):
        step = np.zeros(len(parameters))
        step[place] = 1e-5 * max(1.0, abs(parameters[place]))
        ahead = problem.gradient(parameters + step, lines)
        behind = problem.gradient(parameters - step, lines)
        columns.append((ahead - behind) / (2.0 * step[place]))
    return np.column_stack(columns)


def attenuation(problem: Problem, lines: Lines, parameters: Array) -> Array:
    """Estimate the bias (p,) of an equation-error estimate in scaled parameters; zero for ml.

    Notes
    -----
    The regressor holds the same noise as the residual: E[dA^H W de] = sum over lines of
    conj(s_k) tr(E_k W G^H), G = cov(dq, e); the bias is minus this times the inverse Hessian. It is taken at
    the estimate without its bias, found in a few rounds.
    """
    if problem.method.likelihood:
        return np.zeros(len(parameters))
    slope = _invert_general(score_slope(problem, lines, parameters))
    bias = np.zeros(len(parameters))
    for _ in range(_BIAS_ROUNDS):
        state = evaluate(parameters - bias, lines)
        weighted = problem.method.precision(lines, state) @ np.moveaxis(state.gain, 2, 0).conj().swapaxes(
            1, 2
        )
        traces = np.einsum("kij,lji->kl", basis(lines.n), weighted)
        pull = np.concatenate([traces.real.sum(axis=1), (lines.factor.conj() * traces).real.sum(axis=1)])
        bias = -slope @ pull
    return bias


def implicit_response(problem: Problem, lines: Lines, estimate: Estimate) -> Callable[[Array], Array]:
    """Return the map from changes of the estimating equations (p[, k]) to those of the SI parameters."""
    slope = score_slope(problem, lines, estimate.parameters)
    units = problem.units

    def to_si(change: Array) -> Array:
        return np.asarray((change.T * units).T)

    if not problem.method.likelihood:
        inverse = _invert_general(slope)
        return lambda change: to_si(-(inverse @ change))
    exact = 0.5 * (slope + slope.T)
    if estimate.active or np.linalg.eigvalsh(exact)[0] <= 0.0:
        exact, _ = ml.normal_equations(estimate.parameters, lines)
    return lambda change: to_si(-solve_symmetric(exact, change))


def shared_effects(problem: Problem, lines: Lines, estimate: Estimate) -> list[SharedEffect]:
    """Return how every common error of motion and mass moves the estimate."""
    respond = implicit_response(problem, lines, estimate)
    by_mass = None if problem.inertia.parameters is None else _mass_slope(problem, estimate.parameters)
    effects = [] if by_mass is None else _mass_effects(problem, by_mass, respond)
    return effects + _motion_effects(problem, lines, estimate.parameters, respond, by_mass)


def _mass_slope(problem: Problem, parameters: Array) -> Array:
    """Return the derivative (p, 10) of the estimating equations by the inertial parameters."""
    inertia = problem.inertia
    mass = float(inertia.matrix[0, 0])
    size = np.sqrt(np.abs(np.trace(inertia.matrix[3:, 3:])) * mass)
    steps = _STEP * np.array([mass] + [size] * 3 + [size**2 / mass] * 6)
    columns = []
    for place, step in enumerate(steps):
        change = np.zeros(10)
        change[place] = step
        ahead = problem.gradient(parameters, problem.lines(None, change))
        behind = problem.gradient(parameters, problem.lines(None, -change))
        columns.append((ahead - behind) / (2.0 * step))
    return np.column_stack(columns)


def _mass_effects(problem: Problem, slope: Array, respond: Callable[[Array], Array]) -> list[SharedEffect]:
    """Return the effect of the inertial parameters, one entry a source, sharing one derivative."""
    inertia = problem.inertia
    sources = joined_mass_sources(problem)
    derivative = respond(slope)
    by_mass = inertia.parameter_derivatives(problem.observation.dof)
    names = tuple(f"mass.parameter_{place}" for place in range(10))
    return [SharedEffect(f"mass.{name}", names, part, derivative, by_mass) for name, part in sources.items()]


def joined_mass_sources(problem: Problem) -> dict[str, Array]:
    """Return the covariance (10, 10) of the inertial parameters by source.

    The footplate frame is left out when the motion's common errors hold it: they move the mass as well.
    """
    inertia = problem.inertia
    joined = any(name.startswith(f"{JOINED_FRAME}.") for name in problem.observation.shared_names)
    sources = inertia.without_frame() if joined else dict(inertia.contributions)
    return {name: np.asarray(part) for name, part in sources.items() if np.any(part)}


def motion_moves_mass(problem: Problem) -> Array:
    """Return the derivative (10, k) of the inertial parameters by the motion's common errors."""
    names = problem.observation.shared_names
    along = np.zeros((10, len(names)))
    frame = problem.inertia.frame_derivative()
    for place, name in enumerate(names):
        source, _, axis = name.partition(".")
        if source == JOINED_FRAME and axis in DOF_NAMES:
            along[:, place] = frame[:, DOF_NAMES.index(axis)]
    return along


def _motion_effects(
    problem: Problem,
    lines: Lines,
    parameters: Array,
    respond: Callable[[Array], Array],
    mass_slope: Array | None,
) -> list[SharedEffect]:
    """Return the effect of the motion's common errors as one block; the frame's moves the mass as well."""
    observation = problem.observation
    if observation.shared_derivatives is None or observation.shared_covariance is None:
        return []
    along = motion_moves_mass(problem)
    changes = contract(slope_by_motion(problem, lines, parameters), observation.shared_derivatives)
    if np.any(along):
        if mass_slope is None:
            mass_slope = _mass_slope(problem, parameters)
        changes = changes + mass_slope @ along
    masses = np.einsum("ak,aij->kij", along, problem.inertia.parameter_derivatives(observation.dof))
    return [
        SharedEffect(
            "motion", observation.shared_names, observation.shared_covariance, respond(changes), masses
        )
    ]

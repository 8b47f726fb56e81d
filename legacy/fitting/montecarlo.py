"""Monte Carlo on request: refits of simulated repetitions of the measurement, every known error drawn.

A repetition is the fitted motion (the measured one, moved as little as its noise allows onto the equations
of the fit), plus channel noise, plus the common errors of motion and mass; errors of the footplate frame
move motion and mass together, as in the linear propagation that it checks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from legacy.fitting.estimators.problem import Problem
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.ligament.simulated_repetitions import Repetitions
from legacy.fitting.model.model import modes
from legacy.fitting.model.parameter_vector import entry_names, split
from legacy.fitting.model.scaled_lines import Lines, motion_rows
from legacy.fitting.uncertainty.covariance import ATTENUATION, JOINED_FRAME
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Section
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices


@dataclass(frozen=True)
class MonteCarlo:
    """Scatter of refits.

    Attributes
    ----------
    names : tuple of str, (p,)
        K11, K12, ..., Dnn.
    estimates : ndarray, (refits, p)
        SI.
    frequencies_hz : ndarray, (refits, modes)
        Damped; refits with another number of modes hold NaN.
    failed : int
        Repetitions without a finite estimate, left out.
    """

    names: tuple[str, ...]
    estimates: Array
    frequencies_hz: Array
    failed: int

    @property
    def standard_deviation(self) -> Array:
        """Scatter of every parameter, (p,), SI."""
        return np.asarray(self.estimates.std(axis=0, ddof=1))

    @property
    def intervals(self) -> Array:
        """2.5 and 97.5 % quantiles of every parameter, (p, 2), SI."""
        return np.asarray(np.quantile(self.estimates, [0.025, 0.975], axis=0).T)


def monte_carlo(fit: KDFit, refits: int, seed: int = 0) -> MonteCarlo:
    """Repeat a measurement ``refits`` times and fit each repetition.

    Parameters
    ----------
    refits : int
        At least 2.
    seed : int
        Of the random numbers; the same seed gives the same result.
    """
    problem, rng = fit.problem, np.random.default_rng(seed)
    if fit.ligament is not None:
        return _joint_monte_carlo(fit, Repetitions(fit.ligament, problem.units), refits, rng)
    centre = replace(problem, observation=problem.observation.shifted(_fit(fit) - problem.observation.q))
    root = _roots(problem.observation.covariance) * np.sqrt(fit.budget.widened)
    draw_mass, draw_motion = _common(problem)
    by_mass = problem.inertia.parameter_derivatives(problem.observation.dof)
    estimates, frequencies, failed = [], [], 0
    for _ in range(refits):
        change, mass_change = draw_motion(rng)
        mass_change = mass_change + draw_mass(rng)
        draw = rng.standard_normal((2, *root.shape[:2])) * np.sqrt(0.5)
        change = change + np.einsum("lij,lj->li", root, draw[0] + 1j * draw[1])
        change_of_mass = mass_change if np.any(mass_change) else None
        lines = centre.lines(change, change_of_mass)
        estimate = _solve(centre, lines, fit.estimate.parameters) * problem.units
        if not np.all(np.isfinite(estimate)):
            failed += 1
            continue
        estimates.append(estimate)
        mass = problem.vibrating_mass + np.einsum("a,aij->ij", mass_change, by_mass)
        frequencies.append(_frequencies(fit, mass, estimate))
    return MonteCarlo(entry_names(problem.n), np.array(estimates), np.array(frequencies), failed)


def _frequencies(fit: KDFit, mass: Array, estimate: Array) -> list[float]:
    """Return the frequencies of the modes of a repetition, Hz; NaN where it has another number of modes."""
    pairs = modes(mass, *split(estimate, fit.problem.n), fit.problem.law).pairs
    if len(pairs) != len(fit.modes.pairs):
        return [np.nan] * len(fit.modes.pairs)
    return [mode.frequency_hz for mode in pairs]


def _joint_monte_carlo(fit: KDFit, repetitions: Repetitions, refits: int, rng: Generator) -> MonteCarlo:
    """Repeat the joint fit with the plane of the ligament."""
    problem = fit.problem
    places = dof_indices(problem.observation.dof)
    estimates, frequencies, failed = [], [], 0
    for _ in range(refits):
        try:
            estimate, mass_change = repetitions.draw(rng)
        except np.linalg.LinAlgError:
            failed += 1
            continue
        estimates.append(estimate)
        mass = problem.vibrating_mass + mass_change[np.ix_(places, places)]
        frequencies.append(_frequencies(fit, mass, estimate))
    return MonteCarlo(entry_names(problem.n), np.array(estimates), np.array(frequencies), failed)


def _solve(problem: Problem, lines: Lines, start: Array) -> Array:
    """Return the estimate of one repetition in scaled parameters."""
    begin = start if problem.method.likelihood else None
    return problem.method.estimate(lines, problem.options, begin).parameters


def _fit(fit: KDFit) -> ComplexArray:
    """Return the motion (lines, m) nearest to the measured one that obeys the fitted equations."""
    problem, lines, observation = fit.problem, fit.lines, fit.observation
    rows = problem.mass_rows()
    difference, inertia = motion_rows(observation, rows, problem.scale, problem.mass_on_base)
    stiffness, damping = split(fit.estimate.parameters, problem.n)
    dynamic = stiffness + lines.factor[:, None, None] * damping
    equations = dynamic @ difference - (lines.omega**2)[:, None, None] * inertia
    residual = np.einsum("lij,lj->li", equations, observation.q)
    gain = observation.covariance @ equations.conj().transpose(0, 2, 1)
    moved = gain @ np.linalg.solve(equations @ gain, residual[..., None])
    return np.asarray(observation.q - moved[..., 0])


def _roots(covariance: NDArray[Any]) -> NDArray[Any]:
    """Return roots of Hermitian positive semidefinite matrices."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


Draw = Callable[[Generator], Array]
DrawMotion = Callable[[Generator], tuple[Any, Array]]


def _common(problem: Problem) -> tuple[Draw, DrawMotion]:
    """Return how the common errors of mass and of motion are drawn, the latter with its share of the mass."""
    observation, inertia = problem.observation, problem.inertia
    joined = any(name.startswith(f"{JOINED_FRAME}.") for name in observation.shared_names)
    sources = inertia.without_frame() if joined else dict(inertia.contributions)
    mass_root = _roots(np.asarray(sum(sources.values(), np.zeros((10, 10)))))
    shared, derivatives = observation.shared_covariance, observation.shared_derivatives

    def draw_mass(rng: Generator) -> Array:
        return np.asarray(mass_root @ rng.standard_normal(10))

    if shared is None or derivatives is None:
        return draw_mass, lambda _: (0.0, np.zeros(10))
    along = np.zeros((10, len(observation.shared_names)))
    frame = inertia.frame_derivative()
    for place, name in enumerate(observation.shared_names):
        source, _, axis = name.partition(".")
        if source == JOINED_FRAME and axis in DOF_NAMES:
            along[:, place] = frame[:, DOF_NAMES.index(axis)]
    root = _roots(shared)

    def draw_motion(rng: Generator) -> tuple[Any, Array]:
        errors = root @ rng.standard_normal(len(root))
        return np.einsum("k,klm->lm", errors, derivatives), along @ errors

    return draw_mass, draw_motion


def monte_carlo_json(fit: KDFit, scatter: MonteCarlo) -> dict[str, Any]:
    """Return the scatter as JSON-able data, SI."""
    good = scatter.frequencies_hz[np.all(np.isfinite(scatter.frequencies_hz), axis=1)]
    return {
        "refits": len(scatter.estimates),
        "failed": scatter.failed,
        "sd_si": dict(zip(scatter.names, scatter.standard_deviation.tolist(), strict=True)),
        "sd_over_linear_propagation": dict(
            zip(scatter.names, (scatter.standard_deviation / _linear_sd(fit)).tolist(), strict=True)
        ),
        "intervals_95_si": dict(zip(scatter.names, scatter.intervals.tolist(), strict=True)),
        "frequency_sd_hz": good.std(axis=0, ddof=1).tolist() if len(good) > 1 else None,
    }


def monte_carlo_section(fit: KDFit, simulated: MonteCarlo) -> Section:
    """Return the section of the page that compares the scatter with the linear propagation."""
    stated, scatter = _linear_sd(fit), simulated.standard_deviation
    rows = [
        (name, f"{stated[place]:.3g}", f"{scatter[place]:.3g}", f"{scatter[place] / stated[place]:.3f}")
        for place, name in enumerate(simulated.names)
    ]
    return Section("Monte Carlo", key="monte_carlo").add(
        page.text(
            f"{len(simulated.estimates)} simulated repetitions were fitted, with channel noise and every "
            f"common error of motion and mass drawn anew ({simulated.failed} failed). A ratio has a chance "
            f"error of {100.0 / np.sqrt(2.0 * len(simulated.estimates)):.1f} %."
        ),
        page.table(("entry", "sd stated (SI)", "sd of refits (SI)", "ratio"), rows),
    )


def _linear_sd(fit: KDFit) -> Array:
    """Return the linearly propagated sd (p,), without the attenuation bias, which does not scatter."""
    bias = fit.budget.sources.get(ATTENUATION)
    covariance = fit.covariance if bias is None else fit.covariance - bias
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 1e-300)))

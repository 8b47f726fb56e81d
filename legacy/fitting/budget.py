"""The error budget of a result: the part of each source, for entries, modes and principal axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.fitting.estimators.problem import Problem
from legacy.fitting.law_fits import LawFit
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.model import modes
from legacy.fitting.model.parameter_vector import entry_names, join, matrix, split, vector
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF, principal_axes
from legacy.fitting.model.scaled_lines import Lines
from legacy.fitting.uncertainty.covariance import (
    ATTENUATION,
    NOISE,
    SharedEffect,
    attenuation,
    implicit_response,
    noise_covariance,
    shared_effects,
)
from legacy.stapeskit.arrays import Array

EXPONENT = "damping_exponent"
MODEL_ERROR = "model_error"
# Standard deviation, as a share of the entry, that is rounding: sums of sources lose six digits of 15.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Budget:
    """Covariance of the parameters (SI) by source.

    Attributes
    ----------
    names : tuple of str, (p,)
        K11, K12, ..., Dnn.
    sources : mapping of str to ndarray, (p, p)
        They add up to ``covariance``.
    covariance, noise : ndarray, (p, p)
        Total, and channel noise alone.
    effects : tuple of SharedEffect
        Common errors, for propagation to derived quantities.
    widened : float
        Factor on the noise covariance because chi2 exceeded its degrees of freedom.
    method : str
        ``fisher`` or ``sandwich``.
    bias : ndarray, (p,)
        Estimated attenuation bias, SI; zero for ml.
    """

    names: tuple[str, ...]
    sources: dict[str, Array]
    covariance: Array
    noise: Array
    effects: tuple[SharedEffect, ...]
    widened: float
    method: str
    bias: Array

    def deviations(self) -> dict[str, dict[str, float]]:
        """Return the standard deviation (SI) that each source brings to each entry."""
        return {
            source: {
                name: float(np.sqrt(max(part[place, place], 0.0))) for place, name in enumerate(self.names)
            }
            for source, part in self.sources.items()
        }

    def shares(self) -> dict[str, dict[str, float]]:
        """Return each source's share of the variance of each entry, 0 to 1."""
        total = np.maximum(np.diag(self.covariance), 1e-300)
        return {
            source: {name: float(part[place, place] / total[place]) for place, name in enumerate(self.names)}
            for source, part in self.sources.items()
        }


@dataclass(frozen=True)
class Derived:
    """Quantities derived from K, D and M, with standard deviations from all sources.

    Attributes
    ----------
    frequency_sd_hz, undamped_frequency_sd_hz, damping_ratio_sd : ndarray, (modes,)
    shape_sd : ndarray, (modes, n)
        Of the magnitudes of the shapes.
    principal : ndarray, (6,), or None
        x0 and z0 (m), angle (rad), three stiffnesses (SI); None for other degrees of freedom.
    principal_sd : ndarray, (6,), or None
    """

    frequency_sd_hz: Array
    undamped_frequency_sd_hz: Array
    damping_ratio_sd: Array
    shape_sd: Array
    principal: Array | None
    principal_sd: Array | None


def budget_of(problem: Problem, lines: Lines, fit: LawFit, off: Array | None = None) -> Budget:
    """Gather the covariance of an estimate from every source.

    Parameters
    ----------
    off : ndarray, (p, k), optional
        Columns E: a wrong model puts K and D off by E E^T, in the mean square; SI. With a ligament only.
    """
    if fit.ligament is not None:
        return _joint_budget(problem, fit.ligament, off)
    scaled, widened, method = noise_covariance(problem, lines, fit.estimate)
    units = problem.units
    noise = scaled * np.outer(units, units)
    sources = {NOISE: noise}
    bias = attenuation(problem, lines, fit.estimate.parameters) * units
    if np.any(bias):
        sources[ATTENUATION] = np.outer(bias, bias)
    effects = shared_effects(problem, lines, fit.estimate)
    if fit.law_covariance.size:
        effects.append(_law_effect(fit, widened))
    for effect in effects:
        sources.update(_by_source(effect))
    covariance = sum(sources.values(), np.zeros_like(noise))
    covariance = 0.5 * (covariance + covariance.T)
    return Budget(entry_names(problem.n), sources, covariance, noise, tuple(effects), widened, method, bias)


def _joint_budget(problem: Problem, ligament: LigamentFit, off: Array | None) -> Budget:
    """Return the budget of a joint fit: its shared errors are known as well as the data leave them."""
    sources, effects = dict(ligament.sources), ligament.effects
    if off is not None and off.size:
        size = off.shape[1]
        sources[MODEL_ERROR] = off @ off.T
        still = np.zeros((size, problem.n, problem.n))
        effects = (*effects, SharedEffect(MODEL_ERROR, (), np.eye(size), off, still))
    covariance = sum(sources.values(), np.zeros_like(ligament.plane_covariance))
    return Budget(
        entry_names(problem.n),
        sources,
        0.5 * (covariance + covariance.T),
        sources[NOISE],
        effects,
        ligament.widened,
        "fisher",
        np.zeros(len(covariance)),
    )


def without_rounding(covariance: Array, stiffness: Array, damping: Array) -> Array:
    """Return a covariance of K and D (p, p) in which variances that only rounding made negative are zero.

    Exact data have no noise: what is left of sums of sources may be below zero by their last digits.
    """
    variance = np.diag(covariance)
    least = -((_ROUNDING * np.concatenate([_steps(stiffness), _steps(damping)])) ** 2)
    sound = (variance >= 0.0) | (variance < least)
    return covariance * np.outer(sound, sound)


def _by_source(effect: SharedEffect) -> dict[str, Array]:
    """Split a block of common errors by source; what two sources share is halved between them."""
    if effect.source != "motion":
        return {effect.source: effect.parameters @ effect.covariance @ effect.parameters.T}
    groups: dict[str, list[int]] = {}
    for place, name in enumerate(effect.names):
        groups.setdefault(name.partition(".")[0], []).append(place)
    parts = {}
    for source, places in groups.items():
        half = effect.parameters[:, places] @ effect.covariance[places] @ effect.parameters.T
        parts[source] = 0.5 * (half + half.T)
    return parts


def _law_effect(fit: LawFit, widened: float) -> SharedEffect:
    """Return how the uncertainty of what the law leaves open moves the SI parameters."""
    problem, parameters, law = fit.problem, fit.estimate.parameters, fit.law
    steps = np.diag(1e-5 * law.units(problem.scale.omega))
    slopes = []
    for step in steps:
        ends = [
            problem.gradient(parameters, problem.with_law(law.with_unknowns(law.unknowns + move)).lines())
            for move in (step, -step)
        ]
        slopes.append((ends[0] - ends[1]) / (2.0 * step.max()))
    response = implicit_response(problem, problem.lines(), fit.estimate)(np.stack(slopes, axis=1))
    half = len(parameters) // 2
    if law.law.time_power is None:
        response[half:, 0] -= np.log(problem.scale.omega) * parameters[half:] * problem.units[half:]
    none = np.zeros((len(steps), problem.n, problem.n))
    return SharedEffect(
        EXPONENT, ("exponent", "ratio")[: len(steps)], widened * fit.law_covariance, response, none
    )


def derived_quantities(problem: Problem, stiffness: Array, damping: Array, budget: Budget) -> Derived:
    """Propagate every source to modes and principal axes by the delta method.

    M changes together with K and D where one error moves them all, so that e.g. an error of the mass scale
    leaves the modes where they are.
    """
    n = problem.n
    parameters = join(stiffness, damping)
    mass = vector(problem.vibrating_mass)
    point = np.concatenate([parameters, mass])
    base = _quantities(point, problem)
    root = np.sqrt(np.diag(problem.mass))
    steps = np.concatenate([_steps(stiffness), _steps(damping), vector(np.outer(root, root))]) * 1e-6
    slopes = []
    for place, step in enumerate(steps):
        moved = [point.copy(), point.copy()]
        moved[0][place] += step
        moved[1][place] -= step
        ahead, behind = (_quantities(there, problem) for there in moved)
        if ahead.count == behind.count == base.count and ahead.with_axes == behind.with_axes:
            slopes.append((ahead.values - behind.values) / (2.0 * step))
        else:
            slopes.append(np.full(len(base.values), np.nan))
    slope = np.column_stack(slopes)
    p = len(parameters)
    by_parameters, by_mass = slope[:, :p], slope[:, p:]
    variance = _variance(by_parameters, budget.noise)
    if ATTENUATION in budget.sources:
        variance += _variance(by_parameters, budget.sources[ATTENUATION])
    for effect in budget.effects:
        mass_columns = np.stack([vector(part) for part in effect.mass], axis=1)
        columns = by_parameters @ effect.parameters + by_mass @ mass_columns
        variance += _variance(columns, effect.covariance)
    sd = np.sqrt(np.maximum(variance, 0.0))
    count, axes = base.count, base.with_axes
    return Derived(
        sd[:count],
        sd[count : 2 * count],
        sd[2 * count : 3 * count],
        sd[3 * count : 3 * count + count * n].reshape(count, n),
        base.values[-6:] if axes else None,
        sd[-6:] if axes else None,
    )


def _variance(columns: Array, covariance: Array) -> Array:
    return np.asarray(np.einsum("qi,ij,qj->q", columns, covariance, columns))


def _steps(part: Array) -> Array:
    root = np.sqrt(np.abs(np.diag(part)))
    root = np.maximum(root, 1e-3 * root.max() if root.max() > 0.0 else 1.0)
    return vector(np.outer(root, root))


@dataclass(frozen=True)
class _Quantities:
    """Numbers derived from one set of matrices: frequencies, ratios, shapes, axes, in one row."""

    count: int
    with_axes: bool
    values: Array


def _quantities(point: Array, problem: Problem) -> _Quantities:
    n = problem.n
    p = n * (n + 1)
    stiffness, damping = split(point[:p], n)
    pairs = modes(matrix(point[p:], n), stiffness, damping, problem.law).pairs
    values: list[Array | list[float]] = [
        [mode.frequency_hz for mode in pairs],
        [mode.undamped_frequency_hz for mode in pairs],
        [mode.damping_ratio for mode in pairs],
        np.abs([mode.shape for mode in pairs]).ravel(),
    ]
    with_axes = problem.observation.dof == PRINCIPAL_DOF and stiffness[0, 0] > 0.0
    if with_axes:
        values.append(principal_axes(stiffness).as_vector())
    return _Quantities(len(pairs), with_axes, np.concatenate(values))

"""Measured and simulated responses of a fit, line by line, for figures and tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.estimators import ml
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.model import dynamic_stiffness, simulate
from legacy.fitting.model.parameter_vector import basis, split
from legacy.stapeskit.arrays import Array, ComplexArray


@dataclass(frozen=True)
class Responses:
    """Motion of the stapes, measured and simulated from the measured base motion by Eq. 8.

    Attributes
    ----------
    dof : tuple of str, (n,)
    freq_hz : ndarray, (lines,)
    run : ndarray, (lines,), int
    measured, base, simulated : ndarray, (lines, n), complex
        m and rad.
    measured_sd : ndarray, (lines, n)
        Of the real (= imaginary) part.
    amplitude_sd : ndarray, (lines, n)
        Of the simulated amplitude, from the covariance of K and D.
    normalised : ndarray, (lines, n), complex
        Residuals of the equations, with the shared errors where they are fitted, over their noise;
        real and imaginary parts have unit variance.
    """

    dof: tuple[str, ...]
    freq_hz: Array
    run: NDArray[np.intp]
    measured: ComplexArray
    base: ComplexArray
    simulated: ComplexArray
    measured_sd: Array
    amplitude_sd: Array
    normalised: ComplexArray


def responses(fit: KDFit) -> Responses:
    """Simulate a fit's lines from their measured base motion and, when used, the measured inertial load."""
    observation, law = fit.observation, fit.law
    n = len(fit.dof)
    omega = 2.0 * np.pi * observation.freq_hz
    force = np.zeros_like(observation.base)
    rows = fit.problem.mass_rows()
    covariance = fit.covariance if fit.ligament is None else fit.ligament.plane_covariance
    stiffness, damping = split(fit.estimate.parameters * fit.problem.units, n)
    if observation.load_dof:
        force = omega[:, None] ** 2 * (observation.load @ rows[:, n:].T)
    if fit.problem.mass_on_base is not None:
        force = force + omega[:, None] ** 2 * (observation.base @ fit.problem.mass_on_base.T)
    simulated = simulate(rows[:, :n], stiffness, damping, observation.freq_hz, observation.base, force, law)
    dynamic = dynamic_stiffness(stiffness, damping, omega, law) - omega[:, None, None] ** 2 * rows[:, :n]
    pull = np.einsum("kij,lj->lik", basis(n), observation.base - simulated)
    slopes = np.linalg.solve(dynamic, np.concatenate([pull, law.factor(omega)[:, None, None] * pull], axis=2))
    unit = simulated / np.maximum(np.abs(simulated), 1e-300)
    along = (slopes * unit.conj()[:, :, None]).real
    variance = np.einsum("lip,pq,liq->li", along, covariance, along)
    noise = np.einsum("lii->li", observation.covariance).real[:, :n]
    if fit.ligament is not None:
        residual = fit.ligament.normalised
    else:
        residual = ml.whiten(fit.estimate.parameters, fit.lines).residual.T * np.sqrt(2.0)
    return Responses(
        fit.dof,
        observation.freq_hz,
        observation.run,
        observation.structure,
        observation.base,
        simulated,
        np.sqrt(np.maximum(noise, 0.0) / 2.0),
        np.sqrt(np.maximum(variance, 0.0)),
        residual,
    )

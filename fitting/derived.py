"""Modes and principal axes of a fit with their standard deviations, from draws of its joint distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fitting import entries
from fitting.axes import principal_axes
from fitting.draws import standard_draws
from fitting.model import moved_eigenvalues
from fitting.plane import PISTON_DOF
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit


@dataclass(frozen=True)
class Derived:
    """Quantities that follow from K, D and M with their standard deviations.

    Attributes
    ----------
    frequency_sd_hz, undamped_sd_hz, ratio_sd : ndarray, (modes,)
    shape_sd : ndarray, (modes, n)
        Of the magnitudes of the shapes.
    axes, axes_sd : ndarray, (6,), or None
        Principal axes (`fitting.axes.NAMES`), for y, alpha, gamma.
    """

    frequency_sd_hz: Array
    undamped_sd_hz: Array
    ratio_sd: Array
    shape_sd: Array
    axes: Array | None
    axes_sd: Array | None


def derived_of(fit: KDFit) -> Derived:
    """Return modes and principal axes of the draws of K, D and M."""
    n, law, data = len(fit.dof), fit.law, fit.found.data
    drawn = fit.draws.draws
    extra = standard_draws(len(drawn), max(fit.model_error.shape[1], 1), 1)[:, : fit.model_error.shape[1]]
    drawn = drawn + extra @ fit.model_error.T
    stiffness, damping = entries.split(drawn, n)
    shared = fit.draws.spread[:, fit.found.at["shared"]]
    changes = np.tensordot(shared, data.mass_changes, 1)[:, data.rows][:, :, data.rows]
    root = data.root_mass[data.rows]
    mass = fit.mass + changes * np.outer(root, root)
    values, shapes = moved_eigenvalues(fit.modes, mass, stiffness, damping, law)
    norm = np.linalg.norm(shapes, axis=2) * np.sqrt(1.0 + np.abs(values) ** 2)
    usual = np.array([np.abs(mode.shape) for mode in fit.modes.pairs]).reshape(-1, n)
    axes = axes_sd = None
    if fit.dof == PISTON_DOF and fit.stiffness[0, 0] > 0.0:
        axes = principal_axes(fit.stiffness)
        good = stiffness[stiffness[:, 0, 0] > 0.05 * fit.stiffness[0, 0]]
        off = principal_axes(good) - axes
        off[:, 2] = (off[:, 2] + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi
        axes_sd = np.sqrt(np.mean(off**2, axis=0))
    eigen = np.array([mode.eigenvalue for mode in fit.modes.pairs])
    magnitude = np.abs(shapes) / norm[:, :, None]

    def sd(drawn: Array, middle: Array) -> Array:
        return np.sqrt(np.mean((drawn - middle) ** 2, axis=0))

    return Derived(
        sd(values.imag, eigen.imag) / (2.0 * np.pi),
        sd(np.abs(values), np.abs(eigen)) / (2.0 * np.pi),
        sd(-values.real / np.abs(values), -eigen.real / np.abs(eigen)),
        sd(magnitude, usual),
        axes,
        axes_sd,
    )

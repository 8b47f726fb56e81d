"""Simulated repetitions of a measurement, refitted with the plane of the ligament."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_fit import fit_joint
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.ligament.ligament_fit import LigamentFit, coupling_units
from legacy.fitting.model.parameter_vector import join, split
from legacy.stapeskit.arrays import Array, ComplexArray


class Repetitions:
    """Repetitions of the measurement behind a joint fit: noise, shared errors and priors are drawn.

    Parameters
    ----------
    units : ndarray, (12,)
        SI over scaled of K and D.
    """

    def __init__(self, ligament: LigamentFit, units: Array) -> None:
        lines, equations, fit = ligament.lines, ligament.equations, ligament.joint
        self._ligament, self._units = ligament, units
        self._start = fit.parameters[: equations.unknowns]
        errors = fit.parameters[equations.unknowns :]
        multiplier = fit.at.whitening.conj().swapaxes(1, 2) @ fit.at.residual[:, :, None]
        fitted = ligament.applied.y - (fit.at.gain @ multiplier)[:, :, 0]
        factors = ligament.applied.factors
        self._factors = np.ones_like(fitted) if factors is None else factors
        rest = 0.0 if lines.rests is None else lines.rests @ errors
        self._motion = np.concatenate(_turn(lines, errors, fitted), axis=1) + rest
        self._errors = errors
        values, vectors = np.linalg.eigh(lines.covariance)
        self._root = vectors * np.sqrt(np.maximum(values, 0.0) * ligament.widened)[:, None, :]
        spread = ligament.inplane.covariance
        values, vectors = np.linalg.eigh(spread / np.outer(_size(spread), _size(spread)))
        self._inplane_root = _size(spread)[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0)))

    def draw(self, rng: Generator) -> tuple[Array, Array]:
        """Return K and D (12,) of one repetition about the footplate centre, and its change of M_6, SI."""
        ligament, lines = self._ligament, self._ligament.lines
        errors = rng.standard_normal(lines.errors)
        wanted = self._motion - (0.0 if lines.rests is None else lines.rests @ errors)
        turn = np.eye(DOFS) + lines.maps @ errors
        halves = np.split(wanted, 2, axis=1)
        y = np.concatenate(
            [half @ np.linalg.inv(matrix).T for half, matrix in zip(halves, turn, strict=True)], axis=1
        )
        y = y / self._factors
        noise = rng.standard_normal((2, *y.shape)) * np.sqrt(0.5)
        y = y + np.einsum("lij,lj->li", self._root, noise[0] + 1j * noise[1])
        off = self._errors - errors
        mass = lines.mass + np.einsum("k,kij->ij", off, lines.mass_changes)
        fit = fit_joint(replace(lines, y=y, mass=mass), self._equations(rng), self._start)
        entries = split(fit.parameters[: len(self._units)] * self._units, 3)
        coupling = fit.parameters[ligament.equations.coupling].reshape(3, 3) * coupling_units(lines)
        usual = join(ligament.inplane.stiffness, ligament.inplane.damping)
        inplane = split(usual + self._inplane_root @ rng.standard_normal(len(usual)), 3)
        moved = (part + coupling @ other @ coupling.T for part, other in zip(entries, inplane, strict=True))
        return join(*moved), np.einsum("k,kij->ij", off, lines.mass_slopes)

    def _equations(self, rng: Generator) -> Equations:
        """Return the equations with what is known of the coupling beforehand drawn around the fitted one."""
        equations = self._ligament.equations
        return replace(equations, prior=equations.prior.draw(self._start, rng))


def _turn(lines: JointLines, errors: Array, motion: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    turn = np.eye(DOFS) + lines.maps @ errors
    return motion[:, :DOFS] @ turn[0].T, motion[:, DOFS:] @ turn[1].T


def _size(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 1e-300)))

"""The fit's equations without units, line by line, in arrays whose last axis runs over the lines.

With the measured vector y, the difference dq = P y and the inertial force f = F y (F = w^2 [M_rr, M_rc,
M_rb]) the residual is ``e = Z dq - f``. Noise of covariance S enters it as ``Ce = Z Spp Z^H - Z Spf -
(Z Spf)^H + Sff`` with Spp = P S P^H, Spf = P S F^H, Sff = F S F^H: all that a fit needs of S.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.observation import Observation
from legacy.fitting.model.parameter_vector import entry_names, join, split
from legacy.stapeskit.arrays import Array, ComplexArray

# Multiplications of a matrix product up to which common BLAS libraries start no threads.
_SMALL_PRODUCT = 200_000


@dataclass(frozen=True)
class Scale:
    """Units that make a problem of order one.

    Attributes
    ----------
    root_mass : ndarray, (n,)
        sqrt(M_ii): with lengths L_i = sqrt(M_ii / m) all inertias become one.
    omega : float
        Reference angular frequency, rad/s.
    amplitude : float
        Root mean square of sqrt(M_ii) dq_i.
    """

    root_mass: Array
    omega: float
    amplitude: float

    @classmethod
    def of(cls, observation: Observation, mass: Array) -> Scale:
        """Choose the scale for an observation (SI) and the chosen block (n, n) of a mass matrix."""
        root = np.sqrt(np.diag(mass))
        difference = (observation.structure - observation.base) * root
        amplitude = float(np.sqrt(np.mean(np.abs(difference) ** 2)))
        omega = float(np.exp(np.mean(np.log(2.0 * np.pi * observation.freq_hz))))
        return cls(root, omega, amplitude if amplitude > 0.0 else 1.0)

    def parameter_units(self, law: DampingLaw) -> Array:
        """Return what the scaled parameters are multiplied by to become SI, (n (n + 1),)."""
        product = np.outer(self.root_mass, self.root_mass)
        return join(product * self.omega**2, product * self.omega ** (2.0 - law.time_power))


@dataclass(frozen=True)
class Lines:
    """Scaled equations of all lines.

    Attributes
    ----------
    omega : ndarray, (lines,)
        Angular frequency over that of the scale.
    factor : ndarray, (lines,), complex
        s(w) of the damping law, scaled.
    dq, force : ndarray, (n, lines), complex
        Difference of motions and inertial force.
    spread : ndarray, (n, 2 n, lines), complex
        [Spp, Spf]: covariance of dq with dq and with f, as in the head of this file.
    sff : ndarray, (n, n, lines), complex
        Covariance of f.
    mass : ndarray, (n, n)
        Scaled mass matrix of the chosen degrees of freedom: ones on its diagonal.
    row_weights : ndarray, (n,)
        What turns scaled equations into SI ones, up to a common factor: sqrt(M_ii).
    """

    omega: Array
    factor: ComplexArray
    dq: ComplexArray
    force: ComplexArray
    spread: ComplexArray
    sff: ComplexArray
    mass: Array
    row_weights: Array

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return len(self.dq)

    @property
    def count(self) -> int:
        """Number of lines."""
        return len(self.omega)

    @property
    def parameters(self) -> int:
        """Number of unknowns n (n + 1)."""
        return len(entry_names(self.n))

    def with_law(self, law: DampingLaw) -> Lines:
        """Return the same lines under another damping law."""
        return replace(self, factor=law.factor(self.omega))

    def select(self, keep: NDArray[Any]) -> Lines:
        """Return some of the lines."""
        return Lines(
            self.omega[keep],
            self.factor[keep],
            self.dq[:, keep],
            self.force[:, keep],
            self.spread[:, :, keep],
            self.sff[:, :, keep],
            self.mass,
            self.row_weights,
        )


def assemble(
    observation: Observation,
    mass_rows: Array,
    scale: Scale,
    law: DampingLaw,
    base_mass: Array | None = None,
) -> Lines:
    """Write the scaled equations of an observation.

    Parameters
    ----------
    observation : Observation
        SI.
    mass_rows : ndarray, (n, n + c)
        [M_rr, M_rc]: rows of the chosen degrees of freedom, columns of these and of ``load_dof``; SI.
    base_mass : ndarray, (n, n), optional
        M_rb, mass coupled to the base motion: w^2 (M_rr q_r + M_rc q_c + M_rb q_b) = Z dq.
    """
    n = len(observation.dof)
    omega = 2.0 * np.pi * observation.freq_hz / scale.omega
    both = np.vstack(motion_rows(observation, mass_rows, scale, base_mass))
    y = np.ascontiguousarray((observation.q @ both.T).T)
    noise = np.ascontiguousarray(np.moveaxis(both @ observation.covariance @ both.T, 0, 2))
    square = omega**2
    spread = noise[:n].copy()
    spread[:, n:] *= square
    return Lines(
        omega,
        law.scaled(scale.omega).factor(omega),
        y[:n],
        square * y[n:],
        spread,
        square**2 * noise[n:, n:],
        mass_rows[:, :n] / np.outer(scale.root_mass, scale.root_mass),
        scale.root_mass / scale.root_mass.max(),
    )


def motion_rows(
    observation: Observation, mass_rows: Array, scale: Scale, base_mass: Array | None = None
) -> tuple[Array, Array]:
    """Return P and F / w^2, (n, m) each: scaled dq = P q and f = w^2 (F / w^2) q with w in scaled units.

    Parameters are those of ``assemble``.
    """
    n, c = len(observation.dof), len(observation.load_dof)
    difference = np.zeros((n, 2 * n + c))
    difference[:, :n] = np.diag(scale.root_mass)
    difference[:, n + c :] = -np.diag(scale.root_mass)
    inertia = np.zeros((n, 2 * n + c))
    inertia[:, : n + c] = mass_rows
    if base_mass is not None:
        inertia[:, n + c :] = base_mass
    inertia /= scale.root_mass[:, None]
    return difference / scale.amplitude, inertia / scale.amplitude


@dataclass(frozen=True)
class State:
    """The equations at one parameter vector.

    Attributes
    ----------
    residual : ndarray, (n, lines), complex
        e.
    gain : ndarray, (n, n, lines), complex
        G = P S B^H = Spp Z^H - Spf: covariance of dq with e.
    noise : ndarray, (n, n, lines), complex
        Ce.
    """

    residual: ComplexArray
    gain: ComplexArray
    noise: ComplexArray


def evaluate(parameters: Array, lines: Lines) -> State:
    """Return residual and noise of the equations at scaled parameters (n (n + 1),)."""
    n = lines.n
    matrices = np.vstack(split(parameters, n))
    residual = _stiffness_times(matrices, lines.dq[:, None], lines.factor)[:, 0] - lines.force
    product = _stiffness_times(matrices, lines.spread, lines.factor)
    adjoint = product.reshape(n, 2, n, -1).transpose(1, 2, 0, 3).conj()
    gain = adjoint[0] - lines.spread[:, n:]
    noise = _stiffness_times(matrices, gain, lines.factor)
    noise -= adjoint[1]
    noise += lines.sff
    return State(residual, gain, noise)


def _stiffness_times(matrices: Array, right: ComplexArray, factor: ComplexArray) -> ComplexArray:
    """Return (K + s D) X line by line for K, D stacked (2n, n) and X (n, k, lines), as one real product."""
    n, columns, lines = right.shape
    flat = np.ascontiguousarray(right).view(np.float64).reshape(n, -1)
    product = _product(matrices, flat).view(np.complex128).reshape(2 * n, columns, lines)
    upper = product[:n]
    lower = product[n:]
    lower *= factor
    lower += upper
    return np.asarray(lower)


def _product(left: Array, right: Array) -> Array:
    """Return a matrix product in pieces too small for threads."""
    width = max(1, _SMALL_PRODUCT // left.size)
    if right.shape[1] <= width:
        return np.asarray(left @ right)
    product = np.empty((len(left), right.shape[1]))
    for at in range(0, right.shape[1], width):
        np.matmul(left, right[:, at : at + width], out=product[:, at : at + width])
    return product


def cholesky(noise: ComplexArray) -> ComplexArray:
    """Return the lower Cholesky factors (n, n, lines) of Hermitian matrices, line by line.

    A matrix that is not positive definite gives NaN on its line.
    """
    n = len(noise)
    factor = np.zeros_like(noise)
    for column in range(n):
        left = factor[column, :column]
        square = noise[column, column].real
        if column:
            square = square - np.sum(left.real**2 + left.imag**2, axis=0)
        pivot = np.sqrt(square)
        factor[column, column] = pivot
        for row in range(column + 1, n):
            rest = noise[row, column]
            for inner in range(column):
                rest = rest - factor[row, inner] * left[inner].conj()
            factor[row, column] = rest / pivot
    return factor


def forward(factor: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Solve L x = b line by line; ``right`` is (n, lines) or (n, lines, k)."""
    wide = right.ndim == 3
    solved = np.empty_like(right)
    for row in range(len(factor)):
        rest = right[row]
        for inner in range(row):
            entry = factor[row, inner]
            rest = rest - (entry[:, None] if wide else entry) * solved[inner]
        inverse = 1.0 / factor[row, row].real
        np.multiply(rest, inverse[:, None] if wide else inverse, out=solved[row])
    return solved


def backward(factor: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Solve L^H x = b line by line; ``right`` is (n, lines)."""
    solved = np.empty_like(right)
    for row in range(len(factor) - 1, -1, -1):
        rest = right[row]
        for inner in range(row + 1, len(factor)):
            rest = rest - factor[inner, row].conj() * solved[inner]
        solved[row] = rest / factor[row, row].real
    return solved


def regressor(difference: ComplexArray, factor: ComplexArray) -> ComplexArray:
    """Return the derivative of Z dq by the parameters, (n, lines, n (n + 1))."""
    n, lines = difference.shape
    half = n * (n + 1) // 2
    across = np.ascontiguousarray(difference.T)
    damped = across * factor[:, None]
    filled = np.zeros((n, lines, 2 * half), dtype=complex)
    place = 0
    for row in range(n):
        width = n - row
        filled[row, :, place : place + width] = across[:, row:]
        filled[row, :, place + half : place + half + width] = damped[:, row:]
        for column in range(row + 1, n):
            entry = place + column - row
            filled[column, :, entry] = across[:, row]
            filled[column, :, entry + half] = damped[:, row]
        place += width
    return filled


def real_rows(array: ComplexArray) -> Array:
    """Stack real and imaginary parts of (n, lines[, k]) as rows, (2 n lines[, k])."""
    flat = array.reshape(-1, array.shape[2]) if array.ndim == 3 else array.reshape(-1)
    return np.concatenate([flat.real, flat.imag])

"""The model: dynamic stiffness, frequency response (Eq. 8), state matrix, modes, stability, passivity.

Harmonic signals are e^{+i w t}. Matrices are SI; the length of the modes' shapes is stated by NORMALISATION.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.stapeskit.arrays import Array, ComplexArray

NORMALISATION = (
    "unit Euclidean norm of the state eigenvector (q, lambda q) in SI; phase such that the component of "
    "largest kinetic energy is real and positive"
)
# Of Newton from one pole of a fractional law; without an end the pole is reported as not found.
_MOST_ITERATIONS = 200
# Of the largest eigenvalue: a real part that rounding can bring about.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Mode:
    """One conjugate pair of eigenvalues.

    Attributes
    ----------
    eigenvalue : complex
        The one with positive imaginary part, 1/s.
    shape : ndarray, (n,), complex
        Displacement part of the eigenvector, m and rad, normalised as NORMALISATION says.
    """

    eigenvalue: complex
    shape: ComplexArray

    @property
    def frequency_hz(self) -> float:
        """Damped eigenfrequency Im(lambda) / 2 pi."""
        return self.eigenvalue.imag / (2.0 * np.pi)

    @property
    def undamped_frequency_hz(self) -> float:
        """Magnitude of the eigenvalue over 2 pi."""
        return abs(self.eigenvalue) / (2.0 * np.pi)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio -Re(lambda) / |lambda|."""
        return -self.eigenvalue.real / abs(self.eigenvalue)


@dataclass(frozen=True)
class Modes:
    """Eigenvalues of a model.

    Attributes
    ----------
    pairs : tuple of Mode
        One per conjugate pair, ascending damped frequency.
    overdamped_roots_1_s : tuple of float
        Real eigenvalues, ascending, 1/s.
    max_real_1_s : float
        Largest real part of all eigenvalues, 1/s; not above 0 when K and D are positive semidefinite, where
        rounding alone could make it so.
    """

    pairs: tuple[Mode, ...]
    overdamped_roots_1_s: tuple[float, ...]
    max_real_1_s: float

    @property
    def stable(self) -> bool:
        """True when no motion grows: no real part is positive beyond rounding of the largest eigenvalue."""
        sizes = [abs(mode.eigenvalue) for mode in self.pairs]
        sizes += [abs(root) for root in self.overdamped_roots_1_s]
        return self.max_real_1_s <= _ROUNDING * max(sizes, default=0.0)


def dynamic_stiffness(
    stiffness: ArrayLike, damping: ArrayLike, omega: ArrayLike, law: DampingLaw = VISCOUS
) -> ComplexArray:
    """Return Z(w) = K + s(w) D.

    Parameters
    ----------
    stiffness, damping : array_like, (n, n)
        SI.
    omega : array_like, (lines,)
        Angular frequency, rad/s.
    law : DampingLaw
        Gives s(w); viscous: i w.

    Returns
    -------
    ndarray, (lines, n, n), complex
    """
    factor = law.factor(omega)[:, None, None]
    return np.asarray(stiffness, dtype=float) + factor * np.asarray(damping, dtype=float)


def simulate(
    mass: ArrayLike,
    stiffness: ArrayLike,
    damping: ArrayLike,
    freq_hz: ArrayLike,
    base: ArrayLike,
    load: ArrayLike | None = None,
    law: DampingLaw = VISCOUS,
) -> ComplexArray:
    """Return the motion of the stapes for a base motion and, if any, a known inertial load.

    Parameters
    ----------
    mass, stiffness, damping : array_like, (n, n)
        SI.
    freq_hz : array_like, (lines,)
        Hz.
    base : array_like, (lines, n), complex
        Base motion at the footplate centre, m and rad.
    load : array_like, (lines, n), complex, optional
        w^2 M_rc q_c: the inertial load of measured motion outside the model, N and N m.

    Returns
    -------
    ndarray, (lines, n), complex
        m and rad.
    """
    omega = 2.0 * np.pi * np.asarray(freq_hz, dtype=float)
    z = dynamic_stiffness(stiffness, damping, omega, law)
    force = np.einsum("lij,lj->li", z, np.asarray(base, dtype=complex))
    if load is not None:
        force = force + np.asarray(load, dtype=complex)
    dynamic = z - omega[:, None, None] ** 2 * np.asarray(mass, dtype=float)
    return np.asarray(np.linalg.solve(dynamic, force[..., None])[..., 0], dtype=complex)


def state_matrix(mass: ArrayLike, stiffness: ArrayLike, damping: ArrayLike) -> Array:
    """Return the matrix (2n, 2n) of the first-order form of a viscous model.

    The state is (q, q'); its eigenvalues are those of the system (1/s).
    """
    m = np.asarray(mass, dtype=float)
    n = len(m)
    state = np.zeros((2 * n, 2 * n))
    state[:n, n:] = np.eye(n)
    state[n:, :n] = -np.linalg.solve(m, np.asarray(stiffness, dtype=float))
    state[n:, n:] = -np.linalg.solve(m, np.asarray(damping, dtype=float))
    return state


def modes(mass: ArrayLike, stiffness: ArrayLike, damping: ArrayLike, law: DampingLaw = VISCOUS) -> Modes:
    """Return eigenvalues and shapes of a model.

    Parameters
    ----------
    mass, stiffness, damping : array_like, (n, n)
        SI; mass positive definite.
    law : DampingLaw
        For the viscous law the state matrix is solved; for the others the eigenvalues lambda of
        lambda^2 M + s(lambda) D + K are iterated from the undamped ones.

    Notes
    -----
    With M > 0, K >= 0 and D >= 0 no real part is positive: the energy of a motion cannot grow. Where one is
    zero, for instance with a singular K, rounding decides its computed sign; it is set to zero then.
    """
    m = np.asarray(mass, dtype=float)
    k = np.asarray(stiffness, dtype=float)
    d = np.asarray(damping, dtype=float)
    unit, lengths, time = _scale_to_one(m, k)
    if law.law.polynomial:
        values, vectors = np.linalg.eig(state_matrix(unit(m), unit(k) * time**2, unit(d) * time))
        values = values / time
        shapes = vectors[: len(m)].T / lengths
    else:
        values, shapes = _nonlinear_modes(unit(m), unit(k), unit(d), law)
        shapes = shapes / lengths
    tiny = 1e-9 * float(np.max(np.abs(values)))
    pairs = [
        Mode(complex(value), _normalise(shape, complex(value), m))
        for value, shape in zip(values, shapes, strict=True)
        if value.imag > tiny
    ]
    real = sorted(float(value.real) for value in values if abs(value.imag) <= tiny)
    pairs.sort(key=lambda mode: mode.frequency_hz)
    largest = float(np.max(values.real))
    if largest > 0.0 and passive(k) and passive(d):
        largest = 0.0
        real = [min(root, 0.0) for root in real]
    return Modes(tuple(pairs), tuple(real), largest)


def passive(matrix: ArrayLike) -> bool:
    """Return whether a symmetric matrix is positive semidefinite: such a K stores and such a D loses energy.

    Rows and columns are scaled by their diagonal first, so that the answer does not depend on units.
    """
    values = np.asarray(matrix, dtype=float)
    diagonal = np.diag(values)
    if not np.all(np.isfinite(values)) or np.any(diagonal < 0.0):
        return False
    zero = diagonal == 0.0
    if np.any(values[zero] != 0.0):
        return False
    root = np.sqrt(np.where(zero, 1.0, diagonal))
    return bool(np.linalg.eigvalsh(values / np.outer(root, root))[0] >= -1e-12)


def _scale_to_one(mass: Array, stiffness: Array) -> tuple[Any, ...]:
    """Return a scaling of matrices, the lengths and the time that make a model of order one."""
    root = np.sqrt(np.diag(mass))

    def unit(matrix: Array) -> Array:
        return matrix / np.outer(root, root)

    scale = float(np.sqrt(np.max(np.abs(unit(stiffness)))))
    return unit, root, (1.0 / scale if scale > 0.0 else 1.0)


def _nonlinear_modes(
    mass: Array, stiffness: Array, damping: Array, law: DampingLaw
) -> tuple[ComplexArray, ComplexArray]:
    """Iterate lambda^2 M phi = -(K + s(lambda) D) phi for each mode of the undamped model."""
    inverse = np.linalg.inv(mass)
    squares, vectors = np.linalg.eig(inverse @ stiffness.astype(complex))
    values = np.sqrt(-squares)
    eigenvalues, shapes = [], []
    for value, vector in zip(np.where(values.imag < 0.0, -values, values), vectors.T, strict=True):
        now, shape = complex(value), vector
        for _ in range(_MOST_ITERATIONS):
            squares, candidates = np.linalg.eig(inverse @ (stiffness + law.at(now) * damping))
            overlap = np.abs(candidates.conj().T @ mass @ shape) / np.sqrt(
                np.einsum("ij,ik,kj->j", candidates.conj(), mass, candidates).real
            )
            best = int(np.argmax(overlap))
            root = np.sqrt(-squares[best] + 0j)
            root = -root if root.imag < 0.0 else root
            shape = candidates[:, best]
            if abs(root - now) < 1e-14 * abs(root) + 1e-300:
                now = complex(root)
                break
            now = complex(root)
        eigenvalues.append(now)
        shapes.append(shape)
    return np.array(eigenvalues), np.array(shapes)


def _normalise(shape: ComplexArray, eigenvalue: complex, mass: Array) -> ComplexArray:
    norm = np.linalg.norm(shape) * np.sqrt(1.0 + abs(eigenvalue) ** 2)
    leading = shape[int(np.argmax(np.abs(shape) * np.sqrt(np.diag(mass))))]
    return np.asarray(shape / norm * (abs(leading) / leading), dtype=complex)

"""The model: dynamic stiffness, frequency response (paper, Eq. 8), modes, principal axes, passivity.

Harmonic signals are e^{+i w t}. Matrices are SI; the length of the modes' shapes is stated by NORMALISATION.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from fitting.laws import VISCOUS, DampingLaw
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError

NORMALISATION = (
    "unit Euclidean norm of the state eigenvector (q, lambda q) in SI; phase such that the component of "
    "largest kinetic energy is real and positive"
)
_ROUNDING = 1e-12  # of the largest eigenvalue: a real part that rounding can bring about
_MOST_STEPS = 60  # of the iteration for one pole of a law that is not viscous


@dataclass(frozen=True)
class Mode:
    """One conjugate pair of eigenvalues."""

    eigenvalue: complex  # the one with positive imaginary part, 1/s
    # (n,) complex: displacement part of the eigenvector, m and rad, normalised as NORMALISATION says
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
    """Eigenvalues of a model."""

    pairs: tuple[Mode, ...]  # one per conjugate pair, ascending damped frequency
    overdamped_roots_1_s: tuple[float, ...]  # real eigenvalues, ascending
    # largest real part; not above 0 where K and D are positive semidefinite and rounding alone made it so
    max_real_1_s: float

    @property
    def stable(self) -> bool:
        """Whether no motion grows."""
        sizes = [abs(mode.eigenvalue) for mode in self.pairs]
        sizes += [abs(root) for root in self.overdamped_roots_1_s]
        return self.max_real_1_s <= _ROUNDING * max(sizes, default=0.0)


def simulate(
    mass: ArrayLike,
    stiffness: ArrayLike,
    damping: ArrayLike,
    freq_hz: ArrayLike,
    base: ArrayLike,
    law: DampingLaw = VISCOUS,
) -> ComplexArray:
    """Return the motion of the structure (lines, n) for a base motion (lines, n), m and rad (paper, Eq. 8).

    Matrices are (n, n), SI; the base motion is that at the footplate centre.
    """
    omega = 2.0 * np.pi * np.asarray(freq_hz, dtype=float)
    elastic = np.asarray(stiffness, dtype=float) + law.factor(omega)[:, None, None] * np.asarray(damping)
    dynamic = elastic - omega[:, None, None] ** 2 * np.asarray(mass, dtype=float)
    force = elastic @ np.asarray(base, dtype=complex)[..., None]
    return np.asarray(np.linalg.solve(dynamic, force)[..., 0])


def state_matrix(mass: Array, stiffness: Array, damping: Array) -> Array:
    """Return the matrices (..., 2n, 2n) of the first-order form of viscous models; the state is (q, q')."""
    n = mass.shape[-1]
    state = np.zeros((*np.broadcast_shapes(mass.shape[:-2], stiffness.shape[:-2]), 2 * n, 2 * n))
    state[..., :n, n:] = np.eye(n)
    state[..., n:, :n] = -np.linalg.solve(mass, stiffness)
    state[..., n:, n:] = -np.linalg.solve(mass, damping)
    return state


def passive(matrix: ArrayLike) -> bool:
    """Return whether a symmetric matrix of any units is positive semidefinite: no energy comes from it."""
    values = np.asarray(matrix, dtype=float)
    diagonal = np.diag(values)
    if not np.all(np.isfinite(values)) or np.any(diagonal < 0.0):
        return False
    zero = diagonal == 0.0
    if np.any(values[zero] != 0.0):
        return False
    root = np.sqrt(np.where(zero, 1.0, diagonal))
    return bool(np.linalg.eigvalsh(values / np.outer(root, root))[0] >= -1e-12)


def modes(mass: ArrayLike, stiffness: ArrayLike, damping: ArrayLike, law: DampingLaw = VISCOUS) -> Modes:
    """Return eigenvalues and shapes of a model; matrices (n, n), SI, mass positive definite.

    Notes
    -----
    The viscous law has a state matrix; for others lambda^2 M + s(lambda) D + K = 0 is iterated from the
    undamped eigenvalues. With M > 0, K >= 0, D >= 0 no real part is positive; where one is zero, rounding
    decides its sign.
    """
    m, k, d = (np.asarray(part, dtype=float) for part in (mass, stiffness, damping))
    root = np.sqrt(np.diag(m))
    unit = [part / np.outer(root, root) for part in (m, k, d)]
    time = 1.0 / (float(np.sqrt(np.max(np.abs(unit[1])))) or 1.0)
    if law.name == "viscous":
        values, vectors = np.linalg.eig(state_matrix(unit[0], unit[1] * time**2, unit[2] * time))
        values, shapes = values / time, vectors[: len(m)].T / root
    else:
        squares, undamped = eigh(unit[1], unit[0])
        roots = [complex(0.0, np.sqrt(max(square, 0.0))) for square in squares]
        start = tuple(Mode(value, shape + 0j) for value, shape in zip(roots, undamped.T, strict=True))
        one = [part[None] for part in unit]
        moved = moved_eigenvalues(Modes(start, (), 0.0), one[0], one[1], one[2], law, _MOST_STEPS)
        values, shapes = moved[0][0], moved[1][0] / root
    tiny = 1e-9 * float(np.max(np.abs(values)))
    pairs = [
        Mode(complex(value), _normalised(shape, complex(value), m))
        for value, shape in zip(values, shapes, strict=True)
        if value.imag > tiny
    ]
    real = sorted(float(value.real) for value in values if abs(value.imag) <= tiny)
    largest = float(np.max(values.real))
    if largest > 0.0 and passive(k) and passive(d):
        largest, real = 0.0, [min(value, 0.0) for value in real]
    return Modes(tuple(sorted(pairs, key=lambda mode: mode.frequency_hz)), tuple(real), largest)


def moved_eigenvalues(
    found: Modes, mass: Array, stiffness: Array, damping: Array, law: DampingLaw = VISCOUS, steps: int = 6
) -> tuple[ComplexArray, ComplexArray]:
    """Return eigenvalues (draws, modes) and shapes (draws, modes, n) of models near one that is solved.

    Matrices are (draws, n, n). Each eigenvalue is followed from the middle: lambda^2 M + s(lambda) D + K is
    linear in M, D and K, so that it is solved with s frozen at the eigenvalue of the step before, all draws
    at once.
    """
    n = mass.shape[-1]
    values = np.zeros((len(mass), len(found.pairs)), dtype=complex)
    shapes = np.zeros((len(mass), len(found.pairs), n), dtype=complex)
    if law.name == "viscous":
        roots, vectors = np.linalg.eig(state_matrix(mass, stiffness, damping))
        for place, mode in enumerate(found.pairs):
            nearest = np.argmin(np.abs(roots - mode.eigenvalue), axis=1)
            values[:, place] = roots[np.arange(len(mass)), nearest]
            shapes[:, place] = vectors[np.arange(len(mass)), :n, nearest]
        return values, shapes
    for place, mode in enumerate(found.pairs):
        now = np.full(len(mass), mode.eigenvalue)
        for _ in range(steps):
            factor = law.factor(-1j * now)[:, None, None]
            squares, vectors = np.linalg.eig(np.linalg.solve(mass, stiffness + factor * damping))
            roots = np.sqrt(-squares + 0j)
            roots = np.where(roots.imag < 0.0, -roots, roots)
            nearest = np.argmin(np.abs(roots - now[:, None]), axis=1)
            now = roots[np.arange(len(mass)), nearest]
            shapes[:, place] = vectors[np.arange(len(mass)), :, nearest]
        values[:, place] = now
    return values, shapes


def _normalised(shape: ComplexArray, eigenvalue: complex, mass: Array) -> ComplexArray:
    norm = np.linalg.norm(shape) * np.sqrt(1.0 + abs(eigenvalue) ** 2)
    leading = shape[int(np.argmax(np.abs(shape) * np.sqrt(np.diag(mass))))]
    return np.asarray(shape / norm * (abs(leading) / leading), dtype=complex)


def principal_axes(stiffness: ArrayLike) -> Array:
    """Return the principal axes (..., 6) of K (..., 3, 3) in y, alpha, gamma: x0, z0, angle, stiffnesses; SI.

    The reference point in the footplate plane (x0, z0) = (K13 / K11, -K12 / K11) uncouples the piston motion,
    a rotation about y then the two rocking motions (paper, section on principal axes). This is not eig(K),
    whose result depends on the units.

    The angle is right-handed about +y, from footplate x to the nearest principal axis, within 45 degrees;
    with q = (y0, alpha, gamma) the point (x, z) moves by y0 - z alpha + x gamma, and the axis at the angle t
    is (cos t, -sin t) in (x, z).

    Raises
    ------
    StapeskitError
        A matrix is not 3x3 or its K11 is not positive.
    """
    k = np.asarray(stiffness, dtype=float)
    if k.shape[-2:] != (3, 3) or not np.all(k[..., 0, 0] > 0.0):
        thing = "the stiffness for principal axes"
        raise StapeskitError.of(thing, "3x3 in y, alpha, gamma with K11 > 0", k.tolist())
    piston = k[..., 0, 0]
    rocking = k[..., 1:, 1:] - k[..., 0, 1:, None] * k[..., 0, None, 1:] / piston[..., None, None]
    angle = -0.5 * np.arctan2(2.0 * rocking[..., 0, 1], rocking[..., 0, 0] - rocking[..., 1, 1])
    angle = angle - np.where(np.abs(angle) > 0.25 * np.pi, np.sign(angle) * 0.5 * np.pi, 0.0)
    axis = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    other = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    along = [np.einsum("...i,...ij,...j->...", one, rocking, one) for one in (axis, other)]
    return np.stack([k[..., 0, 2] / piston, -k[..., 0, 1] / piston, angle, piston, *along], axis=-1)

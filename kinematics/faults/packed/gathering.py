"""What packing does to every line of the data: projections and mixtures, in one pass each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.line_kernels import mixed, projected

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Up to so many lines all singular vectors are taken.
_WHOLE = 64
# Ratio of the eigenvalues of a Gram matrix below which the digits of its small ones are lost.
_NARROW = 1e-9


def gathering(moving: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return mixing vectors, (k, n), and the first of them, (n, r), that gather motion (m, n) in r lines.

    Notes
    -----
    They are the right singular vectors V of the motion: of few lines all of them, k = n, else those of the
    motion, k = r. Of many lines they come from the eigenvectors U of the Gram matrix, V^H = S^-1 U^H M, and
    are made orthonormal once more by its Cholesky factor (Yamamoto et al. 2015, Cholesky QR with a second
    pass): they span the motion and are orthonormal to rounding while its singular values are within 3e4.
    """
    size, lines = moving.shape
    rank = min(size, lines)
    if lines > _WHOLE:
        values, left = np.linalg.eigh(moving @ moving.conj().T)
        if values[0] > _NARROW * values[-1]:
            near = (left[:, ::-1].conj().T @ moving) / np.sqrt(values[::-1])[:, None]
            vectors = np.linalg.inv(np.linalg.cholesky(near @ near.conj().T)) @ near
            return vectors, vectors.conj().T
    vectors = np.linalg.svd(moving, full_matrices=lines <= _WHOLE)[2]
    return vectors, vectors[:rank].conj().T


def motion_of(back: Array, divisor: ComplexArray, value: ComplexArray) -> ComplexArray:
    """Return the motion (m, n) of readings ``value`` (channel, n) divided by ``divisor`` (channel,).

    ``back`` (m, channel) are the rows of the least-squares solution.
    """
    rows = back / divisor
    made = projected(np.ascontiguousarray(rows.real), value)
    turned = np.flatnonzero(np.any(rows.imag != 0.0, axis=0))
    if len(turned):
        made = made + 1j * projected(np.ascontiguousarray(rows.imag[:, turned]), value[turned])
    return made


@dataclass(frozen=True)
class Measured:
    """Lines without gaps: readings ``held`` (channel, n) over ``divisor``, rows and motion (m, n)."""

    held: ComplexArray
    divisor: ComplexArray
    basis: Array
    z: ComplexArray

    def mixed(self, vectors: ComplexArray) -> ComplexArray:
        """Return the residuals times vectors (n, k)."""
        return np.asarray(mixed(self.held, vectors) / self.divisor - self.basis @ (self.z @ vectors))

    def at(self, pick: NDArray[np.intp]) -> ComplexArray:
        """Return the residuals (channel, k) of some of the lines."""
        return np.asarray(self.held[:, pick] / self.divisor - self.basis @ self.z[:, pick])

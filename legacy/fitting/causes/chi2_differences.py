"""By how much chi2 differs between two models by noise alone.

The residual of a model is B n where B y = 0 holds without the noise n of the motion y, and chi2 = 2 |P n|^2
with P, of rank n_r a line, the projection of the whitened noise on the rows of B. A model whose B is far from
that of another one sees other combinations of the noise: where both hold, their chi2 differ by noise of the
variance 4 tr (P1 - P2)^2 = 8 sum (n_r - tr P1 P2), whatever the number of unknowns. Criteria that count
unknowns suppose models so close that this is nothing.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.ligament.equations import Equations, operator_of, times_turn, turned
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.stapeskit.arrays import Array, ComplexArray


def difference_sd(one: ComplexArray, other: ComplexArray, covariance: ComplexArray) -> float:
    """Return the standard deviation of the difference of chi2 of two models that both hold.

    Parameters
    ----------
    one, other : ndarray, (lines, n, m), complex
        Their operators B.
    covariance : ndarray, (lines, m, m), complex
        Of the noise of the motion.
    """
    lower = [np.linalg.cholesky(_product(b, covariance, b)) for b in (one, other)]
    roots = [np.asarray(np.linalg.inv(root), dtype=np.complex128) for root in lower]
    across = _product(roots[0], _product(one, covariance, other), roots[1])
    alike = np.sum(np.abs(across) ** 2, axis=(1, 2))
    return float(np.sqrt(8.0 * np.sum(np.maximum(one.shape[1] - alike, 0.0))))


def _product(left: ComplexArray, middle: ComplexArray, right: ComplexArray) -> ComplexArray:
    return np.asarray(left @ middle @ right.conj().swapaxes(1, 2))


def measured_operator(measured: JointLines, unknown: Equations, parameters: Array) -> ComplexArray:
    """Return B as it acts on the motion as measured, (lines, n, 12), terms and shared errors included."""
    lines, equations = unknown.applied(measured, parameters)
    operator = operator_of(lines, equations, parameters)
    moved = times_turn(operator, turned(lines, parameters[unknown.unknowns :]))
    return np.asarray(moved if lines.factors is None else moved * lines.factors[:, None, :])

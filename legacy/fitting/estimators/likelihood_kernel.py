"""Distances of the lines, Hessian and gradient in one compiled pass; ml and irls do the same in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.fitting.model.scaled_lines import Lines
from legacy.fitting.native import compiled
from legacy.stapeskit.arrays import Array

DISTANCES, CORRECTED, MEASURED, EQUAL = range(4)
# Largest number of degrees of freedom of the kernels (a body has six).
_MOST = 6


@dataclass(frozen=True)
class Expansion:
    """What a Gauss-Newton step needs.

    Attributes
    ----------
    distance : ndarray, (lines,)
        e^H Ce^-1 e.
    hessian : ndarray, (p, p)
        Sum of w Re(J^H J), with J the whitened regressor and w the weights of the lines.
    gradient : ndarray, (p,)
        Sum of w Re(J^H L^-1 e), Ce = L L^H.
    """

    distance: Array
    hessian: Array
    gradient: Array


def expanded(parameters: Array, lines: Lines, mode: int, student: float = 0.0) -> Expansion | None:
    """Expand the equations about scaled parameters; None without compiled kernels.

    Parameters
    ----------
    parameters : ndarray, (p,)
    mode : int
        DISTANCES alone; CORRECTED: regressor at the fitted motion (ml); MEASURED: at the measured one (irls);
        EQUAL: that, with Ce = 1.
    student : float
        Four times the spread of Student's t with four degrees of freedom; 0 for least squares.
    """
    kernels = compiled()
    n, count = lines.n, lines.count
    if kernels is None or n > _MOST:
        return None
    unknowns = len(parameters) if mode else 0
    distance, gradient = np.empty(count), np.empty(unknowns)
    hessian = np.empty((unknowns, unknowns))
    arrays = [
        np.ascontiguousarray(array)
        for array in (parameters, lines.factor, lines.dq, lines.force, lines.spread, lines.sff)
    ]
    kernels.ml_expand(
        n,
        count,
        *(array.ctypes.data for array in arrays),
        student,
        2.0 * n,
        mode,
        distance.ctypes.data,
        hessian.ctypes.data,
        gradient.ctypes.data,
    )
    return Expansion(distance, hessian, gradient)

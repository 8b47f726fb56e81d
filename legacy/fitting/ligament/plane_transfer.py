"""From the plane of the ligament to the footplate centre: K = K' + Y K_cc Y^T with the uncertainty of Y.

Y K_cc Y^T is a square. Where the height h of the plane is near zero, h^2 has no slope, and first order leaves
out what a height of one standard deviation adds to K. Of a normal Y, with the covariance C, the second order
is exact, its mean, by which an estimate of Y puts K off, and its covariance:

    E(dY A dY^T) = sum of A_ab C_ia,jb
    Cov(dY A dY^T, dY B dY^T) = sum of A_ab B_cd (C_ia,kc C_jb,ld + C_ia,ld C_jb,kc)

(Isserlis 1918, doi:10.1093/biomet/12.1-2.134).
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.ligament.inplane_stiffness import InplaneStiffness
from legacy.fitting.model.parameter_vector import join, pairs, split
from legacy.stapeskit.arrays import Array

# Degrees of freedom out of the plane: y, alpha, gamma.
_N = 3


def slopes_of_transfer(
    coupling: Array, coupling_covariance: Array, inplane: InplaneStiffness
) -> tuple[Array, Array]:
    """Return the derivatives of Y K_cc Y^T and Y D_cc Y^T by Y, and those of their mean by K_cc and D_cc.

    Parameters
    ----------
    coupling : ndarray, (3, 3)
        Y, SI.
    coupling_covariance : ndarray, (9, 9)

    Returns
    -------
    by_coupling : ndarray, (12, 9)
    by_inplane : ndarray, (12, 12)
    """
    matrices = (inplane.stiffness, inplane.damping)
    by_coupling = np.zeros((2 * len(pairs(_N)), _N * _N))
    for place, (row, column) in enumerate(np.ndindex(_N, _N)):
        unit = np.zeros((_N, _N))
        unit[row, column] = 1.0
        parts = [unit @ part @ coupling.T for part in matrices]
        by_coupling[:, place] = join(*(part + part.T for part in parts))
    spread = coupling_covariance.reshape((_N,) * 4)
    entries = np.eye(2 * len(pairs(_N)))
    by_inplane = [
        join(
            *(
                coupling @ part @ coupling.T + np.einsum("ab,iajb->ij", part, spread)
                for part in split(entry, _N)
            )
        )
        for entry in entries
    ]
    return by_coupling, np.stack(by_inplane, axis=1)


def curvature_of_transfer(coupling_covariance: Array, inplane: InplaneStiffness) -> Array:
    """Return the mean square (12, 12), SI, of the part of Y K_cc Y^T and Y D_cc Y^T of second order in Y."""
    spread = coupling_covariance.reshape((_N,) * 4)
    mean = join(*(np.einsum("ab,iajb->ij", part, spread) for part in (inplane.stiffness, inplane.damping)))
    rows, columns = np.array(pairs(_N)).T
    mixed = [np.einsum("ab,iakc->ibkc", part, spread) for part in (inplane.stiffness, inplane.damping)]
    blocks = []
    for left in mixed:
        line = []
        for matrix in (inplane.stiffness, inplane.damping):
            straight = np.einsum("ibkc,cd,jbld->ijkl", left, matrix, spread)
            crossed = np.einsum("ibld,cd,jbkc->ijkl", left, matrix, spread)
            line.append((straight + crossed)[rows[:, None], columns[:, None], rows, columns])
        blocks.append(line)
    square = np.block(blocks) + np.outer(mean, mean)
    return np.asarray(0.5 * (square + square.T))

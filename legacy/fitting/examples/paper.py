"""The numbers printed in the paper (CURAC 2019, p. 98 ff.), each with its place there.

Order of the degrees of freedom in every stapes matrix: y, alpha, gamma; SI units. Order in every beam
matrix: y, alpha; N and mm.
"""

from __future__ import annotations

import numpy as np

from legacy.stapeskit.arrays import Array

PAPER_DOF: tuple[str, ...] = ("y", "alpha", "gamma")


def _matrix(*rows: tuple[float, ...]) -> Array:
    matrix = np.array(rows)
    matrix.setflags(write=False)
    return matrix


# Stapes experiment, section "Results": mass matrix about the footplate centre, kg, kg m, kg m2.
PAPER_MASS = _matrix(
    (3.2e-6, -434.88e-12, 143.04e-12),
    (-434.88e-12, 9.77e-12, -29.7e-15),
    (143.04e-12, -29.7e-15, 11.14e-12),
)
# Stapes experiment, section "Results": stiffness, N/m, N, N m.
PAPER_STIFFNESS = _matrix(
    (1722.0, 0.414, -0.48),
    (0.414, 1.37e-3, -6.41e-5),
    (-0.48, -6.41e-5, 3.79e-3),
)
# Stapes experiment, section "Results": damping as printed, N s/m, N s, N m s. Unstable and not passive.
PAPER_DAMPING_PRINTED = _matrix(
    (22.89e-3, 61.42e-5, -36.79e-5),
    (61.42e-5, 30.15e-9, -67.56e-13),
    (-36.79e-5, -67.56e-13, 56.46e-9),
)
# The same with the exponents of D12 and D13 corrected from -5 to -7, which restores Table 2.
PAPER_DAMPING_CORRECTED = _matrix(
    (22.89e-3, 61.42e-7, -36.79e-7),
    (61.42e-7, 30.15e-9, -67.56e-13),
    (-36.79e-7, -67.56e-13, 56.46e-9),
)

# Table 2: "resonant frequencies" in Hz (damped ones), damping ratios, and |phi| per mode (y, alpha, gamma),
# labelled nm, urad, urad there; in fact the unit-norm state eigenvector times 1e9, 1e6, 1e6.
TABLE_2_FREQUENCY_HZ = (1753.0, 2783.0, 3862.0)
TABLE_2_DAMPING_RATIO = (0.12, 0.14, 0.18)
TABLE_2_SHAPE = _matrix((33.5, 90.0, 4.6), (33.4, 9.2, 56.0), (164.0, 25.0, 32.0))
TABLE_2_SHAPE_SCALE = (1e9, 1e6, 1e6)

# Stapes experiment, principal axes of K (Fig. 6): N/m, N m/rad, N m/rad; origin in mm (magnitudes); degrees.
PAPER_PRINCIPAL_STIFFNESS = (1722.0, 1.26e-3, 3.65e-3)
PAPER_PRINCIPAL_ORIGIN_MM = (0.28, 0.24)
PAPER_PRINCIPAL_ANGLE_DEG = 1.0

# Stapes experiment: band in Hz, largest piston amplitude in m (Fig. 4), literature mean of K11 and its sd.
PAPER_BAND_HZ = (400.0, 5000.0)
PAPER_LARGEST_PISTON_M = 148e-9
LITERATURE_PISTON_STIFFNESS = (1238.0, 973.0)

# Beam experiment: Young's modulus N/mm2, height, width, length mm.
BEAM_YOUNG_N_MM2 = 210000.0
BEAM_HEIGHT_MM = 0.81
BEAM_WIDTH_MM = 10.0
BEAM_LENGTH_MM = 48.0
# Table 1, theory, from Eq. 6: c1 in N/mm, c2 in N, c3 in N mm.
TABLE_1_THEORY = (10.0914, 242.195, 7750.2)
# Table 1: printed deviations of the estimate (Eq. 9) of c1, c2, c3, in percent.
TABLE_1_DEVIATION_PERCENT = (3.17, 1.28, 0.38)

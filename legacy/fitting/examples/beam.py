"""The paper's beam experiment: a clamped beam with a cube, in y and alpha at the beam's tip.

The beam lies along +z from the base (z = 0) to the tip (z = l); a rotation alpha about x displaces a point by
u_y = -alpha z. Lengths here are mm and forces N, as the paper prints them; what ends in ``_si`` is SI.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from legacy.fitting.examples.paper import BEAM_HEIGHT_MM, BEAM_LENGTH_MM, BEAM_WIDTH_MM, BEAM_YOUNG_N_MM2
from legacy.stapeskit.arrays import Array

# kg/m3, of structural steel.
STEEL_DENSITY = 7850.0


@dataclass(frozen=True)
class Beam:
    """A beam of rectangular cross section.

    Attributes
    ----------
    young_n_mm2 : float
        Young's modulus, N/mm2.
    height_mm, width_mm, length_mm : float
        Height is along y, the direction of bending.
    """

    young_n_mm2: float = BEAM_YOUNG_N_MM2
    height_mm: float = BEAM_HEIGHT_MM
    width_mm: float = BEAM_WIDTH_MM
    length_mm: float = BEAM_LENGTH_MM
    density_kg_m3: float = STEEL_DENSITY

    @property
    def second_moment_mm4(self) -> float:
        """I = b h^3 / 12."""
        return self.width_mm * self.height_mm**3 / 12.0

    @property
    def stiffness(self) -> Array:
        """K at the tip in (y, alpha): N/mm, N, N mm (paper Eq. 6)."""
        length = self.length_mm
        bending = self.young_n_mm2 * self.second_moment_mm4
        return bending * np.array([[12.0 / length**3, 6.0 / length**2], [6.0 / length**2, 4.0 / length]])

    @property
    def coefficients(self) -> Array:
        """c1 (N/mm), c2 (N), c3 (N mm) of Table 1: K11, K12, K22."""
        k = self.stiffness
        return np.array([k[0, 0], k[0, 1], k[1, 1]])

    @property
    def mass_kg(self) -> float:
        """Mass of the beam."""
        return self.density_kg_m3 * self.height_mm * self.width_mm * self.length_mm * 1e-9

    def stiffness_si(self) -> Array:
        """Return K at the tip in N/m, N, N m."""
        return self.stiffness * np.array([[1e3, 1.0], [1.0, 1e-3]])

    def condensed_mass_si(self) -> tuple[Array, Array]:
        """Return the beam's own mass at the tip and its coupling to the base, M_tt and M_tb (2, 2), SI.

        Notes
        -----
        Consistent mass of one Euler-Bernoulli element (static condensation; Przemieniecki 1968, Theory of
        Matrix Structural Analysis, section 11.5) in (y, alpha), with M_tb acting on the base motion
        transported to the tip: w^2 (M_tt q_s + M_tb q_b) = Z dq.
        """
        length = self.length_mm * 1e-3
        element = element_mass(length) * self.mass_kg
        transport = transport_to_tip(length)
        return element[2:, 2:], element[2:, :2] @ np.linalg.inv(transport)


def element_mass(length: float) -> Array:
    """Return the consistent mass (4, 4) of an element of unit mass in (y1, alpha1, y2, alpha2)."""
    l = length
    return (
        np.array(
            [
                [156.0, -22.0 * l, 54.0, 13.0 * l],
                [-22.0 * l, 4.0 * l**2, -13.0 * l, -3.0 * l**2],
                [54.0, -13.0 * l, 156.0, 22.0 * l],
                [13.0 * l, -3.0 * l**2, 22.0 * l, 4.0 * l**2],
            ]
        )
        / 420.0
    )


def element_stiffness(length: float) -> Array:
    """Return the bending stiffness (4, 4) of an element with E I = 1 in (y1, alpha1, y2, alpha2)."""
    l = length
    return (
        np.array(
            [
                [12.0, -6.0 * l, -12.0, -6.0 * l],
                [-6.0 * l, 4.0 * l**2, 6.0 * l, 2.0 * l**2],
                [-12.0, 6.0 * l, 12.0, 6.0 * l],
                [-6.0 * l, 2.0 * l**2, 6.0 * l, 4.0 * l**2],
            ]
        )
        / l**3
    )


def transport_to_tip(length: float) -> Array:
    """Return T (2, 2) that maps the base's (y, alpha) to the tip: y - l alpha, alpha."""
    return np.array([[1.0, -length], [0.0, 1.0]])


def difference(tip: ArrayLike, base: ArrayLike, length: float) -> NDArray[np.float64]:
    """Return dq (..., 2) of tip and base motion in (y, alpha): paper Eq. 7.

    Notes
    -----
    dq1 = y_s - y_b + l alpha_b, dq2 = alpha_s - alpha_b.
    """
    return np.asarray(tip) - np.asarray(base) @ transport_to_tip(length).T


def deviations_percent(estimate: ArrayLike, theory: ArrayLike) -> Array:
    """Return |estimate - theory| / |theory| in percent, entry by entry: paper Eq. 9."""
    reference = np.asarray(theory, dtype=float)
    return np.asarray(100.0 * np.abs(np.asarray(estimate, dtype=float) - reference) / np.abs(reference))

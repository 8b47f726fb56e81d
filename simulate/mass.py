"""The exact mass properties of a solid of uniform density: ten inertial parameters about a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from simulate.solids import Moments
from stapeskit.arrays import Array
from stapeskit.spatial import TENSOR_PLACES, matrix_from_parameters


@dataclass(frozen=True, kw_only=True)
class MassProperties:
    """Mass, centre of mass and inertia of a body, in the axes of its solid."""

    mass_kg: float
    centre_of_mass_mm: Array  # (3,)
    inertia_about_com_kg_m2: Array  # (3, 3)

    def parameters(self) -> Array:
        """Return the ten inertial parameters (stapeskit.spatial.PARAMETER_NAMES) about the origin, SI."""
        arm = self.centre_of_mass_mm * 1e-3
        parallel = self.mass_kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        tensor = self.inertia_about_com_kg_m2 + parallel
        entries = [tensor[i, j] for i, j in TENSOR_PLACES]
        return np.array([self.mass_kg, *(self.mass_kg * arm), *entries])

    def matrix(self) -> Array:
        """Return the 6x6 mass matrix about the origin, SI."""
        return matrix_from_parameters(self.parameters())


def uniform_mass(moments: Moments, density_kg_m3: float) -> MassProperties:
    """Return the mass properties of a body of uniform density."""
    second = moments.second_mm5
    return MassProperties(
        mass_kg=density_kg_m3 * moments.volume_mm3 * 1e-9,
        centre_of_mass_mm=moments.centroid_mm,
        inertia_about_com_kg_m2=density_kg_m3 * 1e-15 * (np.trace(second) * np.eye(3) - second),
    )


def point_mass(mass_kg: float, place_mm: ArrayLike) -> Array:
    """Return the ten inertial parameters of a point mass about the origin, SI."""
    centre = np.asarray(place_mm, dtype=float)
    nothing = np.zeros((3, 3))
    return MassProperties(
        mass_kg=mass_kg, centre_of_mass_mm=centre, inertia_about_com_kg_m2=nothing
    ).parameters()

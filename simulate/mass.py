"""The exact mass properties of a solid: ten inertial parameters about a point, uniform or graded density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from simulate.solids import Moments, Solid
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


def relative_density(height_mm: Array, ends_mm: tuple[float, float], gradient: float) -> Array:
    """Return density over the density halfway up, at heights of any shape.

    1 - gradient at the lower end of the body, 1 + gradient at the upper one, straight between, level beyond.
    """
    low, high = ends_mm
    share = np.clip((height_mm - 0.5 * (low + high)) / (0.5 * (high - low)), -1.0, 1.0)
    return np.asarray(1.0 + gradient * share)


def graded_mass(solid: Solid, density_kg_m3: float, gradient: float) -> MassProperties:
    """Return the mass properties of a body whose density changes with its height y, by a share to either end.

    Notes
    -----
    The integrals over the polyhedron are sums over the tetrahedra between its faces and one point, each by a
    Gauss-Legendre product rule mapped onto it (Duffy 1982, SIAM J. Numer. Anal. 19:1260,
    doi:10.1137/0719090) with four nodes an axis: exact for the cubic integrands here.
    """
    height = solid.vertices_mm[:, 1]
    points, weights = _quadrature(solid)
    weights = weights * relative_density(points[:, 1], (float(height.min()), float(height.max())), gradient)
    total = float(weights.sum())
    centre = weights @ points / total
    arm = points - centre
    second = (weights[:, None] * arm).T @ arm
    return uniform_mass(Moments(volume_mm3=total, centroid_mm=centre, second_mm5=second), density_kg_m3)


def _quadrature(solid: Solid, count: int = 4) -> tuple[Array, Array]:
    """Return quadrature points (n, 3), mm, and signed weights (n,), mm3, that fill a closed surface."""
    node, weight = np.polynomial.legendre.leggauss(count)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    u, v, w = (part.ravel() for part in np.meshgrid(node, node, node, indexing="ij"))
    rule = np.multiply.outer(np.multiply.outer(weight, weight), weight).ravel() * u**2 * v
    shares = np.column_stack([u * (1.0 - v), u * v * (1.0 - w), u * v * w])
    apex = solid.vertices_mm.mean(axis=0)
    corners = solid.vertices_mm[solid.faces] - apex
    six_volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    points = np.einsum("qk,fkd->fqd", shares, corners).reshape(-1, 3) + apex
    return points, (six_volumes[:, None] * rule).ravel()


def point_mass(mass_kg: float, place_mm: ArrayLike) -> Array:
    """Return the ten inertial parameters of a point mass about the origin, SI."""
    centre = np.asarray(place_mm, dtype=float)
    nothing = np.zeros((3, 3))
    return MassProperties(
        mass_kg=mass_kg, centre_of_mass_mm=centre, inertia_about_com_kg_m2=nothing
    ).parameters()

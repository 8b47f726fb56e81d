"""Bone whose density changes along the height of the stapes, with its exact mass properties.

The grey value of bone follows its density: relative to the stated density it is 1 - g at the foot of the
stapes, 1 + g at its top and straight between, g the gradient.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.mass.mass_properties import MassProperties
from legacy.ct_inertia.surface.surface import Surface

Array = NDArray[np.float64]


def height_range(stapes: Surface) -> tuple[float, float]:
    """Return the lowest and the highest point of a stapes in its footplate frame, mm."""
    height = stapes.vertices_mm[:, 1]
    return float(height.min()), float(height.max())


def relative_density(height_mm: Array, ends_mm: tuple[float, float], gradient: float) -> Array:
    """Return density over stated density at heights (any shape); level beyond the ends."""
    low, high = ends_mm
    share = np.clip((height_mm - 0.5 * (low + high)) / (0.5 * (high - low)), -1.0, 1.0)
    return np.asarray(1.0 + gradient * share)


def graded_mass(stapes: Surface, density_kg_m3: float, gradient: float) -> MassProperties:
    """Return the mass properties of a stapes with a density gradient, in its footplate frame.

    Parameters
    ----------
    stapes : Surface
        In the footplate frame.
    density_kg_m3 : float
        Halfway up.
    gradient : float
        Relative change from there to either end.

    Notes
    -----
    The integrals over the polyhedron are sums over the tetrahedra between its faces and one point, each by a
    Gauss-Legendre product rule mapped onto it (Duffy 1982, SIAM J. Numer. Anal. 19:1260,
    doi:10.1137/0719090) with four nodes an axis: exact for the cubic integrands here.
    """
    points, weights = _nodes(stapes)
    weights = weights * relative_density(points[:, 1], height_range(stapes), gradient)
    total = float(weights.sum())
    centre = weights @ points / total
    arm = points - centre
    second = (weights[:, None] * arm).T @ arm
    tensor = density_kg_m3 * 1e-15 * (np.trace(second) * np.eye(3) - second)
    mass = density_kg_m3 * 1e-9 * total
    packed = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
    volume = stapes.moments().volume_mm3
    return MassProperties(
        density_kg_m3 * total / volume, volume * 1e-9, centre, np.array([mass, 0.0, 0.0, 0.0, *packed])
    )


def _nodes(stapes: Surface, count: int = 4) -> tuple[Array, Array]:
    """Return quadrature points (n, 3) and signed weights (n,) that fill a closed surface."""
    node, weight = np.polynomial.legendre.leggauss(count)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    u, v, w = (part.ravel() for part in np.meshgrid(node, node, node, indexing="ij"))
    wu, wv, ww = (part.ravel() for part in np.meshgrid(weight, weight, weight, indexing="ij"))
    rule = wu * wv * ww * u**2 * v
    shares = np.column_stack([u * (1.0 - v), u * v * (1.0 - w), u * v * w])
    apex = stapes.vertices_mm.mean(axis=0)
    corners = stapes.vertices_mm[stapes.faces] - apex
    six_volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    points = np.einsum("qk,fkd->fqd", shares, corners).reshape(-1, 3) + apex
    return points, (six_volumes[:, None] * rule).ravel()

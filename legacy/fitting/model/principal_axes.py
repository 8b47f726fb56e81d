"""Principal axes of the stiffness: the point and the rotation about y that uncouple y, alpha and gamma.

A shift of the reference point in the footplate plane to (x0, z0) = (K13 / K11, -K12 / K11) uncouples the
piston motion; a rotation about y then uncouples the two rocking motions (paper, section on principal axes).
This is not eig(K), whose result depends on the units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from legacy.fitting.errors import FittingError
from legacy.stapeskit.arrays import Array

PRINCIPAL_DOF: tuple[str, ...] = ("y", "alpha", "gamma")


@dataclass(frozen=True)
class PrincipalAxes:
    """Where and how the stiffness is diagonal.

    Attributes
    ----------
    origin_x_m, origin_z_m : float
        Stiffness centre from the footplate centre, in footplate axes.
    angle_rad : float
        Right-handed about +y, from footplate x to the nearest principal axis, within 45 degrees.
    stiffness : ndarray, (3,)
        N/m, N m/rad about the axis near x, N m/rad about the axis near z.
    """

    origin_x_m: float
    origin_z_m: float
    angle_rad: float
    stiffness: Array

    def as_vector(self) -> Array:
        """Return (x0, z0, angle, three stiffnesses), for propagation."""
        return np.array([self.origin_x_m, self.origin_z_m, self.angle_rad, *self.stiffness])


def principal_axes(stiffness: ArrayLike) -> PrincipalAxes:
    """Return the principal axes of a stiffness matrix (3, 3) in y, alpha, gamma; SI.

    Raises
    ------
    FittingError
        The matrix is not 3x3 or K11 is not positive.

    Notes
    -----
    With q = (y0, alpha, gamma) the footplate point (x, z) moves by y = y0 - z alpha + x gamma. The
    right-handed axis at angle t about +y from x is (cos t, -sin t) in (x, z).
    """
    k = np.asarray(stiffness, dtype=float)
    if k.shape != (3, 3) or not k[0, 0] > 0.0:
        raise FittingError.of(
            "the stiffness for principal axes", "3x3 in y, alpha, gamma with K11 > 0", k.tolist()
        )
    rocking = k[1:, 1:] - np.outer(k[0, 1:], k[0, 1:]) / k[0, 0]
    angle = -0.5 * np.arctan2(2.0 * rocking[0, 1], rocking[0, 0] - rocking[1, 1])
    if abs(angle) > 0.25 * np.pi:
        angle -= np.sign(angle) * 0.5 * np.pi
    axis = np.array([np.cos(angle), -np.sin(angle)])
    other = np.array([np.sin(angle), np.cos(angle)])
    values = np.array([k[0, 0], axis @ rocking @ axis, other @ rocking @ other])
    return PrincipalAxes(k[0, 2] / k[0, 0], -k[0, 1] / k[0, 0], float(angle), values)

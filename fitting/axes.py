"""Principal axes of the stiffness: the point and the rotation about y that uncouple y, alpha and gamma.

A shift of the reference point in the footplate plane to (x0, z0) = (K13 / K11, -K12 / K11) uncouples the
piston motion; a rotation about y then uncouples the two rocking motions (paper, section on principal axes).
This is not eig(K), whose result depends on the units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

NAMES = ("origin_x_m", "origin_z_m", "angle_rad", "k_y", "k_about_x", "k_about_z")


def principal_axes(stiffness: ArrayLike) -> Array:
    """Return (x0, z0, angle, three stiffnesses), (..., 6), of K (..., 3, 3) in y, alpha, gamma; SI.

    The angle is right-handed about +y, from footplate x to the nearest principal axis, within 45 degrees;
    with q = (y0, alpha, gamma) the point (x, z) moves by y0 - z alpha + x gamma, and the axis at the angle t
    is (cos t, -sin t) in (x, z).

    Raises
    ------
    StapeskitError
        A matrix is not 3x3 or its K11 is not positive.
    """
    k = np.asarray(stiffness, dtype=float)
    if k.shape[-2:] != (3, 3) or not np.all(k[..., 0, 0] > 0.0):
        thing = "the stiffness for principal axes"
        raise StapeskitError.of(thing, "3x3 in y, alpha, gamma with K11 > 0", k.tolist())
    piston = k[..., 0, 0]
    rocking = k[..., 1:, 1:] - k[..., 0, 1:, None] * k[..., 0, None, 1:] / piston[..., None, None]
    angle = -0.5 * np.arctan2(2.0 * rocking[..., 0, 1], rocking[..., 0, 0] - rocking[..., 1, 1])
    angle = angle - np.where(np.abs(angle) > 0.25 * np.pi, np.sign(angle) * 0.5 * np.pi, 0.0)
    axis = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    other = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    along = [np.einsum("...i,...ij,...j->...", one, rocking, one) for one in (axis, other)]
    return np.stack([k[..., 0, 2] / piston, -k[..., 0, 1] / piston, angle, piston, *along], axis=-1)

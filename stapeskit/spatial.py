"""Twists and spatial inertia in the order of the degrees of freedom: x, y, z, alpha, beta, gamma.

Velocity of a body point: ``v(p) = v0 + omega x (p - p0)`` with p0 the reference point.
All lengths here are in m, as everything that enters a matrix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array
from stapeskit.dof import DOF_NAMES as DOF_NAMES
from stapeskit.dof import DOF_UNITS as DOF_UNITS
from stapeskit.faults import Fault
from stapeskit.frames import cross_matrix

PARAMETER_NAMES: tuple[str, ...] = ("m", "mx", "my", "mz", "Jxx", "Jyy", "Jzz", "Jxy", "Jyz", "Jxz")
TENSOR_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Order of the six entries of an inertia tensor."""


def dof_indices(names: tuple[str, ...]) -> list[int]:
    """Return the positions (0 to 5) of degrees of freedom in the full order."""
    return [DOF_NAMES.index(name) for name in names]


def twist_transfer(rotation: ArrayLike, shift_m: ArrayLike) -> Array:
    """Return X (6, 6) with ``q_new = X q_old`` for a new reference point and new axes.

    ``rotation`` is new_from_old, ``shift_m`` the new reference point minus the old one in OLD axes.

    v_new = R (v + omega x shift), omega_new = R omega (Featherstone 2008, Rigid Body Dynamics
    Algorithms, section 2.8, with linear before angular components).
    """
    r = np.asarray(rotation, dtype=float)
    transfer = np.zeros((6, 6))
    transfer[:3, :3] = r
    transfer[3:, 3:] = r
    transfer[:3, 3:] = -r @ cross_matrix(shift_m)
    return transfer


def cross(first: Array, second: Array) -> Array:
    """Return the products (..., 3) of vectors (..., 3), as `np.cross` does in three times the time."""
    x, y, z = first[..., 0], first[..., 1], first[..., 2]
    a, b, c = second[..., 0], second[..., 1], second[..., 2]
    product = np.empty(np.broadcast_shapes(first.shape, second.shape))
    product[..., 0] = y * c - z * b
    product[..., 1] = z * a - x * c
    product[..., 2] = x * b - y * a
    return product


def point_rows(arms_m: ArrayLike, directions: ArrayLike) -> Array:
    """Return the observation rows (n, 6) of beams: ``v . d = [d, arm x d] . (v0, omega)``.

    Arms (n, 3) are points minus reference point; directions (n, 3) are towards the laser head.
    """
    arms = np.asarray(arms_m, dtype=float)
    beams = np.asarray(directions, dtype=float)
    return np.hstack([beams, cross(arms, beams)])


def shifted_point_rows(directions: ArrayLike, shift_m: ArrayLike) -> Array:
    """Return the change (n, 6) of `point_rows` when the points move by ``shift_m``, (3,) or (n, 3), m."""
    beams = np.asarray(directions, dtype=float)
    return np.hstack([np.zeros_like(beams), cross(np.asarray(shift_m, dtype=float), beams)])


def matrix_from_parameters(parameters: ArrayLike) -> Array:
    """Return the 6x6 spatial inertia from (m, m c, J about the reference point); linear in its argument.

    The ten parameters are kg, kg m and kg m2, in the order of PARAMETER_NAMES. Jxy, Jyz, Jxz are tensor
    elements, minus the integral of the product.

    M = [[m 1, -m [c]x], [m [c]x, J]]: kinetic energy of a rigid body with linear before angular velocity
    (Featherstone 2008, section 2.13). In the paper's order, M(y, alpha) = -m z_c and M(y, gamma) = +m x_c.
    """
    p = np.asarray(parameters, dtype=float)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = p[0] * np.eye(3)
    matrix[3:, :3] = cross_matrix(p[1:4])
    matrix[:3, 3:] = -matrix[3:, :3]
    for value, (row, column) in zip(p[4:], TENSOR_PLACES, strict=True):
        matrix[3 + row, 3 + column] = value
        matrix[3 + column, 3 + row] = value
    return matrix


def parameters_from_matrix(matrix: ArrayLike) -> Array:
    """Return the ten inertial parameters of a 6x6 spatial inertia: the inverse of matrix_from_parameters."""
    m = np.asarray(matrix, dtype=float)
    first = np.array([m[5, 1], m[3, 2], m[4, 0]])
    tensor = [m[3 + row, 3 + column] for row, column in TENSOR_PLACES]
    return np.concatenate([[np.trace(m[:3, :3]) / 3.0], first, tensor])


def parameter_basis() -> Array:
    """Return the derivative of the 6x6 spatial inertia by its ten parameters, (10, 6, 6)."""
    return np.stack([matrix_from_parameters(row) for row in np.eye(10)])


def inertia_faults(matrix: ArrayLike, name: str = "the mass matrix", where: str = "") -> list[Fault]:
    """List what makes a 6x6 spatial inertia physically impossible; empty when it is possible.

    Checks symmetry, the rigid-body pattern, a positive mass, a positive definite tensor about the centre
    of mass, and the triangle inequality of its principal moments (Wensing, Kim and Slotine 2018,
    doi:10.1109/LRA.2017.2729659). ``where`` is the file that contains it, for the messages.
    """
    m = np.asarray(matrix, dtype=float)
    if m.shape != (6, 6) or not np.all(np.isfinite(m)):
        return [Fault(name, "a finite 6x6 matrix", f"shape {m.shape}", where)]
    diagonal = np.sqrt(np.abs(np.diag(m)))
    scale = np.outer(diagonal, diagonal)
    scale = np.where(scale > 0.0, scale, 1.0)
    if np.max(np.abs(m - m.T) / scale) > 1e-9:
        return [Fault(name, "symmetric", "an asymmetric matrix", where)]
    parameters = parameters_from_matrix(m)
    if np.max(np.abs(m - matrix_from_parameters(parameters)) / scale) > 1e-9:
        pattern = "the matrix of a rigid body ([[m 1, -m c x], [m c x, J]])"
        return [Fault(name, pattern, "another pattern", where)]
    mass, tensor_about_com = central_tensor(parameters)
    if not mass > 0.0:
        return [Fault(f"the mass in {name}", "positive", f"{mass:g} kg", where)]
    moments = np.linalg.eigvalsh(tensor_about_com)
    got = f"principal moments of {', '.join(f'{value:g}' for value in moments)} kg m2"
    if moments[0] <= 0.0:
        return [Fault(f"the inertia in {name}", "positive definite about the centre of mass", got, where)]
    if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-9):
        return [Fault(f"the principal moments in {name}", "within the triangle inequality", got, where)]
    return []


def central_tensor(parameters: ArrayLike) -> tuple[float, Array]:
    """Return mass (kg) and inertia tensor about the centre of mass (3, 3), kg m2, of ten parameters."""
    p = np.asarray(parameters, dtype=float)
    mass = float(p[0])
    if mass == 0.0:
        return 0.0, np.zeros((3, 3))
    arm = cross_matrix(p[1:4] / mass)
    return mass, matrix_from_parameters(p)[3:, 3:] - mass * arm @ arm.T

"""Exact derivatives of the fitted motion by errors that all lines share: frames and point positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinematics.frames import cross_matrix
from kinematics.measurement import BodyChannels
from kinematics.placement import Placement
from kinematics.rigid_fit import LineFit
from kinematics.spatial import dof_indices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def pose_derivatives(fit: LineFit, body: BodyChannels, placement: Placement) -> ComplexArray:
    """Return d q / d(displacement of the measurement's frame in its own axes), (6, freq, m).

    Parameters
    ----------
    fit : LineFit
    body : BodyChannels
        Positions and directions in the footplate frame, as fitted.
    placement : Placement

    Notes
    -----
    Measured values and weights stay; positions p and directions d move with the frame:
    dp = R (u + theta x s), dd = R (theta x d_source). See fit_derivative.
    """
    rotation = placement.transform.rotation
    origin = placement.transform.translation_mm
    arms = body.positions_mm * 1e-3
    from_origin = (body.positions_mm - origin) * 1e-3
    made = []
    for axis in range(6):
        if axis < 3:
            shift = np.broadcast_to(rotation[:, axis], arms.shape)
            turn = np.zeros_like(body.directions)
        else:
            spin = cross_matrix(rotation[:, axis - 3]).T
            shift, turn = from_origin @ spin, body.directions @ spin
        change = np.hstack([turn, np.cross(shift, body.directions) + np.cross(arms, turn)])
        made.append(fit_derivative(fit, change[:, dof_indices(fit.beams.dof)], slice(None)))
    return np.stack(made)


def position_derivatives(fit: LineFit, body: BodyChannels, point: str) -> ComplexArray:
    """Return d q / d(position of one point), (3, freq, m), per m along the footplate axes."""
    mine = np.array([name == point for name in body.points])
    made = []
    for axis in range(3):
        change = np.zeros((int(mine.sum()), 6))
        change[:, 3:] = np.cross(np.eye(3)[axis], body.directions[mine])
        made.append(fit_derivative(fit, change[:, dof_indices(fit.beams.dof)], mine))
    return np.stack(made)


def fit_derivative(fit: LineFit, change: Array, channels: slice | NDArray[np.bool_]) -> ComplexArray:
    """Return the derivative (freq, m) of the weighted fit by a parameter that moves its rows.

    Parameters
    ----------
    fit : LineFit
    change : ndarray, (channel, m)
        Derivative of the observation rows of ``channels``.
    channels : slice or mask
        The rows that move.

    Notes
    -----
    From the normal equations A^T W (y - A q) = 0:
    dq = (A^T W A)^-1 (dA^T W r - A^T W dA q), with fixed weights W.
    """
    beams = fit.beams
    weights = fit.weights[channels]
    q = np.where(np.isfinite(fit.q.real), fit.q, 0.0)
    in_dof = change.T @ (weights * fit.residual[channels])
    in_basis = beams.to_dof.T @ in_dof - beams.basis[channels].T @ (weights * (change @ q.T))
    solved = np.einsum("fab,bf->fa", fit.inverse, in_basis, optimize=True) @ beams.to_dof.T
    return np.asarray(np.where(np.isfinite(fit.q.real), solved, np.nan))


def position_parameters(bodies: Sequence[BodyChannels]) -> list[tuple[int, str, float]]:
    """Return (body, point, sd in m) for every point with a stated position error."""
    found: dict[tuple[int, str], float] = {}
    for number, body in enumerate(bodies):
        for point, sd in zip(body.points, body.position_sd_mm, strict=True):
            if np.isfinite(sd) and sd > 0.0:
                found[(number, point)] = float(sd) * 1e-3
    return [(number, point, sd) for (number, point), sd in found.items()]

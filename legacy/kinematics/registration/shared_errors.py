"""Exact derivatives of the fitted motion by errors that all lines share: frames and point positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_noise import blocks
from legacy.kinematics.fit.rigid_fit import Channels, LineFit
from legacy.kinematics.measurement import BodyChannels
from legacy.kinematics.registration.placement import Placement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.frames import cross_matrix
from legacy.stapeskit.spatial import dof_indices, shifted_point_rows

_WHOLE = slice(None)
# Up to here derivatives are kept by name; beyond, as patterns from a sample of values that leave out less
# than 1e-3 of their energy.
_NAMED_BYTES = 2**26
_SAMPLE = 2_000_000
_LEFT_OUT = 1e-3
_PATTERNS = 40


def pose_derivatives(fit: LineFit, body: BodyChannels, placement: Placement) -> ComplexArray:
    """Return d q / d(displacement of the measurement's frame in its own axes), (6, freq, m).

    Parameters
    ----------
    body : BodyChannels
        Positions and directions in the footplate frame, as fitted.

    Notes
    -----
    Measured values and weights stay; positions p and directions d move with the frame:
    dp = R (u + theta x s), dd = R (theta x d_source). See fit_derivatives.
    """
    rotation = placement.transform.rotation
    origin = placement.transform.translation_mm
    arms = body.positions_mm * 1e-3
    from_origin = (body.positions_mm - origin) * 1e-3
    changes = []
    for axis in range(6):
        if axis < 3:
            shift = np.broadcast_to(rotation[:, axis], arms.shape)
            turn = np.zeros_like(body.directions)
        else:
            spin = cross_matrix(rotation[:, axis - 3]).T
            shift, turn = from_origin @ spin, body.directions @ spin
        changes.append(np.hstack([turn, np.cross(shift, body.directions) + np.cross(arms, turn)]))
    return fit_derivatives(fit, np.stack(changes)[:, :, dof_indices(fit.beams.dof)])


def position_derivatives(fit: LineFit, body: BodyChannels, point: str) -> ComplexArray:
    """Return d q / d(position of one point), (3, freq, m), per m along the footplate axes."""
    mine = np.array([name == point for name in body.points])
    changes = [shifted_point_rows(body.directions[mine], axis) for axis in np.eye(3)]
    return fit_derivatives(fit, np.stack(changes)[:, :, dof_indices(fit.beams.dof)], mine)


def fit_derivatives(fit: LineFit, changes: Array, channels: Channels = _WHOLE) -> ComplexArray:
    """Return the derivatives (n, freq, m) of the weighted fit by parameters that move its rows.

    Parameters
    ----------
    changes : ndarray, (n, channel, m)
        Derivatives of the observation rows of ``channels``.
    channels : slice or mask
        The rows that move.

    Notes
    -----
    From the normal equations A^T W (y - A q) = 0:
    dq = (A^T W A)^-1 (dA^T W r - A^T W dA q), with fixed weights W.
    """
    common = fit.common if fit.complete and fit.robust == "none" else None
    if common is not None:
        return _derivatives_of_all(fit, changes, channels, common)
    beams = fit.beams
    count, rows, size = changes.shape
    q = np.where(np.isfinite(fit.q.real), fit.q, 0.0).T
    basis = beams.basis[channels]
    flat = np.ascontiguousarray(changes.transpose(0, 2, 1).reshape(count * size, rows))
    pairs = (basis[:, None, :, None] * changes.transpose(1, 0, 2)[:, :, None, :]).reshape(rows, -1).T
    out = np.empty((count, q.shape[1], size), dtype=complex)
    for part, residual, _sd, weights in fit.blocks(channels):
        score = (flat @ (weights * residual).view(float)).view(complex).reshape(count, size, -1)
        score = np.tensordot(beams.to_dof.T, score, axes=(1, 1))
        each = (pairs @ weights).reshape(count, size, size, -1)
        known = np.einsum("nabf,bf->naf", each, q[:, part])
        solved = symmetric_batches.times(fit.solution.inverse[:, part], score - known.transpose(1, 0, 2))
        out[:, part] = np.tensordot(beams.to_dof, solved, axes=1).transpose(1, 2, 0)
    out[:, ~np.isfinite(fit.q[:, 0].real)] = np.nan
    return out


def _derivatives_of_all(
    fit: LineFit, changes: Array, channels: Channels, common: tuple[Array, Array]
) -> ComplexArray:
    """Return the derivatives where all lines share their weights but for a factor, which cancels.

    They are then one matrix times the readings less one times the motion.
    """
    beams, z = fit.beams, fit.solution.z
    count, _, size = changes.shape
    basis, share = beams.basis[channels], np.broadcast_to(common[0], len(beams.basis))[channels]
    weight = 0.5 / share**2
    inverse = symmetric_batches.unpack(fit.solution.inverse[:, :1], size)[0] / common[1][0] ** 2
    solve = beams.to_dof @ inverse
    forward = (solve @ beams.to_dof.T) @ (changes.transpose(0, 2, 1) * weight)
    back = forward @ basis + solve @ ((basis.T * weight) @ changes @ beams.to_dof)
    forward, back = forward.reshape(count * size, -1), back.reshape(count * size, size)
    out = np.empty((count, z.shape[1], size), dtype=complex)
    readings = fit.value[channels]
    readings = readings if readings.strides[1] == readings.itemsize else np.ascontiguousarray(readings)
    value, motion = readings.view(float), np.ascontiguousarray(z).view(float)
    for part in blocks(*fit.value.shape):
        lines = slice(2 * part.start, 2 * part.stop)
        change = forward @ value[:, lines] - back @ motion[:, lines]
        out[:, part] = change.view(complex).reshape(count, size, -1).transpose(0, 2, 1)
    out[:, ~np.isfinite(fit.q[:, 0].real)] = np.nan
    return out


def position_parameters(bodies: Sequence[BodyChannels]) -> list[tuple[int, str, float]]:
    """Return (body, point, sd in m) for every point with a stated position error."""
    spreads: dict[tuple[int, str], float] = {}
    for number, body in enumerate(bodies):
        for point, sd in zip(body.points, body.position_sd_mm, strict=True):
            if np.isfinite(sd) and sd > 0.0:
                spreads[(number, point)] = float(sd) * 1e-3
    return [(number, point, sd) for (number, point), sd in spreads.items()]


@dataclass(frozen=True)
class Positions:
    """Errors of point positions as shared parameters.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``position.<body>.<point>.<axis>``, or ``position.<body>.pattern_<n>`` for many points.
    variances : ndarray, (p,)
        m^2 for single points; 1 for patterns.
    derivatives : ndarray, (p, run, body, freq, m), complex
    """

    names: tuple[str, ...]
    variances: Array
    derivatives: ComplexArray


def position_errors(fits: Mapping[tuple[int, int], LineFit], bodies: Sequence[BodyChannels]) -> Positions:
    """Return the stated errors of all point positions as shared parameters.

    Points by name while their derivatives take at most 64 MiB. Beyond, the errors of a body are rewritten as
    few uncorrelated patterns of unit variance (displacements of all its points together) that move the motion
    as the single errors do: the covariance of q, between any lines and runs too, is theirs to within 5e-3 of
    the largest variance of each degree of freedom.

    Parameters
    ----------
    fits : mapping of (run, body) to LineFit
    bodies : sequence of BodyChannels
        Positions in the footplate frame, as fitted.
    """
    parameters = position_parameters(bodies)
    runs = 1 + max(run for run, _ in fits)
    lines, size = next(iter(fits.values())).q.shape
    shape = (runs, len(bodies), lines, size)
    if 3 * len(parameters) * int(np.prod(shape)) * 16 <= _NAMED_BYTES:
        names = [f"position.{bodies[b].body}.{point}.{axis}" for b, point, _ in parameters for axis in "xyz"]
        derivatives = np.zeros((len(names), *shape), dtype=complex)
        for place, (owner, point, _) in enumerate(parameters):
            for run in range(runs):
                of_point = position_derivatives(fits[run, owner], bodies[owner], point)
                derivatives[3 * place : 3 * place + 3, run, owner] = of_point
        return Positions(tuple(names), np.repeat([sd**2 for _, _, sd in parameters], 3), derivatives)
    shared: list[tuple[str, int, Array]] = []
    for owner, body in enumerate(bodies):
        own = {point: sd for number, point, sd in parameters if number == owner}
        if own:
            shifts = position_patterns([fits[run, owner] for run in range(runs)], body, own)
            shared += [
                (f"position.{body.body}.pattern_{k + 1}", owner, shift) for k, shift in enumerate(shifts)
            ]
    derivatives = np.zeros((len(shared), *shape), dtype=complex)
    for owner, body in enumerate(bodies):
        mine = [place for place, (_, number, _) in enumerate(shared) if number == owner]
        if mine:
            changes = np.stack([shifted_point_rows(body.directions, shared[place][2]) for place in mine])
            for run in range(runs):
                fit = fits[run, owner]
                derivatives[mine, run, owner] = fit_derivatives(
                    fit, changes[:, :, dof_indices(fit.beams.dof)]
                )
    return Positions(tuple(name for name, _, _ in shared), np.ones(len(shared)), derivatives)


def position_patterns(fits: Sequence[LineFit], body: BodyChannels, sd_m: Mapping[str, float]) -> list[Array]:
    """Return displacements (channel, 3), m, of all points that carry the effect of independent errors.

    Notes
    -----
    The left singular vectors of sd * d q / d position at lines spread over the measurement, each degree of
    freedom scaled to its own size; the last 1e-3 of the variance is left out and the others are raised by
    it. Where the weights keep their ratios, up to 3 m patterns (each rotation mistaken for each fitted
    motion) hold all but the part of the noise.
    """
    owner = np.array([list(sd_m).index(name) if name in sd_m else -1 for name in body.points])
    chosen = owner >= 0
    lines = len(fits[0].q)
    most = int(np.clip(_SAMPLE // (18 * len(owner)), 8, 64))
    pick = np.unique(np.linspace(0, lines - 1, min(lines, most)).round().astype(int))
    columns = [_sample(fit, body, owner, len(sd_m), pick) for fit in fits]
    table = np.concatenate(columns, axis=2)
    table = table / np.maximum(np.sqrt(np.mean(np.abs(table) ** 2, axis=(0, 2), keepdims=True)), 1e-300)
    flat = (np.repeat(list(sd_m.values()), 3)[:, None, None] * table).reshape(3 * len(sd_m), -1)
    energy, vectors = np.linalg.eigh(flat.real @ flat.real.T + flat.imag @ flat.imag.T)
    energy = np.maximum(energy[::-1], 0.0)
    unexplained = 1.0 - np.cumsum(energy) / max(float(np.sum(energy)), 1e-300)
    count = min(int(np.sum(unexplained > _LEFT_OUT)) + 1, _PATTERNS, len(energy))
    size = 1.0 / np.sqrt(1.0 - min(max(float(unexplained[count - 1]), 0.0), 0.5))
    shifts = []
    for vector in vectors.T[::-1][:count]:
        moved = size * np.repeat(list(sd_m.values()), 3) * vector
        shifts.append(np.where(chosen[:, None], moved.reshape(-1, 3)[owner], 0.0))
    return shifts


def _sample(
    fit: LineFit, body: BodyChannels, owner: NDArray[np.intp], points: int, pick: NDArray[np.intp]
) -> ComplexArray:
    """Return d q / d position at some lines, (3 point, m, n)."""
    beams, places = fit.beams, dof_indices(fit.beams.dof)
    good = np.isfinite(fit.q[pick, 0].real)
    pick = pick[good]
    residual, _sd, weights = fit.at(pick)
    changes = np.stack([shifted_point_rows(body.directions, axis)[:, places] for axis in np.eye(3)])
    q = fit.q[pick].T
    summed = np.zeros((3, points, len(places), len(pick)), dtype=complex)
    chosen = owner >= 0
    for axis in range(3):
        in_basis = changes[axis] @ beams.to_dof
        each = in_basis[:, :, None] * (weights * residual)[:, None]
        each -= beams.basis[:, :, None] * (weights * (changes[axis] @ q))[:, None]
        np.add.at(summed[axis], owner[chosen], each[chosen])
    inverse = fit.solution.inverse[:, pick]
    solved = symmetric_batches.times(inverse, summed.transpose(2, 0, 1, 3))
    out = np.tensordot(beams.to_dof, solved, axes=1)
    return np.asarray(out.transpose(2, 1, 0, 3).reshape(3 * points, len(places), len(pick)))

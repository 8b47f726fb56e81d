"""Errors that all lines of a motion share, with their covariance and the derivatives of the motion.

Shapes: p parameters, c channels, m degrees of freedom, L lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.rigid_fit import LineFit
from kinematics.joint.expected import ChannelError
from kinematics.joint.tangents import DELAY, GAIN, GAIN_DRIFT, PHASE, PHASE_DRIFT, Geometry
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place.channel_errors import body_starts, position_errors
from kinematics.place.lasers import LaserAgreement
from kinematics.place.placement import Placement, block_diagonal
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.rigid_motion import SharedErrors
from stapeskit.spatial import cross, dof_indices, point_rows

Fits = Mapping[tuple[int, int], LineFit]
"""By (run, body)."""

_MOST_BYTES = 2**26  # of derivatives by name; beyond, positions are patterns
_MOST_OPERATIONS = 2e9  # of maps of each line; beyond, those of some lines stand for all
_ALIKE = 1e-2  # share of the effect of an error by which its maps may differ between runs
_FEW_LINES = 100  # for which one product a line takes less memory
_LEFT_OUT = 1e-4  # share of the variance that the patterns of positions leave out


@dataclass(frozen=True)
class Parameter:
    """An error that changes what the channels of a body read of a motion.

    Attributes
    ----------
    name : str
    rows : mapping of int to ndarray (c, 6), complex
        By body: d(reading) / d(parameter) per unit of each motion, in footplate axes.
    power : int
        Of i omega, by which it grows.
    drifts : bool
        Whether it grows from -1 at the first line to 1 at the last.
    """

    name: str
    rows: Mapping[int, ComplexArray | Array]
    power: int = 0
    drifts: bool = False


def shared_errors(
    placed: Measurement,
    fits: Fits,
    placement: Placement,
    lasers: LaserAgreement | None = None,
    more: Sequence[tuple[Sequence[Parameter], Array]] = (),
    positions: bool = True,
) -> SharedErrors | None:
    """Return the errors common to all lines, as named parameters with their effect on the motion.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame, as fitted.
    fits : mapping of (run, body) to LineFit
    placement : Placement
    lasers : LaserAgreement, optional
    more : sequence of (parameters, covariance)
        Further errors: of a calibration, of corrections.
    positions : bool
        Whether the stated errors of positions count; not where a calibration has estimated them.

    Notes
    -----
    A parameter e is what is to be added to the assumed value; q + e dq/de is then the motion. From the normal
    equations A^T W (y - A q) = 0 with fixed weights, dq/de = -(A^T W A)^-1 A^T W dA q, where residuals, which
    are noise, are left out.
    """
    blocks: list[tuple[Sequence[Parameter], Array]] = [
        (pose_parameters(placed, placement), placement.covariance)
    ]
    if positions:
        blocks.append(_positions(placed, fits))
    blocks += more
    if lasers is not None:
        blocks.append((effects(placed, lasers.estimate.errors), lasers.estimate.covariance))
    parameters = [parameter for block, _ in blocks for parameter in block]
    if not parameters:
        return None
    covariance = block_diagonal([spread for _, spread in blocks])
    names = tuple(parameter.name for parameter in parameters)
    if lasers is not None:
        _join_positions(covariance, names, lasers)
    runs, bodies = len(placed.runs), len(placed.bodies)
    lines, size = fits[0, 0].q.shape
    derivatives = np.zeros((len(names), runs, bodies, lines, size), dtype=complex)
    maps = np.zeros((len(names), bodies, 6, 6), dtype=complex)
    powers = np.array([parameter.power for parameter in parameters])
    omega = 2j * np.pi * placed.freq_hz
    tau = np.linspace(-1.0, 1.0, lines)
    drifting = np.array([parameter.drifts for parameter in parameters])
    for (run, body), fit in fits.items():
        own = [place for place, parameter in enumerate(parameters) if body in parameter.rows]
        rows = np.stack([parameters[place].rows[body] for place in own]) if own else np.zeros((0, 1, 6))
        moved, mean = sensitivity(fit, rows)
        moved *= omega[None, :, None] ** powers[own][:, None, None]
        moved[drifting[own]] *= tau[:, None]
        derivatives[own, run, body] = moved
        places = dof_indices(fit.beams.dof)
        _enter_map(maps[:, body], np.ix_(own, places, places), mean, first=run == 0)
    if drifting.any():
        return SharedErrors(names, covariance, derivatives)
    return SharedErrors(names, covariance, derivatives, maps, powers)


def _enter_map(maps: ComplexArray, at: tuple[NDArray[Any], ...], mean: ComplexArray, first: bool) -> None:
    """Enter the maps (p, m, m) of a run into those of a body; NaN where they differ from an earlier run's.

    The map of an error depends on the weights of the channels, which each excitation has of its own.
    """
    if first:
        maps[at] = mean
        return
    size = np.max(np.abs(mean), axis=(1, 2), keepdims=True)
    same = np.all(np.abs(maps[at] - mean) <= _ALIKE * size, axis=(1, 2), keepdims=True)
    maps[at] = np.where(same, mean, np.nan)


def sensitivity(fit: LineFit, rows: NDArray[Any]) -> tuple[ComplexArray, ComplexArray]:
    """Return the derivatives of a fit by parameters that change its rows, and the mean maps.

    Parameters
    ----------
    rows : ndarray, (p, c, 6)
        Changes of the observation rows.

    Returns
    -------
    derivatives : ndarray, (p, L, m), complex
    maps : ndarray, (p, m, m), complex
        Mean over lines of the map from the motion to its derivative.
    """
    beams = fit.beams
    size = len(beams.dof)
    inside = rows[:, :, dof_indices(beams.dof)] @ beams.to_dof
    q = np.where(np.isfinite(fit.q.real), fit.q, 0.0)
    z = q @ np.linalg.inv(beams.to_dof).T
    good = np.flatnonzero(fit.solution.good)
    cost = len(rows) * len(beams.basis) * size**2 * max(len(good), 1)
    if len(good) == 0 or len(rows) == 0:
        return np.zeros((len(rows), *fit.q.shape), dtype=complex), np.zeros(
            (len(rows), size, size), dtype=complex
        )
    if _alike(fit) or cost > _MOST_OPERATIONS:
        some = good[np.unique(np.linspace(0, len(good) - 1, 1 if _alike(fit) else 64).astype(int))]
        mean = _maps(fit, inside, some).mean(axis=0)
        derivatives = np.einsum("pij,lj->pli", mean, z) @ beams.to_dof.T
    else:
        derivatives = np.zeros((len(rows), *fit.q.shape), dtype=complex)
        mean = np.zeros((len(rows), size, size), dtype=complex)
        for part in np.array_split(good, max(1, len(good) * len(rows) * size**2 // 2_000_000)):
            own = _maps(fit, inside, part)
            mean += own.sum(axis=0) / len(good)
            derivatives[:, part] = np.einsum("lpij,lj->pli", own, z[part]) @ beams.to_dof.T
    derivatives[:, ~fit.solution.good] = np.nan
    return derivatives, beams.to_dof @ mean @ np.linalg.inv(beams.to_dof)


def _alike(fit: LineFit) -> bool:
    """Return whether all lines share their weights but for a factor."""
    if not fit.complete or fit.robust != "none":
        return False
    sd = fit.sd
    return not (sd.strides[0] and sd.strides[1]) or bool(
        np.all(np.abs(sd - sd[:, :1] / sd[0, 0] * sd[0]) <= 1e-9 * sd)
    )


def _maps(fit: LineFit, inside: NDArray[Any], lines: NDArray[Any]) -> ComplexArray:
    """Return the maps in the basis of the fit, (n, p, m, m)."""
    basis = fit.beams.basis
    sd = fit.sd[:, lines]
    used = np.isfinite(fit.value[:, lines]) & np.isfinite(sd) & (sd > 0.0)
    weight = np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)
    weight /= weight.max(axis=0)
    size = basis.shape[1]
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    gram = (weight.T @ pairs).reshape(-1, size, size)
    if len(lines) < _FEW_LINES:
        right = np.stack([(basis * own[:, None]).T @ inside for own in weight.T])
    else:
        turned = basis[:, None, :, None] * inside.transpose(1, 0, 2)[:, :, None, :]
        right = (weight.T @ turned.reshape(len(basis), -1)).reshape(len(lines), len(inside), size, size)
    return np.asarray(-np.linalg.solve(gram[:, None], right), dtype=complex)


def pose_parameters(placed: Measurement, placement: Placement) -> list[Parameter]:
    """Return the errors of registration and frames."""
    rows: dict[int, Array] = {}
    for number, body in enumerate(placed.bodies if placement.names else ()):
        moved, turned = placement.changes(body.arms_m, body.directions)
        first = cross(moved, np.broadcast_to(body.directions, moved.shape)) + cross(
            np.broadcast_to(body.arms_m, turned.shape), turned
        )
        rows[number] = np.concatenate([turned, first], axis=2)
    return [
        Parameter(name, {number: change[place] for number, change in rows.items()})
        for place, name in enumerate(placement.names)
    ]


def tangent_rows(body: BodyChannels, own: Sequence[int], tangent: int) -> ComplexArray | Array:
    """Return d(reading) / d(parameter), (c, 6), of a tangent of channels; a delay still times i omega."""
    rows = point_rows(body.arms_m, body.directions)
    factor = {GAIN: 1.0, PHASE: 1j, DELAY: -1.0, GAIN_DRIFT: 1.0, PHASE_DRIFT: 1j}
    geometry = Geometry(body.arms_m, body.directions, np.ones((1, len(rows)), dtype=complex))
    change = factor[tangent] * rows if tangent in factor else geometry.row_tangents(tangent)
    mask = np.zeros((len(rows), 1))
    mask[list(own)] = 1.0
    return np.asarray(mask * change)


def effects(placed: Measurement, errors: Sequence[ChannelError], prefix: str = "") -> list[Parameter]:
    """Return what errors of channels change, under their names with a prefix."""
    starts = body_starts(placed)
    found = []
    for error in errors:
        rows = {}
        for number, body in enumerate(placed.bodies):
            own = [channel - starts[number] for channel in error.channels]
            inside = [channel for channel in own if 0 <= channel < len(body.points)]
            if inside:
                rows[number] = tangent_rows(body, inside, error.tangent)
        drifts = error.tangent in (GAIN_DRIFT, PHASE_DRIFT)
        found.append(Parameter(prefix + error.name, rows, int(error.tangent == DELAY), drifts))
    return found


def _positions(placed: Measurement, fits: Fits) -> tuple[list[Parameter], Array]:
    """Return the stated errors of positions: of each point, or of few patterns of many points.

    Notes
    -----
    The motion that errors of positions make is a map of the true one, whose 36 entries are a sum over points:
    the eigenvectors of their covariance are patterns of all points that have the same effect.
    """
    errors = position_errors(placed)
    parameters = effects(placed, errors)
    lines, size = fits[0, 0].q.shape
    spread = np.array([error.sd for error in errors])
    if 16 * len(parameters) * len(placed.runs) * len(placed.bodies) * lines * size <= _MOST_BYTES:
        return parameters, np.diag(spread**2)
    patterns: list[Parameter] = []
    for number, body in enumerate(placed.bodies):
        own = [
            one.rows[number] * sd for one, sd in zip(parameters, spread, strict=True) if number in one.rows
        ]
        if not own:
            continue
        fit, rows = fits[0, number], np.stack(own)
        places = dof_indices(fit.beams.dof)
        lever = np.where(np.arange(6) < 3, 1.0, fit.beams.lever_m)[places]
        good = np.flatnonzero(fit.solution.good)[:1]
        basis = _maps(fit, rows[:, :, places] @ fit.beams.to_dof, good)[0]
        maps = fit.beams.to_dof @ basis @ np.linalg.inv(fit.beams.to_dof) * lever[:, None] / lever
        left, strength, _ = np.linalg.svd(maps.real.reshape(len(maps), -1), full_matrices=False)
        energy = np.cumsum(strength**2) / max(float(np.sum(strength**2)), 1e-300)
        for k in range(int(np.searchsorted(energy, 1.0 - _LEFT_OUT)) + 1):
            pattern = np.tensordot(left[:, k], rows, axes=1)
            patterns.append(Parameter(f"position.{body.body}.pattern_{k + 1}", {number: pattern}))
    return patterns, np.eye(len(patterns))


def _join_positions(covariance: Array, names: Sequence[str], lasers: LaserAgreement) -> None:
    """Add the covariance between the remaining laser errors and the errors of positions."""
    at = {name: place for place, name in enumerate(names)}
    rows = [at[name] for name in lasers.estimate.names]
    for name, column in lasers.across.items():
        if name in at:
            covariance[rows, at[name]] = covariance[at[name], rows] = column

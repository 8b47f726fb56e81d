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
from kinematics.joint.expected import ChannelError, body_starts
from kinematics.joint.tangents import DELAY, GAIN, GAIN_DRIFT, PHASE, PHASE_DRIFT, SHIFT, Geometry
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place.errors import ErrorEstimate
from kinematics.place.placement import Placement, block_diagonal
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.rigid_motion import SharedErrors
from stapeskit.spatial import cross, dof_indices

Fits = Mapping[tuple[int, int], LineFit]
"""By (run, body)."""

_MOST_BYTES = 2**26  # of derivatives by name; beyond, positions are patterns
_MOST_OPERATIONS = 5e8  # of maps of each line, half a second; beyond, the mean of some stands for all
_SOME_LINES = 64  # maps change slowly over lines: the mean of so many scatters by an eighth of their spread
_ALIKE = 1e-2  # share of the effect of an error by which its maps may differ between runs
_FEW_LINES = 100  # for which one product a line takes less memory
_FACTORS = {GAIN: 1.0, PHASE: 1j, DELAY: -1.0, GAIN_DRIFT: 1.0, PHASE_DRIFT: 1j}  # by which rows change
_LEFT_OUT = 1e-4  # share of the variance that the patterns of positions leave out


@dataclass(frozen=True)
class Parameter:
    """An error that changes what the channels of a body read of a motion.

    Attributes
    ----------
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
    estimate: ErrorEstimate | None = None,
    corrections: Sequence[tuple[Sequence[ChannelError], Array]] = (),
) -> SharedErrors | None:
    """Return the errors common to all lines, as named parameters with their effect on the motion.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame, as fitted.
    corrections : sequence of (errors, covariance)
        What was corrected by estimates of its own.

    Notes
    -----
    A parameter e is what is to be added to the assumed value; q + e dq/de is then the motion. From the normal
    equations A^T W (y - A q) = 0 with fixed weights, dq/de = -(A^T W A)^-1 A^T W dA q, where residuals, which
    are noise, are left out.
    """
    blocks = [(_pose_parameters(placed, placement), placement.covariance)]
    if estimate is not None:
        prefix = "calibration." if estimate.calibrated else ""
        named = effects(placed, estimate.errors, prefix), estimate.covariance
        size = 16 * len(named[0]) * len(fits) * fits[0, 0].q.size
        blocks.append(_patterns(fits, estimate.errors, *named) if size > _MOST_BYTES else named)
    blocks += [(effects(placed, errors, "correction."), spread) for errors, spread in corrections]
    parameters = [parameter for block, _ in blocks for parameter in block]
    if not parameters:
        return None
    names = tuple(parameter.name for parameter in parameters)
    covariance = block_diagonal([spread for block, spread in blocks if block])
    derivatives, maps = _derivatives(placed, fits, parameters)
    if any(parameter.drifts for parameter in parameters):
        return SharedErrors(names, covariance, derivatives)
    powers = np.array([parameter.power for parameter in parameters])
    return SharedErrors(names, covariance, derivatives, maps, powers)


def correction_of(placed: Measurement, fits: Fits, estimate: ErrorEstimate) -> ComplexArray:
    """Return what estimated errors add to the motion, (run, body, L, m), complex."""
    every = effects(placed, estimate.errors)
    sums = []
    for power in sorted({parameter.power for parameter in every}):
        own = [k for k, parameter in enumerate(every) if parameter.power == power]
        rows = _combined([every[k] for k in own], estimate.values[own])
        sums.append(Parameter(f"power {power}", rows, power))
    return np.asarray(_derivatives(placed, fits, sums)[0].sum(axis=0))


def _derivatives(
    placed: Measurement, fits: Fits, parameters: Sequence[Parameter]
) -> tuple[ComplexArray, ComplexArray]:
    """Return d q / d parameter (p, run, body, L, m), and their maps (p, body, 6, 6).

    Maps are NaN where they differ between runs: they depend on the weights of the channels, which each
    excitation has of its own.
    """
    runs, bodies = len(placed.runs), len(placed.bodies)
    lines, size = fits[0, 0].q.shape
    derivatives = np.zeros((len(parameters), runs, bodies, lines, size), dtype=complex)
    maps = np.zeros((len(parameters), bodies, 6, 6), dtype=complex)
    powers = np.array([parameter.power for parameter in parameters])
    drifting = np.array([parameter.drifts for parameter in parameters])
    omega = 2j * np.pi * placed.freq_hz
    for (run, body), fit in fits.items():
        own = [place for place, parameter in enumerate(parameters) if body in parameter.rows]
        rows = np.stack([parameters[place].rows[body] for place in own]) if own else np.zeros((0, 1, 6))
        moved, mean = sensitivity(fit, rows)
        moved *= omega[None, :, None] ** powers[own][:, None, None]
        moved[drifting[own]] *= np.linspace(-1.0, 1.0, lines)[:, None]
        derivatives[own, run, body] = moved
        places = dof_indices(fit.beams.dof)
        at = np.ix_(own, [body], places, places)
        difference = np.abs(maps[at][:, 0] - mean).max(axis=(1, 2))
        same = difference <= _ALIKE * np.abs(mean).max(axis=(1, 2))
        maps[at] = np.where(same[:, None, None] | (run == 0), mean, np.nan)[:, None]
    return derivatives, maps


def sensitivity(fit: LineFit, rows: NDArray[Any]) -> tuple[ComplexArray, ComplexArray]:
    """Return the derivatives of a fit by parameters that change its rows, and the mean maps.

    ``rows`` (p, c, 6) are the changes of the observation rows. Returns the derivatives (p, L, m), complex,
    and the mean over lines of the maps from the motion to them, (p, m, m).
    """
    beams = fit.beams
    size = len(beams.dof)
    inside = rows[:, :, dof_indices(beams.dof)] @ beams.to_dof
    to_basis = np.linalg.inv(beams.to_dof)
    z = np.where(np.isfinite(fit.q.real), fit.q, 0.0) @ to_basis.T
    good = np.flatnonzero(fit.solution.good)
    derivatives = np.zeros((len(rows), *fit.q.shape), dtype=complex)
    mean = np.zeros((len(rows), size, size), dtype=complex)
    if len(good) and len(rows) * len(beams.basis) * size**2 * len(good) > _MOST_OPERATIONS:
        some = good[np.unique(np.linspace(0, len(good) - 1, _SOME_LINES).astype(int))]
        mean = _maps(fit, inside, some).mean(axis=0)
        derivatives = np.einsum("pij,lj->pli", mean, z) @ beams.to_dof.T
    elif len(good):
        for part in np.array_split(good, max(1, len(good) * len(rows) * size**2 // 2_000_000)):
            own = _maps(fit, inside, part)
            mean += own.sum(axis=0) / len(good)
            derivatives[:, part] = np.einsum("lpij,lj->pli", own, z[part]) @ beams.to_dof.T
    derivatives[:, ~fit.solution.good] = np.nan
    return derivatives, beams.to_dof @ mean @ to_basis


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


def _pose_parameters(placed: Measurement, placement: Placement) -> list[Parameter]:
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
    count = len(body.points)
    geometry = Geometry(body.arms_m, body.directions, np.ones((1, count), dtype=complex))
    change = geometry.rows() * _FACTORS[tangent] if tangent in _FACTORS else geometry.row_tangents(tangent)
    return np.asarray(np.isin(np.arange(count), own)[:, None] * change)


def effects(placed: Measurement, errors: Sequence[ChannelError], prefix: str = "") -> list[Parameter]:
    """Return what errors of channels change, under their names with a prefix."""
    starts = body_starts(placed.bodies)
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


def _combined(parameters: Sequence[Parameter], weights: Array) -> dict[int, NDArray[Any]]:
    """Return the weighted sum of the rows of parameters, by body."""
    sums: dict[int, Any] = {}
    for parameter, weight in zip(parameters, weights.tolist(), strict=True):
        for body, rows in parameter.rows.items():
            sums[body] = sums.get(body, 0.0) + weight * rows
    return sums


def _patterns(
    fits: Fits, errors: Sequence[ChannelError], parameters: Sequence[Parameter], covariance: Array
) -> tuple[list[Parameter], Array]:
    """Replace the positions of many points by few patterns of them.

    Notes
    -----
    The motion that errors of positions make is a map of the true one, whose 36 entries a body are sums over
    points: the principal components of the maps, the errors made independent by the root of their
    covariance, are patterns of all points that have the same effect.
    """
    shifts = [k for k, error in enumerate(errors) if error.tangent in SHIFT]
    if not shifts or not any(np.any(fit.solution.good) for fit in fits.values()):
        return list(parameters), covariance
    others = [k for k in range(len(errors)) if k not in shifts]
    maps: list[Array] = []
    seen = set[int]()
    for (_, body), fit in fits.items():
        if body not in seen and np.any(fit.solution.good):
            seen.add(body)
            places = dof_indices(fit.beams.dof)
            lever = np.where(np.arange(6) < 3, 1.0, fit.beams.lever_m)[places]
            none = np.zeros((len(fit.beams.basis), 6))
            rows = np.stack([parameters[k].rows.get(body, none) for k in shifts])[:, :, places]
            own = _maps(fit, rows @ fit.beams.to_dof, np.flatnonzero(fit.solution.good)[:1])[0]
            own = fit.beams.to_dof @ own @ np.linalg.inv(fit.beams.to_dof) * lever[:, None] / lever
            maps.append(own.real.reshape(len(shifts), -1))
    root = np.linalg.cholesky(covariance[np.ix_(shifts, shifts)])
    left, strength, _ = np.linalg.svd(root.T @ np.hstack(maps), full_matrices=False)
    energy = np.cumsum(strength**2) / max(float(np.sum(strength**2)), 1e-300)
    left = left[:, : int(np.searchsorted(energy, 1.0 - _LEFT_OUT)) + 1]
    weights = root @ left
    found = [parameters[k] for k in others]
    for k, column in enumerate(weights.T, 1):
        prefix = parameters[shifts[0]].name.partition("position.")[0]
        rows_of = _combined([parameters[place] for place in shifts], column)
        found.append(Parameter(f"{prefix}position.pattern_{k}", rows_of))
    across = left.T @ np.linalg.solve(root, covariance[np.ix_(shifts, others)])
    own_spread = covariance[np.ix_(others, others)]
    return found, np.block([[own_spread, across.T], [across, np.eye(left.shape[1])]])

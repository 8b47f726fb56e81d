"""Noise of a reference in the motion, when points were recorded one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion

# Share of a channel's variance that is its own at the least.
_LEAST_OWN = 1e-4
# The shared error multiplies the motion that is sought: rounds in which both are found in turn.
_ROUNDS = 2
# Share of the trace that keeps lines solvable whose channels determine no motion.
_RIDGE = 1e-12


def bound_record_noise(
    measured: Measurement,
    run: int,
    body: BodyChannels,
    basis: Array,
    *,
    without: Sequence[int] = (),
    left: Sequence[int] = (),
) -> tuple[BodyChannels, BodyChannels] | None:
    """Return a body with upper bounds of the noise that records share, and one for the search for faults.

    Parameters
    ----------
    measured : Measurement
    run : int
    body : BodyChannels
    basis : ndarray, (channel, m)
        Columns that span the readings of all rigid motions.
    without : sequence of int
        Channels of which the second body's motion holds nothing.
    left : sequence of int
        Those of them that will be left out of its fit.

    Returns
    -------
    tuple of two BodyChannels, or None
        None when the body has no such noise.

    Notes
    -----
    A search for faults that takes the noise of beams for independent would find the beams of one point at
    fault together. As matrices v v^H <= diag(|v_i| sum |v_j|): own noise and that diagonal bound the noise of
    any combination of beams. Weights made of it are not those of the noise itself, though, and what a fit
    with other weights leaves is correlated with its motion: directions and positions that act on motions
    which are mostly noise would be blamed. What is left is not correlated with the estimate of least
    variance (Gauss and Markov; Rao 1973, Linear Statistical Inference, sec. 4a): the motion of the second
    body is moved to that, and what is left stays as it is. That estimate follows a faulty channel further
    than a usual one: the second body tells whether anything is at fault, the first tells what.
    """
    if body.sd is None or body.relative:
        return None
    shared = []
    for record in measured.record_noise:
        channels = [k for k, point in enumerate(body.points) if (body.body, point) in record.points]
        if record.run == run and len(channels) > 1:
            shared.append((record, channels))
    if not shared:
        return None
    value, wide = body.displacement[run], body.sd[run].copy()
    own = body.sd[run] ** 2
    records = []
    for record, channels in shared:
        size = np.abs(value[channels])
        others = np.nansum(size, axis=0) - size
        wide[channels] = np.sqrt(wide[channels] ** 2 + record.sd**2 * size * others)
        own[channels] = np.maximum(own[channels] - (record.sd * size) ** 2, _LEAST_OWN * own[channels])
        records.append((np.array(channels), 2.0 * record.sd**2))
    own[list(without)] = np.inf
    bound = wide**2
    bound[list(left)] = np.inf
    usual = _least_squares(basis, value, bound, [], value)
    best = usual
    for _ in range(_ROUNDS):
        best = _least_squares(basis, value, own, records, basis @ best)
    sd, moved = body.sd.copy(), body.displacement.copy()
    sd[run], moved[run] = wide, value - basis @ (usual - best)
    return replace(body, sd=sd), replace(body, sd=sd, displacement=moved)


def _least_squares(
    basis: Array,
    value: ComplexArray,
    variance: Array,
    records: Sequence[tuple[NDArray[np.intp], Array]],
    model: ComplexArray,
) -> ComplexArray:
    """Return the coefficients (m, freq) of least variance.

    Parameters
    ----------
    basis : ndarray, (channel, m)
    value, model : ndarray, (channel, freq), complex
    variance : ndarray, (channel, freq)
        Of the real part of each channel's own noise.
    records : sequence of (ndarray (n,), ndarray (freq,))
        Channels that share an error, and the mean square of that, which multiplies ``model``.

    Notes
    -----
    The inverse of D + s v v^H is D^-1 - D^-1 v v^H D^-1 / (1 / s + v^H D^-1 v) (Sherman and Morrison 1950).
    """
    used = np.isfinite(value.real) & np.isfinite(variance) & (variance > 0.0)
    weight = np.where(used, 0.5 / np.where(used, variance, 1.0), 0.0)
    held = weight * np.where(used, value, 0.0)
    gram = np.einsum("ci,cf,cj->fij", basis, weight, basis, optimize=True).astype(complex)
    right = held.T @ basis
    for channels, square in records:
        along = weight[channels] * model[channels]
        size = np.sum(weight[channels] * np.abs(model[channels]) ** 2, axis=0)
        share = square / (1.0 + square * size)
        seen = along.T @ basis[channels]
        gram -= share[:, None, None] * seen[:, :, None] * seen[:, None, :].conj()
        right -= (share * np.sum(model[channels].conj() * held[channels], axis=0))[:, None] * seen
    scale = np.maximum(np.trace(gram, axis1=1, axis2=2).real, np.finfo(float).tiny)
    gram += _RIDGE * scale[:, None, None] * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(gram, right[:, :, None])[:, :, 0].T)


def holds_record_noise(measured: Measurement, body: BodyChannels) -> bool:
    """Return whether beams of a point of a body share the noise of the reference of a record."""
    if not measured.record_noise:
        return False
    points = {(body.body, point) for point, number in Counter(body.points).items() if number > 1}
    return any(points.intersection(record.points) for record in measured.record_noise)


def with_record_noise(
    motion: RigidMotion, measured: Measurement, fits: Mapping[tuple[int, int], LineFit]
) -> RigidMotion:
    """Return the motion with the covariance of channels that have a record of the reference in common.

    Parameters
    ----------
    motion : RigidMotion
        Absolute, its covariance from the sd of the channels as if they were independent.
    measured : Measurement
        Its ``record_noise``; the sd of the channels hold the same noise.
    fits : mapping of (run, body) to LineFit

    Notes
    -----
    The motion is q = G v with G = (C / 2) B^T W of the fit, C its covariance, B the beams and W one over the
    squared sd. An error e with E|e|^2 = 2 s^2 that multiplies the readings v of some channels moves it by
    G v e: it adds 2 s^2 (g g^H - sum |v_i|^2 G_i G_i^T), g = sum G_i v_i, to a covariance that holds the
    second sum already.
    """
    if not measured.record_noise:
        return motion
    covariance = motion.covariance.copy()
    for record in measured.record_noise:
        for number, body in enumerate(measured.bodies):
            channels = [k for k, point in enumerate(body.points) if (body.body, point) in record.points]
            if len(channels) < 2 or body.sd is None or body.relative:
                continue
            fit = fits[record.run, number]
            value, sd = body.displacement[record.run, channels], body.sd[record.run, channels]
            used = np.isfinite(value.real) & np.isfinite(sd) & (sd > 0.0)
            weight = np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)
            held = np.where(used, value, 0.0)
            rows = fit.beams.rows[channels]
            half = 0.5 * fit.covariance.real
            gain = np.einsum("fij,cj,cf->fic", half, rows, weight, optimize=True)
            alone = gain * np.abs(held.T)[:, None, :]
            together = np.einsum("fic,cf->fi", gain, held)
            added = together[:, :, None] * together[:, None, :].conj() - alone @ alone.transpose(0, 2, 1)
            covariance[record.run, number] += 2.0 * (record.sd**2)[:, None, None] * added
    return replace(motion, covariance=covariance)

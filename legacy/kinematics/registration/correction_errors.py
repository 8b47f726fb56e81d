"""The uncertainty of corrected faults, as errors that all lines of the motion share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from legacy.kinematics.faults.adaptation import Correction
from legacy.kinematics.faults.catalogue import Fault
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.registration.laser_errors import channel_parts
from legacy.kinematics.registration.shared_errors import fit_derivatives
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion, SharedErrors
from legacy.stapeskit.spatial import dof_indices, point_rows

Key = tuple[int, int]
# Step of the numerical derivatives of the geometry, in units of what is common for the kind of fault.
_STEP = 1e-5


def with_corrections(
    motion: RigidMotion, placed: Measurement, fits: Mapping[Key, LineFit], corrections: Sequence[Correction]
) -> RigidMotion:
    """Return a motion whose shared errors hold those of the estimates that it was corrected by.

    Parameters
    ----------
    placed : Measurement
        As fitted.
    fits : mapping of (run, body) to LineFit

    Notes
    -----
    The covariance of the motion for given parameters and that of the parameters, both from the same data,
    add up to that of their joint least-squares estimate: var q = var(q | p) + dq/dp var(p) (dq/dp)^T.
    """
    sized = [correction for correction in corrections if len(correction.parameters)]
    if not sized:
        return motion
    shape = (len(motion.runs), len(motion.bodies), *fits[0, 0].q.shape)
    old = motion.shared or SharedErrors((), np.zeros((0, 0)), np.zeros((0, *shape), dtype=complex))
    names, slopes = list(old.names), [old.derivatives]
    count = len(names) + sum(len(correction.parameters) for correction in sized)
    covariance = np.zeros((count, count))
    covariance[: len(names), : len(names)] = old.covariance
    for correction in sized:
        own = slice(len(names), len(names) + len(correction.parameters))
        covariance[own, own] = correction.covariance
        points = "+".join(
            dict.fromkeys(placed.bodies[correction.body].points[c] for c in correction.channels)
        )
        place = f"{motion.bodies[correction.body]}.{points}.{correction.finding.kind}"
        names += [f"correction.{place}.{k + 1}" for k in range(len(correction.parameters))]
        slopes.append(_derivatives(correction, fits, shape))
    return replace(motion, shared=SharedErrors(tuple(names), covariance, np.concatenate(slopes)))


def _derivatives(correction: Correction, fits: Mapping[Key, LineFit], shape: tuple[int, ...]) -> ComplexArray:
    """Return d q / d parameter, (p, run, body, freq, m)."""
    derivatives = np.zeros((len(correction.parameters), *shape), dtype=complex)
    mine = np.zeros(len(fits[correction.run, correction.body].beams.rows), dtype=bool)
    mine[correction.channels] = True
    if len(correction.factor):
        part = channel_parts(fits[correction.run, correction.body], mine[None])[0]
        derivatives[:, correction.run, correction.body] = -part * correction.factor[1:, :, None]
    elif correction.fault is not None and correction.before is not None:
        for run in range(shape[0]):
            fit = fits[run, correction.body]
            rows = _row_changes(correction, correction.fault, correction.before, fit.beams.lever_m)[:, mine]
            derivatives[:, run, correction.body] = fit_derivatives(
                fit, rows[:, :, dof_indices(fit.beams.dof)], mine
            )
    return derivatives


def _row_changes(correction: Correction, fault: Fault, before: BodyChannels, lever_m: float) -> Array:
    """Return the derivatives (p, channel, 6) of the observation rows at the estimate."""

    def rows(p: Array) -> Array:
        return point_rows(*fault.geometry(before.positions_mm * 1e-3, before.directions, p))

    steps = np.diag(_STEP * fault.scale(lever_m))
    p = correction.parameters
    return np.stack([(rows(p + step) - rows(p - step)) / (2.0 * np.sum(step)) for step in steps])

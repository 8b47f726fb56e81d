"""The uncertainty of corrected faults, as errors that all lines of the motion share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.adaptation import Correction
from kinematics.faults.catalogue import Fault
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import Measurement
from kinematics.registration.lasers import channel_part
from kinematics.registration.shared_errors import fit_derivatives
from stapeskit.records.motion import RigidMotion, SharedErrors
from stapeskit.spatial import dof_indices, point_rows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Key = tuple[int, int]
# Step of the numerical derivatives of the geometry, in units of what is common for the kind of fault.
_STEP = 1e-5


def with_corrections(
    motion: RigidMotion, placed: Measurement, fits: Mapping[Key, LineFit], corrections: Sequence[Correction]
) -> RigidMotion:
    """Return a motion whose shared errors hold those of the estimates that it was corrected by.

    Parameters
    ----------
    motion : RigidMotion
    placed : Measurement
        As fitted.
    fits : mapping of (run, body) to LineFit
    corrections : sequence of Correction

    Notes
    -----
    The covariance of the motion for given parameters and that of the parameters, both from the same data,
    add up to that of their joint least-squares estimate: var q = var(q | p) + dq/dp var(p) (dq/dp)^T.
    """
    sized = [one for one in corrections if len(one.parameters)]
    if not sized:
        return motion
    shape = (len(motion.runs), len(motion.bodies), *fits[0, 0].q.shape)
    old = motion.shared or SharedErrors((), np.zeros((0, 0)), np.zeros((0, *shape), dtype=complex))
    names, slopes = list(old.names), [old.derivatives]
    count = len(names) + sum(len(one.parameters) for one in sized)
    covariance = np.zeros((count, count))
    covariance[: len(names), : len(names)] = old.covariance
    for one in sized:
        own = slice(len(names), len(names) + len(one.parameters))
        covariance[own, own] = one.covariance
        points = "+".join(dict.fromkeys(placed.bodies[one.body].points[c] for c in one.channels))
        place = f"{motion.bodies[one.body]}.{points}.{one.finding.kind}"
        names += [f"correction.{place}.{k + 1}" for k in range(len(one.parameters))]
        slopes.append(_derivatives(one, fits, shape))
    return replace(motion, shared=SharedErrors(tuple(names), covariance, np.concatenate(slopes)))


def _derivatives(one: Correction, fits: Mapping[Key, LineFit], shape: tuple[int, ...]) -> ComplexArray:
    """Return d q / d parameter, (p, run, body, freq, m)."""
    derivatives = np.zeros((len(one.parameters), *shape), dtype=complex)
    mine = np.zeros(len(fits[one.run, one.body].beams.rows), dtype=bool)
    mine[one.channels] = True
    if len(one.factor):
        part = channel_part(fits[one.run, one.body], mine)
        derivatives[:, one.run, one.body] = -part * one.factor[1:, :, None]
    elif one.fault is not None:
        for run in range(shape[0]):
            fit = fits[run, one.body]
            rows = _row_changes(one, one.fault, fit.beams.lever_m)[:, mine]
            derivatives[:, run, one.body] = fit_derivatives(fit, rows[:, :, dof_indices(fit.beams.dof)], mine)
    return derivatives


def _row_changes(one: Correction, fault: Fault, lever_m: float) -> Array:
    """Return the derivatives (p, channel, 6) of the observation rows at the estimate."""

    def rows(p: Array) -> Array:
        return point_rows(*fault.geometry(one.arms_m, one.directions, p))

    steps = np.diag(_STEP * fault.scale(lever_m))
    p = one.parameters
    return np.stack([(rows(p + step) - rows(p - step)) / (2.0 * np.sum(step)) for step in steps])

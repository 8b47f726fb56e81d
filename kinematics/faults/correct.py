"""Apply what was found to the readings of a body (``--correct``)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.kinds import KINDS, TREATMENTS, Finding, free
from kinematics.faults.search import Diagnosis
from kinematics.faults.sentences import culprit, describe
from kinematics.joint.estimate import joint
from kinematics.joint.expected import ChannelError
from kinematics.joint.tangents import Geometry, Parameters
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class Correction:
    """A body with what was found applied.

    Attributes
    ----------
    body : BodyChannels
        With other values, directions, positions and sd; NaN in channels that are left out.
    errors : tuple of ChannelError, (p,)
        What was corrected by an estimate: its error is shared by all lines.
    covariance : ndarray, (p, p)
        Of the estimates, SI.
    notices : tuple of Notice
    """

    body: BodyChannels
    errors: tuple[ChannelError, ...]
    covariance: Array
    notices: tuple[Notice, ...]


def corrected(body: BodyChannels, diagnosis: Diagnosis, freq_hz: Array, first: int = 0) -> Correction:
    """Correct a body by the findings.

    Faults of lasers and of all beams are corrected by their estimate, whose covariance remains as a shared
    error. Exchanged names are exchanged back and reversed signs reversed. Other channels and points are left
    out: an estimate from their own values would add nothing to the motion.

    Parameters
    ----------
    body : BodyChannels
    diagnosis : Diagnosis
    freq_hz : ndarray, (L,)
    first : int
        Number of its first channel among those of all bodies.
    """
    count = len(body.points)
    estimated = [one for one in diagnosis.findings if one.treatment == "estimate"]
    last = diagnosis.last
    readings = last.readings
    parameters = sum((free(one.kind, one.channels, count) for one in estimated), Parameters.of(count))
    values = np.concatenate([np.zeros(0), *(one.values for one in estimated)])
    base = Geometry(body.arms_m, body.directions, np.ones((1, count), dtype=complex))
    moved = base.moved(parameters, values, np.linspace(-1.0, 1.0, len(freq_hz)), 2.0 * np.pi * freq_hz)
    left_out = ~np.isfinite(readings.noise_factor)
    value = body.value / moved.factor.T
    value[:, left_out] = np.nan
    for one in diagnosis.findings:
        if one.treatment == "sign":
            value[:, list(one.channels)] = -body.value[:, list(one.channels)]
    louder = np.where(left_out, 1.0, readings.noise_factor)
    shift = readings.geometry.positions_m - diagnosis.first.readings.geometry.positions_m
    changed = replace(
        body,
        value=value,
        sd=None if body.sd is None else body.sd * louder[:, None] / np.abs(moved.factor.T),
        positions_m=body.arms_m + shift,
        directions=readings.geometry.directions,
    )
    fit = joint(last.packed, parameters + last.expected, np.concatenate([0.0 * values, last.estimate.values]))
    size = len(parameters)
    covariance = fit.covariance[:size, :size] * last.noise.level
    return Correction(changed, _errors(body, estimated, first), covariance, tuple(
        Notice("corrected", f"{culprit(one, body)}: {TREATMENTS[one.treatment]} ({describe(one, body)}).")
        for one in diagnosis.findings
    ))  # fmt: skip


def _errors(body: BodyChannels, estimated: list[Finding], first: int) -> tuple[ChannelError, ...]:
    """Return the corrected findings as errors of channels, with the sd of each estimate."""
    found = []
    for number, one in enumerate(estimated):
        channels = tuple(first + channel for channel in one.channels)
        for k, tangent in enumerate(KINDS[one.kind].tangents):
            name = f"{body.body}.{one.owner}_{number + 1}.{one.kind}_{k + 1}"
            found.append(ChannelError(name, channels, tangent, float(one.sd[k])))
    return tuple(found)

"""Apply what was found to the readings of a body (``--correct``)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.kinds import KINDS, Finding, free
from kinematics.faults.search import Diagnosis
from kinematics.faults.sentences import culprit, describe
from kinematics.joint.estimate import joint
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
    parameters : Parameters
        What was corrected by an estimate: its error is shared by all lines.
    names : tuple of str, (p,)
    covariance : ndarray, (p, p)
        Of the estimates; delays in rad at the mean frequency.
    notices : tuple of Notice
    """

    body: BodyChannels
    parameters: Parameters
    names: tuple[str, ...]
    covariance: Array
    notices: tuple[Notice, ...]


def corrected(body: BodyChannels, diagnosis: Diagnosis, freq_hz: Array) -> Correction:
    """Correct a body by the findings.

    Faults of lasers and of all beams are corrected by their estimate, whose covariance remains as a shared
    error. Exchanged names are exchanged back and reversed signs reversed. Other channels and points are left
    out: an estimate from their own values would add nothing to the motion.

    Parameters
    ----------
    body : BodyChannels
    diagnosis : Diagnosis
    freq_hz : ndarray, (L,)
    """
    channels = len(body.points)
    estimated = [one for one in diagnosis.findings if one.owner in ("laser", "body") and one.kind in KINDS]
    parameters = Parameters.of(channels)
    for one in estimated:
        parameters = parameters + free(one.kind, one.channels, channels)
    readings = diagnosis.last.readings
    mean_hz = float(np.mean(readings.freq_hz))
    values = [one.values * (2.0 * np.pi * mean_hz if one.kind == "delay" else 1.0) for one in estimated]
    x = np.concatenate(values) if values else np.zeros(0)
    tau = np.linspace(-1.0, 1.0, len(freq_hz))
    base = Geometry(body.arms_m, body.directions, np.ones((1, channels), dtype=complex))
    geometry = base.moved(parameters, x, tau, freq_hz / mean_hz)
    value = body.value / geometry.factor.T
    louder = np.where(np.isfinite(readings.noise_factor), readings.noise_factor, 1.0)
    value[:, ~np.isfinite(readings.noise_factor)] = np.nan
    for one in diagnosis.findings:
        if one.verdict == "sign" and one.owner in ("channel", "point") and one.kind == "gain":
            value[:, list(one.channels)] = -body.value[:, list(one.channels)]
    sd = None if body.sd is None else body.sd * louder[:, None] / np.abs(geometry.factor.T)
    shift = readings.geometry.positions_m - diagnosis.first.readings.geometry.positions_m
    directions = readings.geometry.directions
    changed = replace(body, value=value, sd=sd, positions_m=body.arms_m + shift, directions=directions)
    notices = [Notice("corrected", f"{culprit(one, body)}: {_done(one)} ({describe(one, body)}).")
               for one in diagnosis.findings]  # fmt: skip
    covariance = np.zeros((0, 0))
    if len(parameters):
        last = diagnosis.last
        fit = joint(last.packed, parameters + last.expected, np.concatenate([0.0 * x, last.estimate.values]))
        covariance = fit.covariance[: len(x), : len(x)] * last.noise.level
    names = tuple(
        f"correction.{body.body}.{one.owner}_{number + 1}.{one.kind}_{k + 1}"
        for number, one in enumerate(estimated)
        for k in range(len(one.values))
    )
    return Correction(changed, parameters, names, covariance, tuple(notices))


def _done(one: Finding) -> str:
    """Say what was done about a finding."""
    if one.kind == "label_swap":
        return "exchanged back"
    if one.kind == "noise":
        return "given its larger noise"
    if one.owner in ("laser", "body") and one.kind in KINDS:
        return "corrected by the estimate"
    if one.verdict == "sign" and one.kind == "gain":
        return "sign reversed"
    return "left as it is" if one.kind == "flexible" else "left out"

"""Apply what was found to the readings of a body (``--correct``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.fault_kinds import KINDS, TREATMENTS, Finding, Place, free
from kinematics.faults.search import Diagnosis
from kinematics.faults.sentences import culprit, describe
from kinematics.joint.estimate import joint
from kinematics.joint.expected import ChannelError, body_starts, lasers_of
from kinematics.joint.tangents import Geometry, Parameters
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_CONTRADICTED = 1e-3  # probability of what a body says of a fault that another one shows


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
    """

    body: BodyChannels
    errors: tuple[ChannelError, ...]
    covariance: Array
    notices: tuple[Notice, ...]


def corrected(body: BodyChannels, diagnosis: Diagnosis, freq_hz: Array, first: int = 0) -> Correction:
    """Correct a body by the findings.

    Faults of lasers and of all beams are corrected by their estimate, whose covariance remains as a shared
    error. Exchanged names are exchanged back and reversed signs reversed. Other channels and points are left
    out: an estimate from their own values would add nothing to the motion. ``first`` is the number of its
    first channel among those of all bodies.
    """
    count = len(body.points)
    applied = [one for one in diagnosis.findings if one.treatment == "estimate"]
    estimated = [one for one in applied if not one.shown_by]
    last = diagnosis.last
    readings = last.readings
    parameters = sum((free(one.kind, one.channels, count) for one in estimated), Parameters.of(count))
    every = sum((free(one.kind, one.channels, count) for one in applied), Parameters.of(count))
    values = np.concatenate([np.zeros(0), *(one.values for one in applied)])
    base = Geometry(body.arms_m, body.directions, np.ones((1, count), dtype=complex))
    moved = base.moved(every, values, np.linspace(-1.0, 1.0, len(freq_hz)), 2.0 * np.pi * freq_hz)
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
    size = len(parameters)
    fit = joint(last.packed, parameters + last.expected, np.r_[np.zeros(size), last.estimate.values])
    covariance = fit.covariance[:size, :size] * last.noise.level
    return Correction(changed, _errors(body, estimated, first), covariance, tuple(
        Notice(
            "corrected",
            f"{culprit(one, body)}: {TREATMENTS[one.treatment]} ({describe(one, body)}"
            f"{one.shown_by and f', as body {one.shown_by} shows'}).",
        )
        for one in diagnosis.findings
    ))  # fmt: skip


def on_all_bodies(bodies: Sequence[BodyChannels], diagnoses: Mapping[int, Diagnosis]) -> dict[int, Diagnosis]:
    """Return the diagnoses with the faults of a laser that one body shows in all that it measures.

    A body with few points or much noise may not show a fault of a laser; what its values say of it must not
    contradict the estimate.
    """
    done = dict(diagnoses)
    lasers, starts = lasers_of(bodies)[0], body_starts(bodies)
    for source, found in diagnoses.items():
        findings = list(found.findings)
        for place, one in enumerate(findings):
            if one.owner != "laser" or one.treatment != "estimate":
                continue
            laser = next(own for own in lasers if starts[source] + one.channels[0] in own)
            for number in set(done) - {source}:
                inside = range(starts[number], starts[number + 1])
                same = replace(
                    one,
                    place=Place(
                        "laser", tuple(channel - starts[number] for channel in laser if channel in inside)
                    ),
                    shown_by=bodies[source].body,
                )
                if same.channels and _agrees(done[number], same):
                    there = tuple(starts[number] + channel for channel in same.channels)
                    findings[place] = replace(findings[place], elsewhere=(*findings[place].elsewhere, *there))
                    done[number] = done[number].with_finding(same)
        done[source] = replace(done[source], findings=(*findings, *done[source].findings[len(findings) :]))
    return done


def _agrees(diagnosis: Diagnosis, fault: Finding) -> bool:
    """Return whether the readings of a body allow the fault that a laser shows on another body.

    False where the body has a fault of its own in these channels, or another cause.
    """
    from scipy.special import chdtrc

    last, size = diagnosis.last, len(fault.values)
    accused = {channel for one in diagnosis.findings for channel in one.channels}
    if diagnosis.causes or accused & set(fault.channels):
        return False
    parameters = free(fault.kind, fault.channels, len(last.layout.points)) + last.expected
    fit = joint(last.packed, parameters)
    apart = fit.values[:size] - fault.values
    spread = fit.covariance[:size, :size] * last.noise.level + np.diag(fault.sd**2)
    return float(chdtrc(size, apart @ np.linalg.solve(spread, apart))) > _CONTRADICTED


def _errors(body: BodyChannels, estimated: list[Finding], first: int) -> tuple[ChannelError, ...]:
    """Return the corrected findings as errors of channels, with the sd of each estimate."""
    found = []
    for number, one in enumerate(estimated):
        channels = (*(first + channel for channel in one.channels), *one.elsewhere)
        for k, tangent in enumerate(KINDS[one.kind].tangents):
            name = f"{body.body}.{one.owner}_{number + 1}.{one.kind}_{k + 1}"
            found.append(ChannelError(name, channels, tangent, float(one.sd[k])))
    return tuple(found)

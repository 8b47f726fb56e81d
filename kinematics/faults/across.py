"""Search each body and run for faults, and then all of them together for rows under a wrong label."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kinematics.faults.across_blocks import label_findings
from kinematics.faults.across_lines import loud_lines
from kinematics.faults.across_motion import Cleared, chosen_lines, cleared
from kinematics.faults.compact import compact
from kinematics.faults.diagnose import FALSE_ALARM, Diagnosis, diagnose, nothing_found
from kinematics.faults.findings import Finding
from kinematics.faults.neglected import extended_beams
from kinematics.fit.line_noise import LineNoise
from kinematics.fit.noise_course import noise_course
from kinematics.fit.record_noise import holds_record_noise
from kinematics.fit.rigid_fit import LineFit, refitted
from kinematics.measurement import BodyChannels, Measurement

Key = tuple[int, int]


def diagnosed(
    placed: Measurement, body: BodyChannels, fit: LineFit, known: bool, without: list[int] | None = None
) -> Diagnosis:
    """Search one body in one run for faults, with all degrees of freedom that the beams observe.

    Parameters
    ----------
    placed : Measurement
    body : BodyChannels
    fit : LineFit
        Of the degrees of freedom that are wanted.
    known : bool
        The noise is stated.
    without : list of int, optional
        Channels whose fault is known already.
    """
    lines = int(np.sum(np.isfinite(fit.q[:, 0].real)))
    if lines < 3 or fit.is_rounding():
        return nothing_found(fit.beams, fit.sd)
    whole = fit
    if len(fit.beams.dof) < 6:
        whole = refitted(extended_beams(body, fit.beams.dof), fit)
    data = compact(whole, body, placed.freq_hz, known, placed.line_spread)
    if without:
        data = data.without(without).repacked()
    alarm = FALSE_ALARM / len(placed.runs) / len(placed.bodies)
    return diagnose(data, body.position_sd_mm * 1e-3, known, alarm, holds_record_noise(placed, body))


def told_across(
    placed: Measurement,
    fits: Mapping[Key, LineFit],
    diagnoses: Mapping[Key, Diagnosis],
    known: Mapping[Key, bool],
) -> dict[Key, Diagnosis]:
    """Return the diagnoses in which rows under a wrong body, point, run or frequency are named.

    Nothing is looked at when no body has a fault.
    """
    if not any(found.findings for found in diagnoses.values()):
        return {}
    motions: dict[Key, Cleared] = {}
    found: dict[Key, list[Finding]] = {}
    for key, fit in fits.items():
        if fit.is_rounding() or not np.any(fit.solution.good):
            continue
        body = placed.bodies[key[1]]
        beams = extended_beams(body, fit.beams.dof)
        noise = fit.noise
        if not known[key]:
            noise = LineNoise(noise.stated, noise_course(fit, placed.freq_hz))
        lines = chosen_lines(fit.solution.good)
        motions[key] = cleared(key, fit, body, beams, noise.at(lines), lines)
        for pair in loud_lines(fit):
            both = np.array(pair)
            single = {key: cleared(key, fit, body, beams, noise.at(both), both)}
            found |= label_findings(single, placed.runs, placed.freq_hz)
            if key in found:
                break
    found = {**found, **label_findings(motions, placed.runs, placed.freq_hz)}
    made = {}
    for key, findings in found.items():
        out = [c for finding in findings for c in finding.channels]
        rest = diagnosed(placed, placed.bodies[key[1]], fits[key], known[key], out)
        kept = 0.0 if not rest.findings else rest.kept
        made[key] = replace(rest, findings=(*findings, *rest.findings), kept=kept)
    return made

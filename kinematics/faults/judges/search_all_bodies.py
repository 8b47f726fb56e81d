"""Search all bodies and runs together for rows under a wrong label."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from kinematics.faults.diagnose import Diagnosis, diagnose
from kinematics.faults.findings import Finding
from kinematics.faults.judges.row_labels import label_findings
from kinematics.faults.proposals.clean_motion import CleanMotion, chosen_lines, fit_clean_motion
from kinematics.fit.line_noise import LineNoise
from kinematics.fit.neglected_motion import extended_beams
from kinematics.fit.noise_spectrum import noise_course
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import Measurement

Key = tuple[int, int]
# How many times the usual chi2 a line that agrees much worse has at least.
_LOUD = 3.0


def find_mislabelled(
    placed: Measurement,
    fits: Mapping[Key, LineFit],
    diagnoses: Mapping[Key, Diagnosis],
    known: Mapping[Key, bool],
) -> dict[Key, Diagnosis]:
    """Return the diagnoses in which rows under a wrong body, point, run or frequency are named.

    Nothing is looked at when no body has a fault.
    """
    if not any(diagnosis.findings for diagnosis in diagnoses.values()):
        return {}
    motions: dict[Key, CleanMotion] = {}
    findings_of: dict[Key, list[Finding]] = {}
    for key, fit in fits.items():
        if fit.is_rounding() or not np.any(fit.solution.good):
            continue
        body = placed.bodies[key[1]]
        beams = extended_beams(body, fit.beams.dof)
        noise = fit.noise
        if not known[key]:
            noise = LineNoise(noise.stated, noise_course(fit, placed.freq_hz))
        lines = chosen_lines(fit.solution.good)
        motions[key] = fit_clean_motion(key, fit, placed, beams, noise.at(lines), lines)
        for pair in _loud_lines(fit):
            both = np.array(pair)
            single = {key: fit_clean_motion(key, fit, placed, beams, noise.at(both), both)}
            findings_of |= label_findings(single, placed.runs)
            if key in findings_of:
                break
    findings_of = {**findings_of, **label_findings(motions, placed.runs)}
    diagnoses_with_labels = {}
    for key, findings in findings_of.items():
        out = [c for finding in findings for c in finding.channels]
        rest = diagnose(placed, placed.bodies[key[1]], fits[key], known[key], out)
        unexplained = 0.0 if not rest.findings else rest.kept
        diagnoses_with_labels[key] = replace(rest, findings=(*findings, *rest.findings), kept=unexplained)
    return diagnoses_with_labels


def _loud_lines(fit: LineFit) -> list[tuple[int, int]]:
    """Return pairs of the few lines at which a body agrees much worse than at the others."""
    good = np.isfinite(fit.chi2) & (fit.n_dof > 0)
    if np.sum(good) < 12:
        return []
    ratio = np.where(good, fit.chi2 / np.maximum(fit.n_dof, 1), 0.0)
    freedom = float(np.median(fit.n_dof[good]))
    typical = max(float(np.median(ratio[good])), 1e-300)
    loud = np.flatnonzero(ratio > typical * max(_LOUD, 1.0 + 10.0 * np.sqrt(2.0 / freedom)))
    if not 2 <= len(loud) <= max(4, len(ratio) // 20):
        return []
    worst = loud[np.argsort(-ratio[loud], kind="stable")[:4]]
    return [(int(min(pair)), int(max(pair))) for pair in combinations(worst, 2)]

"""Explain a misfit on many channels by a cause other than a body that bends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.faults.alternatives import BENDS, Proposal, proposed
from kinematics.faults.diagnose import Diagnosis, diagnose
from kinematics.faults.findings import Finding
from kinematics.faults.proposals.misfitting_body import MisfittingBody
from kinematics.faults.proposals.outliers import likely_outliers, with_far_values
from kinematics.fit.body_noise import fit_with_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement

# Bound on the probability of outliers by chance; see ``likely_outliers``.
_CERTAIN = 1e-4
# Faults of channels that are accepted next to a cause: several of them are how a body that bends shows, too.
_NEXT_TO_IT = 1


def explain_misfit(
    placed: Measurement, run: int, body: BodyChannels, fit: LineFit, known: bool, diagnosis: Diagnosis
) -> tuple[Diagnosis, LineFit] | None:
    """Return the diagnosis by a cause other than a body that bends, and the fit without that cause.

    None when no cause leaves a body that moves rigidly. Arguments as of ``search_body``, whose diagnosis, by
    the faults of single channels, points and lasers, is explained.

    Notes
    -----
    All causes are tried for a body that seems to bend. Outliers inflate the noise where it is estimated and
    can pass for faults of channels: they are tried whenever there are any, and believed when fewer faults
    remain without them. No fault is accepted next to scattered gains, which are such faults themselves.
    """
    bends = diagnosis.bends
    if fit.is_rounding() or (known and not diagnosis.findings):
        return None
    # Errors of positions within their stated sd are no outliers.
    offsets = diagnosis.offsets_m if not diagnosis.findings and np.any(diagnosis.offsets_m) else None
    suspect = MisfittingBody(placed, run, body, fit.beams, known, offsets)
    if not bends and not likely_outliers(suspect.plain, diagnosis.course):
        return None
    suspect = with_far_values(suspect)
    for cause in proposed("misfit", suspect, BENDS if bends else 0.0):
        remedy = cause.value
        again, stated, _notices = fit_with_noise(placed, run, remedy.body, fit.beams, "none")
        remaining = diagnose(placed, remedy.body, again, stated)
        most = 0 if cause.entry.of_channels else _NEXT_TO_IT if bends else len(remaining.findings)
        if remaining.bends or len(remaining.findings) > most:
            continue
        if remedy.alike:
            findings = tuple(_or(cause, finding) for finding in diagnosis.findings)
            return replace(diagnosis, findings=findings), fit
        if not bends and diagnosis.findings and len(remaining.findings) >= len(diagnosis.findings):
            continue
        finding = Finding(
            cause.entry.verdict,
            remedy.channels,
            min((one.p_value for one in diagnosis.findings), default=_CERTAIN),
            size=remedy.size,
            text=cause.text,
            code=cause.entry.code,
            step=cause.step,
            remedied=remedy.body if remedy.one_sided and not cause.entry.of_channels else None,
        )
        return replace(remaining, findings=(*remaining.findings, finding), kept=1.0), again
    return None


def _or(cause: Proposal, finding: Finding) -> Finding:
    """Return a finding that says of a body that bends that a cause would look alike."""
    step = f"So few channels do not tell this from another cause: {cause.text}. {cause.step}"
    return replace(finding, step=step) if finding.kind == "flexible" else finding

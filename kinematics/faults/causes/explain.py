"""Explain a misfit on many channels by a cause other than a body that bends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from kinematics.faults.causes.conjugated import conjugated
from kinematics.faults.causes.gains import gains
from kinematics.faults.causes.mains import mains
from kinematics.faults.causes.misfit_causes import Explanation, MisfittingBody
from kinematics.faults.causes.outliers import likely_outliers, outliers, with_far_values
from kinematics.faults.causes.ranges import ranges
from kinematics.faults.diagnose import Diagnosis, diagnose
from kinematics.faults.findings import Finding
from kinematics.fit.body_noise import fit_with_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement

Cause = Callable[[MisfittingBody], Iterator[Explanation]]
# Bound on the probability of outliers by chance; see ``likely_outliers``.
_CERTAIN = 1e-4
# Faults of channels that are accepted next to a cause: several of them are how a body that bends shows, too.
_NEXT_TO_IT = 1
CAUSES: tuple[Cause, ...] = (conjugated, mains, ranges, outliers, gains)


def explain_misfit(
    placed: Measurement, run: int, body: BodyChannels, fit: LineFit, known: bool, diagnosis: Diagnosis
) -> tuple[Diagnosis, LineFit] | None:
    """Return the diagnosis by a cause other than a body that bends, and the fit without that cause.

    Parameters
    ----------
    fit : LineFit
        Of the degrees of freedom that are wanted.
    known : bool
        The noise is stated.
    diagnosis : Diagnosis
        By the faults of single channels, points and lasers.

    Returns
    -------
    tuple or None
        None when no cause leaves a body that moves rigidly.

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
    p_value = min((finding.p_value for finding in diagnosis.findings), default=_CERTAIN)
    for cause in CAUSES if bends else (outliers,):
        for explanation in cause(suspect):
            again, stated, _notices = fit_with_noise(placed, run, explanation.remedied, fit.beams, "none")
            remaining = diagnose(placed, explanation.remedied, again, stated)
            most = 0 if cause is gains else _NEXT_TO_IT if bends else len(remaining.findings)
            if remaining.bends or len(remaining.findings) > most:
                continue
            if explanation.alike:
                findings = tuple(_or(explanation.finding, finding) for finding in diagnosis.findings)
                return replace(diagnosis, findings=findings), fit
            if not bends and diagnosis.findings and len(remaining.findings) >= len(diagnosis.findings):
                continue
            remedied = None if cause is gains else explanation.remedied
            finding = replace(explanation.finding, p_value=p_value, remedied=remedied)
            return replace(remaining, findings=(*remaining.findings, finding), kept=1.0), again
    return None


def _or(cause: Finding, finding: Finding) -> Finding:
    """Return a finding that says of a body that bends that a cause would look alike."""
    step = f"So few channels do not tell this from another cause: {cause.text}. {cause.step}"
    return replace(finding, step=step) if finding.kind == "flexible" else finding

"""Explain a misfit on many channels by a cause other than a body that bends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.kinematics.faults.alternatives import BENDS, Proposal, proposed
from legacy.kinematics.faults.diagnose import diagnose
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.faults.proposals.misfitting_body import MisfittingBody
from legacy.kinematics.faults.proposals.outliers import likely_outliers, with_far_values
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array

# Bound on the probability of outliers by chance; see ``likely_outliers``.
_CERTAIN = 1e-4
# Faults of channels that are accepted next to a cause: several of them are how a body that bends shows, too.
_NEXT_TO_IT = 1
# Noise besides that in proportion to the readings, as a share of the rms reading of a line: none, or enough
# to matter at the smallest readings. Chosen by judgement, checked on bodies of fault_bodies.
_FLOORS = (0.0, 0.2)


def explain_misfit(
    placed: Measurement,
    run: int,
    body: BodyChannels,
    fit: LineFit,
    known: bool,
    diagnosis: Diagnosis,
    lasers: LaserScatter | None = None,
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
    likely = bends or likely_outliers(suspect.plain, diagnosis.course)
    if not likely and not diagnosis.findings:
        return None
    proportional = _by_proportional_noise(suspect, fit, diagnosis, lasers)
    if proportional is not None or not likely:
        return proportional
    suspect = with_far_values(suspect)
    for cause in proposed("misfit", suspect, BENDS if bends else 0.0):
        remedy = cause.value
        most = 0 if cause.entry.of_channels else _NEXT_TO_IT if bends else None
        again, remaining = fit, replace(diagnosis, findings=())
        if not remedy.judged:
            again, stated, _notices = fit_with_noise(placed, run, remedy.body, fit.beams, "none")
            remaining = diagnose(placed, remedy.body, again, stated, lasers=lasers, most=most)
        if remaining.bends or (most is not None and len(remaining.findings) > most):
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


def _by_proportional_noise(
    suspect: MisfittingBody, fit: LineFit, diagnosis: Diagnosis, lasers: LaserScatter | None
) -> tuple[Diagnosis, LineFit] | None:
    """Return the diagnosis and fit with noise in proportion to the readings, where that leaves nothing.

    Notes
    -----
    Noise that is not stated has a course over frequency, the same for all channels. In proportion to the
    readings it differs from value to value: the largest then look like outliers or faults. It is taken where
    it is likelier and nothing is found with it: the errors of a fault depend on each other, which those of
    noise do not.
    """
    if suspect.known or suspect.body.sd is not None:
        return None
    size = np.abs(suspect.robust.beams.basis @ suspect.robust.solution.z)
    for floor in _FLOORS:
        sd = np.full(suspect.body.displacement.shape, np.nan)
        sd[suspect.run] = np.hypot(size, floor * np.sqrt(np.nanmean(size**2, axis=0)))
        body = replace(suspect.body, sd=np.where(sd > 0.0, sd, np.nan), relative=True)
        again, stated, _notices = fit_with_noise(suspect.placed, suspect.run, body, suspect.beams, "none")
        if _deviance(again, None) >= _deviance(fit, diagnosis.course):
            continue
        remaining = diagnose(suspect.placed, body, again, stated, lasers=lasers, most=0)
        if not remaining.findings and not likely_outliers(again, remaining.course):
            return replace(remaining, kept=1.0), again
    return None


def _deviance(fit: LineFit, course: Array | None) -> float:
    """Return -2 log of the restricted likelihood of the noise of a fit, whatever its size (Patterson 1971).

    ``course`` (freq,) is that of its noise over frequency, where the fit has another.
    """
    lines = np.flatnonzero(fit.solution.good & (fit.n_dof > 0))
    residual, sd, _weights = fit.at(lines)
    ratio = np.ones(sd.shape) if course is None else LineNoise(fit.noise.stated, course).at(lines) / sd
    used = np.isfinite(sd)
    covariance = fit.covariance[lines] * np.nanmean(ratio, axis=0)[:, None, None] ** 2
    misfit = float(np.nansum(np.abs(residual / (sd * ratio)) ** 2))
    freedom = float(np.sum(fit.n_dof[lines]))
    spread = float(np.sum(np.log((sd * ratio)[used] ** 2)) - np.sum(np.linalg.slogdet(covariance)[1]))
    return freedom * np.log(max(misfit, 1e-300)) + 2.0 * spread


def _or(cause: Proposal, finding: Finding) -> Finding:
    """Return a finding that says of a body that bends that a cause would look alike."""
    step = f"The readings do not tell this from another cause: {cause.text}. {cause.step}"
    return replace(finding, step=step) if finding.kind == "flexible" else finding

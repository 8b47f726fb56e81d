"""Explain a misfit on many channels by a cause other than a body that bends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.causes.conjugated import conjugated
from kinematics.faults.causes.gains import gains
from kinematics.faults.causes.mains import mains
from kinematics.faults.causes.outliers import likely_outliers, outliers, with_far_values
from kinematics.faults.causes.suspect import Explanation, Suspect
from kinematics.faults.diagnose import Diagnosis, diagnosed
from kinematics.faults.findings import Finding
from kinematics.fit.body_noise import with_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement

Cause = Callable[[Suspect], Iterator[Explanation]]
# Bound on the probability of outliers by chance; see ``likely_outliers``.
_CERTAIN = 1e-4
# Faults of channels that are accepted next to a cause: several of them are how a body that bends shows, too.
_NEXT_TO_IT = 1
CAUSES: tuple[Cause, ...] = (conjugated, mains, outliers, gains)


def explained(
    placed: Measurement, run: int, body: BodyChannels, fit: LineFit, known: bool, found: Diagnosis
) -> tuple[Diagnosis, LineFit] | None:
    """Return the diagnosis by a cause other than a body that bends, and the fit without that cause.

    Parameters
    ----------
    placed : Measurement
    run : int
    body : BodyChannels
    fit : LineFit
        Of the degrees of freedom that are wanted.
    known : bool
        The noise is stated.
    found : Diagnosis
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
    bends = found.bends
    if fit.is_rounding() or (known and not found.findings):
        return None
    # Errors of positions within their stated sd are no outliers.
    offsets = found.offsets_m if not found.findings and np.any(found.offsets_m) else None
    suspect = Suspect(placed, run, body, fit.beams, known, offsets)
    if not bends and not likely_outliers(suspect.plain, found.course):
        return None
    suspect = with_far_values(suspect)
    p_value = min((finding.p_value for finding in found.findings), default=_CERTAIN)
    for cause in CAUSES if bends else (outliers,):
        for made in cause(suspect):
            again, stated, _notices = with_noise(placed, run, made.remedied, fit.beams, "none")
            left = diagnosed(placed, made.remedied, again, stated)
            if left.bends:
                continue
            if bends and len(left.findings) > _NEXT_TO_IT:
                continue
            if left.findings and cause is gains:
                continue
            if made.alike:
                return replace(found, findings=tuple(map(_or(made), found.findings))), fit
            if not bends and found.findings and len(left.findings) >= len(found.findings):
                continue
            finding = _finding(made, p_value, None if cause is gains else made.remedied.displacement[run])
            return replace(left, findings=(*left.findings, finding), kept=1.0), again
    return None


def _or(made: Explanation) -> Callable[[Finding], Finding]:
    """Return what says of a body that bends that a cause would look alike."""
    step = f"So few channels do not tell this from another cause: {made.text}. {made.step}"
    return lambda finding: replace(finding, step=step) if finding.kind == "flexible" else finding


def _finding(made: Explanation, p_value: float, remedied: NDArray[np.complex128] | None) -> Finding:
    return Finding(
        made.verdict,
        made.channels,
        p_value,
        None,
        made.size,
        text=made.text,
        code=made.code,
        step=made.step,
        remedied=remedied,
    )

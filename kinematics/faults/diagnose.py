"""Diagnose one body of a measurement in all its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinematics.faults.elsewhere import other_causes
from kinematics.faults.rounds import null_fit
from kinematics.faults.search import Diagnosis, search
from kinematics.fit.lasers import laser_numbers
from kinematics.fit.rigid_fit import LineFit
from kinematics.joint.expected import Layout, Priors
from kinematics.joint.pack import Readings
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array

LEAST_LOG_P = -25.0
"""Logarithm of a probability above which a finding may come from correlated noise of computed axes: that of
three beams 20 degrees off their axis, each with a noise of its own, made -14 in simulated exports."""
_EXACT = 1e-9  # residuals over values of data without noise, whose rounding is no evidence of faults


def diagnose(
    body: BodyChannels,
    fits: Sequence[LineFit],
    freq_hz: Array,
    stated: bool,
    priors: Priors | None = None,
    line_spread: float = 1.0,
) -> Diagnosis:
    """Search the readings of a body for faults.

    Parameters
    ----------
    body : BodyChannels
        Without the channels that hold nothing, which are NaN.
    fits : sequence of LineFit, (r,)
        Of its runs, with their noise.
    freq_hz : ndarray, (L,)
    stated : bool
        Whether the noise is stated in absolute size.
    priors : Priors, optional
        Errors that are expected; those of data sheets unless given. Stated errors of positions are added.
    line_spread : float
        Factor by which the variance of slowly varying sums exceeds that of independent lines.
    """
    priors = priors or Priors()
    if not priors.position_m.size:
        priors = replace(priors, position_m=np.nan_to_num(body.position_sd_m))
    layout = Layout(body.points, laser_numbers(body.directions))
    sd = fits[0].sd[None] if len(fits) == 1 else np.stack([fit.sd for fit in fits])
    if line_spread > 1.0:
        sd = sd * np.sqrt(line_spread)
    if not stated:  # in the proportions of the channels; its course over lines is found anew, without faults
        sd = sd * np.median([np.median(fit.factor) for fit in fits])
    readings = Readings.of(body.value, sd, freq_hz, body.arms_m, body.directions)
    if all(fit.solution.is_rounding(_EXACT) for fit in fits) or not _enough(readings, fits):
        first = null_fit(readings, layout, priors, stated)
        return Diagnosis((), np.zeros(len(body.points)), 1.0, first, first)
    found = search(readings, layout, priors, stated)
    if any(finding.kind == "flexible" for finding in found.findings):
        causes = other_causes(found.first)
        found = replace(found, findings=(), causes=tuple(causes)) if causes else found
    least = min((finding.log_p for finding in found.findings), default=0.0)
    if not stated and least >= LEAST_LOG_P and has_computed_axes(body):
        return replace(found, findings=(), last=found.first, causes=())
    return found


def has_computed_axes(body: BodyChannels) -> bool:
    """Return whether every point was measured along three beams that are normal to each other.

    No three heads see one point so: a program computed the values from beams that lie closer together, and
    their noise is correlated within a point.
    """
    for point in dict.fromkeys(body.points):
        beams = body.directions[body.channels_of(point)]
        if len(beams) != 3 or np.max(np.abs(beams @ beams.T - np.eye(3))) > 1e-3:
            return False
    return True


def _enough(readings: Readings, fits: Sequence[LineFit]) -> bool:
    """Return whether more channels than degrees of freedom read something."""
    read = int(np.count_nonzero(np.any(np.isfinite(readings.value), axis=1)))
    return read > max(len(fit.beams.dof) for fit in fits) and readings.value.shape[1] > 1

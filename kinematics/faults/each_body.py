"""Search one body in one run for faults, with all degrees of freedom that its beams observe."""

from __future__ import annotations

import numpy as np

from kinematics.faults.diagnose import FALSE_ALARM, Diagnosis, diagnose, nothing_found
from kinematics.faults.packed.compact import compact
from kinematics.fit.neglected_motion import extended_beams
from kinematics.fit.reference_noise import holds_record_noise
from kinematics.fit.rigid_fit import LineFit, refitted
from kinematics.measurement import BodyChannels, Measurement

# The search holds several matrices of channel x channel, 128 MB each at this number.
MOST_CHANNELS = 4000


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

    Notes
    -----
    Nothing is searched with fewer than two lines, without noise, or with more than `MOST_CHANNELS` channels.
    """
    lines = int(np.sum(np.isfinite(fit.q[:, 0].real)))
    if lines < 2 or fit.is_rounding() or len(body.points) > MOST_CHANNELS:
        return nothing_found(fit.beams, fit.sd)
    whole = fit
    if len(fit.beams.dof) < 6:
        whole = refitted(extended_beams(body, fit.beams.dof), fit)
    data = compact(whole, body, placed.freq_hz, known, placed.line_spread)
    if without:
        data = data.without(without).repacked()
    alarm = FALSE_ALARM / len(placed.runs) / len(placed.bodies)
    return diagnose(data, body.position_sd_mm * 1e-3, known, alarm, holds_record_noise(placed, body))

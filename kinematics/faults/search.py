"""Search for faults: test all kinds at all places, fit the likeliest, believe one, and look again.

A round tests whether anything is wrong at all before it asks what (detection before identification). A fault
of a laser, of all beams or of names is corrected, a channel or point is left out, and the lines are packed
anew. Shapes: c channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.amplitude_noise import amplitude_noise
from kinematics.faults.candidates import Candidate, fit_candidates
from kinematics.faults.elsewhere import Cause
from kinematics.faults.kinds import KINDS, Finding, free
from kinematics.faults.rounds import Round, noise_level, null_fit
from kinematics.faults.scores import pattern_gain
from kinematics.joint.expected import Layout, Priors
from kinematics.joint.pack import Readings
from stapeskit.arrays import Array

_LEAST_CHANNELS = 8  # that are left, to tell more than the six motions


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with the readings of a body.

    Attributes
    ----------
    findings : tuple of Finding
    channel_log_p : ndarray, (c,)
        Logarithm of the probability of each channel's readings without a fault of it.
    noise_level : float
        Noise over the stated one where it is louder (or quieter) everywhere; 1 otherwise.
    first, last : Round
        Before and after what was found.
    causes : tuple of Cause
        What many channels share, where no fault of single ones explains the misfit.
    """

    findings: tuple[Finding, ...]
    channel_log_p: Array
    noise_level: float
    first: Round
    last: Round
    causes: tuple[Cause, ...] = ()


def search(
    readings: Readings, layout: Layout, priors: Priors, stated: bool = True, most: int | None = None
) -> Diagnosis:
    """Look for faults until nothing is left.

    Parameters
    ----------
    readings : Readings
    layout : Layout
    priors : Priors
    stated : bool
        Whether the noise is stated in absolute size.
    most : int, optional
        Findings at most; a third of the points, at least two, unless given. With more, the body as a whole
        does not move as a rigid body does.
    """
    most = max(2, len(set(layout.points)) // 3) if most is None else most
    first = null_fit(readings, layout, priors, stated)
    level = noise_level(first) if stated and not first.clean() else 1.0
    if level != 1.0:
        stated = False
        first = null_fit(readings, layout, priors, stated)
    grows = None if first.clean() else amplitude_noise(readings, first.state)
    if grows is not None:
        readings, stated = grows, False
        first = null_fit(readings, layout, priors, stated)
    now = first
    found: list[Finding] = []
    while not now.clean() and len(found) < most + 1:
        candidates = fit_candidates(now)
        if not candidates:
            break
        found.append(_finding(now, candidates[0]))
        readings = _believed(now, candidates[0])
        if np.count_nonzero(np.isfinite(readings.noise_factor)) < _LEAST_CHANNELS:
            break
        now = null_fit(readings, layout, priors, stated)
    if _bends(found, first, now):
        every = tuple(range(len(layout.points)))
        log_p = min(first.log_whole, float(np.min(first.log_p, initial=0.0)))
        found = [Finding("flexible", "body", every, np.zeros(0), np.zeros(0), log_p)]
    chances = first.channel_log_p()
    if found:
        sound = np.setdiff1d(now.live, [channel for one in found for channel in one.channels])
        chances[sound] = now.channel_log_p()[sound]
    return Diagnosis(tuple(found), chances, level, first, now)


def _bends(found: Sequence[Finding], first: Round, last: Round) -> bool:
    """Return whether the body as a whole does not move as a rigid body.

    Nothing that was found makes the others agree; or several points move unlike the others, and one pattern
    over all channels explains as much with fewer numbers, as one shape of bending does.
    """
    if found and not last.clean():
        return True
    points = {first.layout.points[c] for one in found if one.kind == "elsewhere" for c in one.channels}
    fall = (first.estimate.chi2 - last.estimate.chi2) / first.noise.level
    count = first.packed.values - last.packed.values
    without = 0.5 * (fall - count * float(np.log(first.packed.values)))
    return len(points) > 1 and pattern_gain(first.state, first.noise) > without


def _finding(now: Round, best: Candidate) -> Finding:
    """Return the finding of a candidate that is believed."""
    values, sd = best.values, best.sd
    log_p = float(now.noise.log_tail(max(best.fall, 0.0), max(len(values), 1)))
    if best.kind == "noise":
        log_p = float(now.channel_noise[best.place.channels[0]])
    if best.kind == "delay":
        omega = 2.0 * np.pi * float(np.mean(now.readings.freq_hz))
        values, sd = values / omega, sd / omega
    share = best.fall / now.noise.level / max(now.excess, 1e-9)
    return Finding(best.kind, best.place.owner, best.place.channels, values, sd, log_p, min(share, 1.0))


def _believed(now: Round, best: Candidate) -> Readings:
    """Return the readings under a fault that is believed: corrected, louder, or without its channels."""
    readings, own = now.readings, best.place.channels
    if best.exchange is not None:
        changed = best.exchange.geometry
        geometry = replace(readings.geometry, positions_m=changed.positions_m, directions=changed.directions)
        return replace(readings, geometry=geometry)
    if best.kind == "noise":
        return readings.louder(own[0], float(best.values[0]))
    if best.place.owner in ("laser", "body") and best.kind in KINDS:
        return readings.corrected(free(best.kind, own, len(now.layout.points)), best.values)
    return readings.without(own)

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
from kinematics.faults.candidates import Candidate, fit_candidates, whole_fit
from kinematics.faults.elsewhere import Cause
from kinematics.faults.kinds import KINDS, Finding, free
from kinematics.faults.rounds import Round, noise_level, null_fit
from kinematics.faults.scores import one_pattern
from kinematics.joint.expected import Layout, Priors
from kinematics.joint.pack import Readings
from stapeskit.arrays import Array


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
    first = now = null_fit(readings, layout, priors, stated)
    found: list[Finding] = []
    level = 1.0
    if stated and not now.clean():
        level = noise_level(now)
        if level != 1.0:
            stated = False
            first = now = null_fit(readings, layout, priors, stated)
    grows = None if now.clean() else amplitude_noise(readings, now.state)
    if grows is not None:
        readings, stated = grows[0], False
        first = now = null_fit(readings, layout, priors, stated)
    while not now.clean() and len(found) < most + 1:
        candidates = fit_candidates(now)
        if not candidates:
            break
        best = candidates[0]
        found.append(_finding(now, best))
        readings = _believed(now, best)
        if not _solvable(readings):
            break
        now = null_fit(readings, layout, priors, stated)
    if _bends(found, first, now):
        every = tuple(range(len(layout.points)))
        log_p = min(first.log_whole, float(np.min(first.log_p, initial=0.0)))
        found = [Finding("flexible", "body", every, np.zeros(0), np.zeros(0), log_p)]
    chances = _channel_log_p(first)
    at_fault = [channel for one in found for channel in one.channels]
    sound = np.setdiff1d(now.live, at_fault)
    if found:
        chances[sound] = _channel_log_p(now)[sound]
    return Diagnosis(tuple(found), chances, level, first, now)


def _bends(found: Sequence[Finding], first: Round, last: Round) -> bool:
    """Return whether the body as a whole does not move as a rigid body.

    Nothing that was found makes the others agree; or several points move unlike the others, and one pattern
    over all channels holds most of the misfit, as one shape of bending has.
    """
    if found and not last.clean():
        return True
    points = {first.layout.points[c] for one in found if one.kind == "elsewhere" for c in one.channels}
    if len(points) < 2:
        return False
    return one_pattern(first.state, first.noise)


def _finding(now: Round, best: Candidate) -> Finding:
    """Return what is believed, with its size under all lines."""
    own = best.place.channels
    sd = np.zeros(len(best.values))
    values = best.values
    log_p = float(now.noise.log_tail(max(best.fall, 0.0), max(len(values), 1)))
    if best.kind in KINDS:
        fit = whole_fit(now, best)
        values = fit.values[: len(values)]
        sd = np.sqrt(np.maximum(np.diag(fit.covariance)[: len(values)] * now.noise.level, 0.0))
        if best.kind == "delay":
            omega = 2.0 * np.pi * float(np.mean(now.readings.freq_hz))
            values, sd = values / omega, sd / omega
    elif best.kind == "noise":
        log_p = float(now.channel_noise[own[0]])
        sd = values / np.sqrt(2.0 * now.state.channel_energy[1][own[0]])
    share = best.fall / now.noise.level / max(now.excess, 1e-9)
    return Finding(best.kind, best.place.owner, own, values, sd, log_p, min(share, 1.0))


def _believed(now: Round, best: Candidate) -> Readings:
    """Return the readings under a fault that is believed: corrected, louder, or without its channels."""
    readings = now.readings
    if best.exchange is not None:
        changed = best.exchange.geometry
        geometry = replace(readings.geometry, positions_m=changed.positions_m, directions=changed.directions)
        return replace(readings, geometry=geometry)
    if best.kind == "noise":
        return readings.louder(best.place.channels[0], float(best.values[0]))
    if best.place.owner in ("laser", "body") and best.kind in KINDS:
        return readings.corrected(free(best.kind, best.place.channels, len(now.layout.points)), best.values)
    return readings.without(best.place.channels)


def _solvable(readings: Readings) -> bool:
    """Return whether more channels are left than a rigid motion has degrees of freedom."""
    return int(np.count_nonzero(np.isfinite(readings.noise_factor))) > 7


def _channel_log_p(now: Round) -> Array:
    """Return the logarithm of the smallest p-value of each channel's own tests, all of them one test."""
    out = np.minimum(now.channel_noise, 0.0)
    count = np.ones(len(out))
    own = [test for test in now.tests if test.place.owner == "channel"]
    channels = np.array([test.place.channels[0] for test in own], dtype=np.intp)
    statistics = np.array([test.statistic for test in own])
    tail = now.noise.log_tail(statistics, np.array([test.freedom for test in own]))
    np.minimum.at(out, channels, tail)
    np.add.at(count, channels, 1.0)
    return np.minimum(out + np.log(count), 0.0)

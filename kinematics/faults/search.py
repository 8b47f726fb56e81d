"""Search one body for faults: test all kinds at all places, fit the likeliest, believe one, and look again.

A round tests whether anything is wrong at all before it asks what (detection before identification). A fault
of a laser, of all beams or of names is corrected, a channel or point is left out, and the lines are packed
anew. Where several points are at fault, each hides the others: then the points that agree are sought first.
Shapes: c channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.candidates import fit_candidates
from kinematics.faults.fault_kinds import Finding, Place, free
from kinematics.faults.other_causes import Cause, other_causes
from kinematics.faults.rounds import Round, null_fit
from kinematics.faults.scores import pattern_gain
from kinematics.faults.unstated_noise import amplitude_noise, line_residuals
from kinematics.fit.noise import assumed_sd
from kinematics.fit.rigid_fit import LineFit
from kinematics.joint.estimate import State
from kinematics.joint.expected import ChannelError, Layout, laser_numbers, stated_errors
from kinematics.joint.noise_levels import LEAST_FREEDOM, digits_spread
from kinematics.joint.pack import Readings
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array

LEAST_LOG_P = -25.0
"""Logarithm of a probability above which a finding may come from correlated noise of computed axes: that of
three beams 20 degrees off their axis, each with a noise of its own, made -14 in simulated exports."""
_EXACT = 1e-9  # residuals over values of data without noise, whose rounding is no evidence of faults
_LEAST_CHANNELS = 8  # that are left, to tell more than the six motions
_ROBUST_ROUNDS = (10, 10)  # of least absolute and of redescending weights of points
_OFF = 1.5  # residuals of a point over its noise from which on it may be one that does not agree


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with the readings of a body.

    Attributes
    ----------
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

    def with_finding(self, finding: Finding) -> Diagnosis:
        """Return the diagnosis with one finding more."""
        last = null_fit(_believed(self.last, finding), self.last.layout)
        return replace(self, findings=(*self.findings, finding), last=last)


def diagnose(
    body: BodyChannels,
    fits: Sequence[LineFit],
    freq_hz: Array,
    errors: Sequence[ChannelError] | None = None,
    line_spread: float = 1.0,
) -> Diagnosis:
    """Search the readings of a body for faults.

    Parameters
    ----------
    body : BodyChannels
        Channels that hold nothing are NaN.
    fits : sequence of LineFit, (r,)
        Of its runs, with their noise.
    errors : sequence of ChannelError, optional
        That are expected; those of data sheets and of stated positions unless given.
    line_spread : float
        Factor by which the variance of slowly varying sums exceeds that of independent lines.
    """
    errors = stated_errors([body]) if errors is None else errors
    layout = Layout(body.points, laser_numbers(body.directions), tuple(errors))
    assumed = [assumed_sd(body, run) for run in range(len(fits))]
    sd = assumed[0][None] if len(fits) == 1 else np.stack(assumed)
    known = digits_spread(body.sd) if body.sd is not None and body.is_noise_stated else None
    factor = float(np.sqrt(max(line_spread, 1.0)))
    if not body.is_noise_stated:  # of channels and over lines it is found anew, without faults
        factor *= float(np.median([np.median(fit.factor) for fit in fits]))
    readings = Readings.of(body.value, sd, freq_hz, body.arms_m, body.directions)
    readings = replace(readings, sd=factor * readings.sd, known=known)
    first = null_fit(readings, layout)
    read = int(np.count_nonzero(np.any(np.isfinite(readings.value), axis=1)))
    enough = read > max(len(fit.beams.dof) for fit in fits) and readings.value.shape[1] > 1
    nothing = Diagnosis((), np.zeros(len(body.points)), 1.0, first, first)
    if not enough or all(fit.solution.is_rounding(_EXACT) for fit in fits):
        return nothing
    level = _noise_level(first) if body.is_noise_stated else 1.0
    if level != 1.0:
        readings = replace(readings, known=None)
        first = null_fit(readings, layout)
    grows = None if first.clean() else amplitude_noise(readings, State(first.packed))
    if grows is not None:
        first = null_fit(replace(grows, known=None), layout)
    found, last = _search(first)
    least = min((finding.log_p for finding in found), default=0.0)
    if not body.is_noise_stated and least >= LEAST_LOG_P and _has_computed_axes(body):
        found, last = [], first
    chances = first.channel_log_p()
    sound = np.setdiff1d(last.live, [channel for one in found for channel in one.channels])
    chances[sound] = last.channel_log_p()[sound]
    causes = other_causes(first) if any(finding.kind == "flexible" for finding in found) else []
    last = next((cause.last for cause in causes if cause.last is not None), last)
    return Diagnosis(() if causes else tuple(found), chances, level, first, last, tuple(causes))


def _has_computed_axes(body: BodyChannels) -> bool:
    """Return whether every point was measured along three beams that are normal to each other.

    No three heads see one point so: a program computed the values from beams that lie closer together, and
    their noise is correlated within a point.
    """
    for point in dict.fromkeys(body.points):
        beams = body.directions[body.channels_of(point)]
        if len(beams) != 3 or np.max(np.abs(beams @ beams.T - np.eye(3))) > 1e-3:
            return False
    return True


def _noise_level(now: Round) -> float:
    """Return the noise over the stated one where all channels are louder or quieter alike, else 1."""
    energy, freedom = (part.sum(axis=0) for part in now.state.noise_energy)
    energy = energy * now.levels.level**2
    some = freedom > LEAST_FREEDOM
    if np.count_nonzero(some) < 3:
        return 1.0
    middle = float(np.median(energy[some] / freedom[some]))
    chance = float(np.median(2.0 / freedom[some] + (2.0 * now.levels.spread[some]) ** 2))
    spread = 1.25 * np.sqrt(chance / np.count_nonzero(some))
    if abs(np.log(middle)) < 5.0 * spread or pattern_gain(now.state, middle) > 0.0:
        return 1.0
    near = line_residuals(now.readings, State(now.packed)).level ** 2
    few = middle > 2.0 * near  # values far off are louder, not all
    return 1.0 if few else float(np.sqrt(middle))


def _search(first: Round) -> tuple[list[Finding], Round]:
    """Return what is wrong, and the round without it.

    More findings than a third of the points, at least two, mean that the body does not move as a rigid body.
    """
    most = max(2, len(set(first.layout.points)) // 3)
    now = first
    found: list[Finding] = []
    while not now.clean() and len(found) < most + 1:
        candidates = fit_candidates(now)
        if not candidates:
            break
        found.append(candidates[0])
        readings = _believed(now, candidates[0])
        if np.count_nonzero(np.isfinite(readings.noise_factor)) < _LEAST_CHANNELS:
            break
        now = null_fit(readings, now.layout)
    if len(found) > 1:
        others = _disagreeing(first)
        if others and others[1].clean() and (not now.clean() or _numbers(others[0]) < _numbers(found)):
            found, now = others
    if _bends(found, first, now):
        every = Place("body", tuple(range(len(first.layout.points))))
        log_p = min(first.log_whole, float(np.min(first.log_p, initial=0.0)))
        found = [Finding("flexible", every, log_p=log_p)]
    return found, now


def _numbers(found: Sequence[Finding]) -> int:
    """Return how many numbers findings take from the data."""
    return sum(one.count for one in found)


def _believed(now: Round, best: Finding) -> Readings:
    """Return the readings under a fault that is believed: corrected, louder, or without its channels."""
    readings, own = now.readings, best.channels
    changed = best.geometry
    if changed is not None:
        geometry = replace(readings.geometry, positions_m=changed.positions_m, directions=changed.directions)
        return replace(readings, geometry=geometry)
    if best.treatment == "noise":
        return readings.louder(own, float(best.values[0]))
    if best.treatment == "estimate":
        return readings.corrected(free(best.kind, own, len(now.layout.points)), best.values)
    return readings.louder(own)


def _disagreeing(first: Round) -> tuple[list[Finding], Round] | None:
    """Find the points without which the others agree, and what each has; None where half of them are off.

    Notes
    -----
    Each point has a noise of its own: the likelihood of such a model, found by iterated weights from the
    least sum of absolute sizes on, leaves few points with large noise (Holland and Welsch 1977,
    doi:10.1080/03610927708827533).
    """
    packed, points = first.packed, first.layout.by_point(first.live)
    level = np.ones(len(first.layout.points))
    size = dict.fromkeys(points, 1.0)
    for power, rounds in zip((0.5, 1.0), _ROBUST_ROUNDS, strict=True):
        for _ in range(rounds):
            state = State(packed.scaled(np.tile(level, (len(packed.y), 1))))
            energy = 2.0 * np.sum(np.abs(state.e) ** 2, axis=(0, 2)) * level**2
            count = 2.0 * np.sum((packed.w > 0.0) * packed.columns[:, None], axis=0)
            for point, own in points.items():
                size[point] = float(np.sqrt(np.sum(energy[own]) / np.sum(count[own]) / first.noise.level))
                level[own] = max(size[point], 1.0) ** power
    off = [point for point in points if size[point] > _OFF]
    left = len(first.live) - sum(len(points[point]) for point in off)
    if not 0 < 2 * len(off) < len(points) or left < _LEAST_CHANNELS:
        return None
    sound = first.readings.louder([channel for point in off for channel in points[point]])
    if not null_fit(sound, first.layout).clean():
        return None
    found: list[Finding] = []
    now = first
    for point in off:
        own = points[point]
        factor = sound.noise_factor.copy()
        factor[own] = first.readings.noise_factor[own]
        alone = null_fit(replace(sound, noise_factor=factor), first.layout)
        if not alone.clean():
            inside = [one for one in fit_candidates(alone) if set(one.channels) <= set(own)]
            if not inside:
                return None
            found.append(inside[0])
            now = replace(now, readings=_believed(now, inside[0]))
    return found, null_fit(now.readings, first.layout)


def _bends(found: Sequence[Finding], first: Round, last: Round) -> bool:
    """Return whether the body as a whole does not move as a rigid body.

    Nothing that was found makes the others agree; or several points are at fault, and one pattern over all
    channels explains as much with fewer numbers, as one shape of bending does.
    """
    if found and not last.clean():
        return True
    points = {first.layout.points[channel] for one in found for channel in one.channels}
    fall = (first.estimate.chi2 - last.estimate.chi2) / first.noise.level
    gain = 0.5 * (fall - _numbers(found) * float(np.log(first.packed.values)))
    return len(found) > 1 and len(points) > 1 and pattern_gain(first.state, first.noise.level) > gain

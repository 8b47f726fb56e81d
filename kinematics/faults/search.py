"""Search for faults: test all kinds at all places, fit the likeliest, believe one, and look again.

A round tests whether anything is wrong at all before it asks what (detection before identification). A fault
of a laser, of all beams or of names is corrected, a channel or point is left out, and the lines are packed
anew. Shapes: c channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kinematics.faults.elsewhere import Cause
from kinematics.faults.exchanges import Exchange, distinct, exchanges
from kinematics.faults.kinds import KINDS, SHARE, Finding, Place, free, places
from kinematics.faults.scores import Noise, Test, one_pattern, score_tests, structure
from kinematics.joint.estimate import Estimate, State, joint
from kinematics.joint.expected import Layout, Priors, expected_errors
from kinematics.joint.pack import Packed, Readings, pack
from kinematics.joint.tangents import DELAY, Parameters
from stapeskit.arrays import Array

ALARM = 0.01
"""Probability that a file without faults is given one (contract of the verdicts)."""
ALARM_SHARES = (0.6, 0.25, 0.1)
"""Shares of it of the tests of kinds, of the noise of channels, and of the sum of all squares. Tests of kinds
that contain each other are weighted as if each were alone and the owners independent (`SHARE`), which makes
1.1 times as many alarms (2 000 simulated files); the sum is 1.0."""

_REFLECTION = 0.25  # spread of noise between points, in natural logarithms: reflection and focus differ
_QUARTILES = 1.349  # distance of the quartiles of a normal distribution, in standard deviations
_FAR_SD = 3.0  # standard deviations from which on a channel is not one of the others
_LEAST_OWN = 1e-6  # share of a channel's noise in its residual
_NO_PATTERN = np.log(1e-3)
_LEAST_LEVEL_DOF = 200.0  # of a noise level apart from the motion: known to 5 %
_CHANCE_SD = 3.0  # standard deviations that the squares of values left out may differ from their mean
_LEVEL_ROUNDS = 2  # of the noise of channels: wrong weights put noise into the columns that hold the motion
_LEAST_EXPLAINED = 0.9  # of what leaving the channels out explains, for a kind to be believed
_CONTENDERS, _CLOSE = (
    4,
    0.02,
)  # candidates whose evidence is alike: fits to part of the columns differ so much
_CANDIDATES = {"channel": 3, "point": 2, "laser": 2, "body": 1}


@dataclass(frozen=True)
class Round:
    """The readings under what is believed so far, and the tests of what else may be wrong.

    Where noise is not stated, ``levels`` (c,) are that of each channel over the usual one, as assumed, and
    ``spread`` is the standard deviation of their logarithms.
    """

    readings: Readings
    layout: Layout
    packed: Packed
    expected: Parameters
    estimate: Estimate
    noise: Noise
    stated: bool
    tests: tuple[Test, ...]
    levels: Array | None = None
    spread: float = 0.0

    @property
    def state(self) -> State:
        """The motion with the expected errors."""
        return self.estimate.state

    @property
    def live(self) -> list[int]:
        """Channels in use."""
        return self.packed.live.tolist()

    @cached_property
    def log_p(self) -> Array:
        """Logarithm of the p-value of each test, weighted so that all together are one test (tests,)."""
        if not self.tests:
            return np.zeros(0)
        tail = self.noise.log_tail(
            np.array([test.statistic for test in self.tests]), np.array([test.freedom for test in self.tests])
        )
        owners = [test.place.owner for test in self.tests]
        number = {owner: owners.count(owner) / share for owner, share in SHARE.items()}
        return np.asarray(tail + np.log([number[owner] for owner in owners]))

    @cached_property
    def channel_noise(self) -> Array:
        """Logarithm of the probability that a channel is as loud as it is by chance, (c,); 0 if unknown."""
        from scipy.special import log_ndtr

        energy, freedom = self.state.channel_energy
        some = freedom > 8.0
        tail = self.noise.log_tail(energy, np.where(some, freedom, 1.0))
        if self.levels is not None:
            ratio = np.maximum(energy, 1e-300) / np.maximum(freedom, 1.0) / self.noise.level
            width = np.sqrt(self.spread**2 + 0.5 / np.maximum(freedom, 1.0))
            tail = log_ndtr(-(0.5 * np.log(ratio) + np.log(self.levels)) / width)
        return np.where(some, tail, 0.0)

    @cached_property
    def log_whole(self) -> float:
        """Logarithm of the probability of the sum of all squares."""
        if not self.stated:
            if not np.isfinite(self.noise.freedom) or not self.packed.turned:
                return 0.0
            return float(self.noise.log_tail(self.estimate.chi2, self.state.freedom))
        energy, freedom = self.state.noise_energy
        return float(
            self.noise.log_tail(self.estimate.chi2 + energy.sum(), self.state.freedom + freedom.sum())
        )

    @property
    def excess(self) -> float:
        """Squares beyond what noise makes."""
        return self.estimate.chi2 / self.noise.level - self.state.freedom

    def clean(self) -> bool:
        """Return whether nothing is wrong, at the level of alarms of `ALARM`."""
        loudest = float(np.min(self.channel_noise)) + np.log(max(len(self.live), 1))
        smallest = (float(np.min(self.log_p, initial=0.0)), loudest, self.log_whole)
        return all(log_p > np.log(ALARM * share) for log_p, share in zip(smallest, ALARM_SHARES, strict=True))


@dataclass(frozen=True)
class Candidate:
    """A fault that may explain the misfit.

    Attributes
    ----------
    evidence : float
        Log likelihood gained, less half the number of parameters times the logarithm of the number of values
        (Schwarz 1978, doi:10.1214/aos/1176344136).
    fall : float
        Fall of chi2.
    count : int
        Number of values that an omission takes away.
    """

    evidence: float
    fall: float
    kind: str
    place: Place
    values: Array
    exchange: Exchange | None = None
    count: int = 0


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


def null_fit(
    readings: Readings, layout: Layout, priors: Priors, stated: bool, noise: Noise | None = None
) -> Round:
    """Fit motion and expected errors, find the level of the noise, and test everything."""
    packed = pack(readings)
    live = packed.live.tolist()
    expected = expected_errors(layout, live, priors, float(np.mean(readings.freq_hz)))
    estimate = joint(packed, expected)
    levels, spread = None, 0.0
    if not stated:
        for _ in range(_LEVEL_ROUNDS):
            energy, freedom = _own_noise(estimate.state)
            levels, spread = channel_levels(energy if levels is None else energy * levels**2, freedom)
            packed = pack(replace(readings, noise_factor=readings.noise_factor * levels))
            estimate = joint(packed, expected, estimate.values)
        if packed.turned:
            packed = packed.scaled(_levels(estimate.state))
            estimate = joint(packed, expected, estimate.values)
    complete = len(live) == len(layout.points)
    tests = score_tests(estimate.state, expected, places(layout, live, complete))
    if noise is None:
        noise = Noise() if stated else _unknown_noise(estimate, tests)
    return Round(readings, layout, packed, expected, estimate, noise, stated, tuple(tests), levels, spread)


def _levels(state: State) -> Array:
    """Return the noise of each group over the assumed one, (G,): a parabola through its logarithm."""
    energy, freedom = (part.sum(axis=1) for part in state.noise_energy)
    some = freedom > 4.0
    if np.sum(freedom) < _LEAST_LEVEL_DOF or np.count_nonzero(some) < 4:
        whole = np.sum(energy) / max(np.sum(freedom), 1.0) if np.sum(freedom) > 0 else 1.0
        return np.full(len(energy), np.sqrt(max(whole, 1e-300)))
    logs = np.log(np.maximum(energy[some], 1e-300) / freedom[some]) + 1.0 / freedom[some]
    base = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(energy)), 2)
    root = np.sqrt(freedom[some])
    course = np.linalg.lstsq(base[some] * root[:, None], logs * root, rcond=None)[0]
    return np.asarray(np.exp(0.5 * base @ course))


def _own_noise(state: State) -> tuple[Array, Array]:
    """Return the energy of each channel that does not follow the motion, and its degrees of freedom, (c,).

    In lines of their own, what is proportional to the motion at all lines is subtracted from the residuals.
    """
    if state.packed.turned:
        energy, freedom = state.noise_energy
        return energy.sum(axis=0), freedom.sum(axis=0)
    motion = state.motion[:, :, 0]
    channels = state.packed.w.shape[1]
    energy, freedom = np.zeros(channels), np.zeros(channels)
    for channel in state.packed.live:
        used = np.flatnonzero(state.packed.w[:, channel] > 0.0)
        own = float(np.mean(1.0 - state.leverage[used, channel]))
        if len(used) > 2 * motion.shape[1] and own > _LEAST_OWN:
            course = np.linalg.qr(motion[used] * state.packed.w[used, channel, None])[0]
            rest = state.e[used, channel, 0]
            rest = rest - course @ (course.conj().T @ rest)
            energy[channel] = 2.0 * float(np.sum(np.abs(rest) ** 2)) / own
            freedom[channel] = 2.0 * (len(used) - course.shape[1])
    return energy, freedom


def channel_levels(energy: Array, freedom: Array) -> tuple[Array, float]:
    """Return the noise of channels over the usual one, (c,), and the standard deviation of its logarithm.

    Notes
    -----
    Levels are shrunk towards the middle one (Efron and Morris 1975, doi:10.1080/01621459.1975.10479864) by
    the scatter of the middle half of channels, which a faulty one does not move, and which is at least that
    of reflecting surfaces. A channel far off keeps the usual level: that it is louder is then for the search.
    """
    some = freedom > 8.0
    levels = np.ones(len(freedom))
    if np.count_nonzero(some) < 2:
        return levels, _REFLECTION
    logs = 0.5 * np.log(np.maximum(energy[some], 1e-300) / freedom[some])
    logs -= np.median(logs)
    chance = 0.5 / freedom[some]
    width = float(np.diff(np.quantile(logs, [0.25, 0.75]))[0]) / _QUARTILES
    spread = max(float(np.sqrt(max(width**2 - float(np.median(chance)), 0.0))), _REFLECTION)
    shrunk = logs * spread**2 / (spread**2 + chance)
    levels[some] = np.exp(np.where(np.abs(logs) < _FAR_SD * np.sqrt(spread**2 + chance), shrunk, 0.0))
    return levels, spread


def _unknown_noise(estimate: Estimate, tests: Sequence[Test]) -> Noise:
    """Return the level of noise that is not stated: from columns without motion, else from what is left."""
    state = estimate.state
    energy, freedom = (float(part.sum()) for part in state.noise_energy)
    if freedom < _LEAST_LEVEL_DOF:
        top = max(tests, key=lambda test: test.statistic / max(test.freedom, 1), default=None)
        taken = (top.statistic, top.freedom) if top else (0.0, 0)
        energy += max(estimate.chi2 - taken[0], 0.0)
        freedom += max(state.freedom - taken[1], 1)
    return Noise(max(energy, 1e-300) / max(freedom, 1.0), freedom)


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


def noise_level(now: Round) -> float:
    """Return the noise over the stated one where all channels are louder or quieter alike, else 1."""
    energy, freedom = now.state.noise_energy
    energy, freedom = energy.sum(axis=0), freedom.sum(axis=0)
    some = freedom > 8.0
    if np.count_nonzero(some) < 3:
        return 1.0
    ratio = energy[some] / freedom[some]
    middle = float(np.median(ratio))
    spread = 1.25 * np.sqrt(2.0 / np.median(freedom[some]) / np.count_nonzero(some))
    if abs(np.log(middle)) < 5.0 * spread or structure(now.state, middle) < _NO_PATTERN:
        return 1.0
    return float(np.sqrt(middle))


def fit_candidates(now: Round) -> list[Candidate]:
    """Fit the faults whose tests or whose omission explain most, the likeliest first."""
    flat_packed = now.packed.merged(now.state.motion)
    static = now.expected.part(now.expected.tangent != DELAY)
    flat = joint(flat_packed, static) if flat_packed is not now.packed else now.estimate
    static = static if flat_packed is not now.packed else now.expected
    number = np.log(now.packed.values)
    candidates: list[Candidate] = []
    unlike: list[Candidate] = []
    suspects: list[int] = []
    order = np.argsort(now.log_p)
    for owner, count in _CANDIDATES.items():
        tests = [now.tests[k] for k in order if now.tests[k].place.owner == owner]
        own = list(dict.fromkeys(test.place for test in tests))
        leave = {place: _leave_out(flat.state, place) for place in own}
        chosen = own[:count] + sorted(own, key=lambda place: -leave[place])[:count]
        for place in dict.fromkeys(chosen):
            kinds = [test.kind for test in tests if test.place == place]
            fits = [_fitted(now, flat, static, kind, place, number) for kind in kinds]
            candidates += fits
            if owner in ("channel", "point"):
                suspects += place.channels
                unlike.append(_unlike_others(place, leave[place], now, flat.state))
    candidates = [one for one in candidates if one.kind in KINDS and _explains(one, unlike, now.noise.level)]
    candidates += [
        one for one in unlike if not any(_replaces(named, one, now.noise.level) for named in candidates)
    ]
    candidates += _exchanged(now, flat, static, suspects)
    candidates += _louder(now, number)
    candidates.sort(key=lambda candidate: -candidate.evidence)
    return _refined(now, candidates, number)


def _explains(named: Candidate, unlike: Sequence[Candidate], level: float) -> bool:
    """Return whether a kind explains about what leaving its channels out does."""
    return all(_replaces(named, one, level) for one in unlike if one.place == named.place)


def _replaces(named: Candidate, unlike: Candidate, level: float) -> bool:
    """Return whether a kind at some of the channels explains about what leaving all of them out does."""
    if not set(named.place.channels) <= set(unlike.place.channels):
        return False
    own = unlike.fall / level - unlike.count
    return named.fall / level >= _LEAST_EXPLAINED * own - _CHANCE_SD * np.sqrt(2.0 * unlike.count)


def _refined(now: Round, candidates: list[Candidate], number: float) -> list[Candidate]:
    """Fit the likeliest kinds to all lines where several are about as likely, and sort them anew."""
    if len(candidates) < 2 or candidates[0].kind not in KINDS:
        return candidates
    close = [
        one
        for one in candidates[:_CONTENDERS]
        if one.kind in KINDS and one.evidence > (1.0 - _CLOSE) * candidates[0].evidence - number
    ]
    refined = []
    for one in close if len(close) > 1 else ():
        fit = _whole_fit(now, one)
        fall = now.estimate.chi2 - fit.chi2
        count = len(one.values)
        evidence = 0.5 * fall / now.noise.level - 0.5 * count * number
        refined.append(replace(one, evidence=evidence, fall=fall, values=fit.values[:count]))
    refined.sort(key=lambda candidate: -candidate.evidence)
    return refined + [one for one in candidates if not refined or one not in close]


def _whole_fit(now: Round, one: Candidate) -> Estimate:
    """Fit a kind to all lines, from the values of the candidate."""
    parameters = free(one.kind, one.place.channels, len(now.layout.points)) + now.expected
    return joint(now.packed, parameters, np.concatenate([one.values, np.zeros(len(now.expected))]))


def _leave_out(state: State, place: Place) -> float:
    """Return the fall of chi2 when channels are left out; 0 where they are too many."""
    return state.leave_out(place.channels) if 2 * len(place.channels) < len(state.packed.live) else 0.0


def _unlike_others(place: Place, fall: float, now: Round, flat: State) -> Candidate:
    """Return the candidate that these channels read something else than the motion of the others."""
    count = _unlike_count(place, flat)
    evidence = 0.5 * fall / now.noise.level - 0.5 * count * np.log(now.packed.values)
    return Candidate(evidence, fall, "elsewhere", place, np.zeros(0), count=count)


def _unlike_count(place: Place, flat: State) -> int:
    """Return the number of real values that channels read in all columns."""
    used = flat.packed.w[:, list(place.channels)] > 0.0
    return int(2 * np.sum(used * flat.packed.columns[:, None]))


def _fitted(
    now: Round, flat: Estimate, static: Parameters, kind: str, place: Place, number: float
) -> Candidate:
    """Fit a kind at a place: what is the same at all lines in one group of columns."""
    null, expected = (now.estimate, now.expected) if KINDS[kind].courses else (flat, static)
    packed = null.state.packed
    parameters = free(kind, place.channels, len(now.layout.points))
    count = len(parameters)
    start = np.concatenate([np.zeros(count), null.values])
    if kind in ("gain", "phase", "drift"):
        reverse = np.zeros(len(start))
        reverse[0] = -2.0
        moved = packed.geometry.moved(parameters + expected, reverse, packed.tau, packed.rho)
        start = reverse if State(packed, moved).energy < State(packed).energy else start
    fit = joint(packed, parameters + expected, start)
    fall = null.chi2 - fit.chi2
    return Candidate(
        0.5 * fall / now.noise.level - 0.5 * count * number, fall, kind, place, fit.values[:count]
    )


def _exchanged(now: Round, flat: Estimate, static: Parameters, suspects: Sequence[int]) -> list[Candidate]:
    """Fit the likeliest exchanges of names."""
    packed = flat.state.packed
    geometry = packed.geometry
    some = [one for one in exchanges(geometry, now.layout, now.live, suspects) if distinct(one, geometry)]
    some.sort(key=lambda one: State(packed, one.geometry).energy)
    found = []
    for one in some[:3]:
        fit = joint(packed, static, geometry=one.geometry)
        fall = flat.chi2 - fit.chi2
        evidence = 0.5 * fall / now.noise.level - np.log(len(set(now.layout.points)))
        found.append(Candidate(evidence, fall, "label_swap", Place(one.what, one.channels), np.zeros(0), one))
    return found


def _louder(now: Round, number: float) -> list[Candidate]:
    """Return the candidates of channels that are louder than stated, by their likelihood."""
    energy, freedom = now.state.channel_energy
    found = []
    for channel in now.live:
        ratio = energy[channel] / now.noise.level / max(freedom[channel], 1e-9)
        if freedom[channel] > 8.0 and ratio > 1.0:
            gain = 0.5 * freedom[channel] * (ratio - 1.0 - np.log(ratio)) - 0.5 * number
            place = Place("channel", (channel,))
            found.append(Candidate(gain, 0.0, "noise", place, np.array([np.sqrt(ratio)])))
    return found


def _finding(now: Round, best: Candidate) -> Finding:
    """Return what is believed, with its size under all lines."""
    own = best.place.channels
    sd = np.zeros(len(best.values))
    values = best.values
    log_p = float(now.noise.log_tail(max(best.fall, 0.0), max(len(values), 1)))
    if best.kind in KINDS:
        fit = _whole_fit(now, best)
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

"""Fit the faults that may explain a misfit, and weigh them by their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.exchanges import Exchange, distinct, exchanges
from kinematics.faults.kinds import KINDS, Place, free
from kinematics.faults.rounds import Round
from kinematics.joint.estimate import Estimate, State, joint
from kinematics.joint.tangents import DELAY, Parameters
from stapeskit.arrays import Array

_CHANCE_SD = 3.0  # standard deviations that the squares of values left out may differ from their mean
_LEAST_EXPLAINED = 0.9  # of what leaving the channels out explains, for a kind to be believed
_CONTENDERS, _CLOSE = 4, 0.02  # candidates with evidence so near: fits to part of the columns differ so much
_CANDIDATES = {"channel": 3, "point": 2, "laser": 2, "body": 1}


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
        fit = whole_fit(now, one)
        fall = now.estimate.chi2 - fit.chi2
        count = len(one.values)
        evidence = 0.5 * fall / now.noise.level - 0.5 * count * number
        refined.append(replace(one, evidence=evidence, fall=fall, values=fit.values[:count]))
    refined.sort(key=lambda candidate: -candidate.evidence)
    return refined + [one for one in candidates if not refined or one not in close]


def whole_fit(now: Round, one: Candidate) -> Estimate:
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

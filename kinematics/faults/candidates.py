"""Fit the faults that may explain a misfit, and weigh them by their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kinematics.faults.exchanges import Exchange, exchanges
from kinematics.faults.kinds import Place, free
from kinematics.faults.rounds import Round
from kinematics.joint.estimate import State, joint
from stapeskit.arrays import Array

_CHANCE_SD = 3.0  # standard deviations that the squares of values left out may differ from their mean
_LEAST_EXPLAINED = 0.9  # of what leaving the channels out explains, for a kind to be believed
_CANDIDATES = {"channel": 3, "point": 2, "laser": 2, "body": 1}
_MOST_EXCHANGES = 3  # that are fitted in full: the most likely by their score, for time only


@dataclass(frozen=True)
class Candidate:
    """A fault that may explain the misfit.

    Attributes
    ----------
    kind : str
        Of `kinds.Finding`.
    place : Place
    evidence : float
        Of `Round.evidence`.
    fall : float
        Fall of chi2.
    values, sd : ndarray, (k,)
        Size, in units of the tangents of the kind; of noise its factor.
    count : int
        Number of values that an omission takes away.
    exchange : Exchange or None
    """

    kind: str
    place: Place
    evidence: float
    fall: float = 0.0
    values: Array = field(default_factory=lambda: np.zeros(0))
    sd: Array = field(default_factory=lambda: np.zeros(0))
    count: int = 0
    exchange: Exchange | None = None


def fit_candidates(now: Round) -> list[Candidate]:
    """Fit the faults whose tests or whose omission explain most, the likeliest first."""
    fitted: list[Candidate] = []
    unlike: list[Candidate] = []
    for owner, most in _CANDIDATES.items():
        tests = [now.tests[k] for k in np.argsort(now.log_p) if now.tests[k].place.owner == owner]
        places = list(dict.fromkeys(test.place for test in tests))
        without = {place: _unlike_others(now, place) for place in places}
        largest = sorted(places, key=lambda place: -without[place].fall)
        for place in dict.fromkeys(places[:most] + largest[:most]):
            fitted += [_fitted(now, test.kind, place) for test in tests if test.place == place]
            if owner in ("channel", "point"):
                unlike.append(without[place])
    level = now.noise.level
    named = [
        one for one in fitted
        if all(_replaces(one, other, level) for other in unlike if other.place == one.place)
    ]  # fmt: skip
    unlike = [one for one in unlike if not any(_replaces(kind, one, level) for kind in named)]
    suspects = [channel for place in _places_tried(fitted) for channel in place.channels]
    found = [*named, *unlike, *_exchanged(now, suspects), *_louder(now)]
    return sorted(found, key=lambda candidate: -candidate.evidence)


def _places_tried(fitted: Sequence[Candidate]) -> list[Place]:
    """Return the channels and points that were tried."""
    return [one for one in dict.fromkeys(c.place for c in fitted) if one.owner in ("channel", "point")]


def _replaces(named: Candidate, unlike: Candidate, level: float) -> bool:
    """Return whether a kind at some of the channels explains about what leaving all of them out does."""
    if not set(named.place.channels) <= set(unlike.place.channels):
        return False
    own = unlike.fall / level - unlike.count
    return named.fall / level >= _LEAST_EXPLAINED * own - _CHANCE_SD * np.sqrt(2.0 * unlike.count)


def _unlike_others(now: Round, place: Place) -> Candidate:
    """Return the candidate that these channels do not follow the motion of the others."""
    packed = now.packed
    few = 2 * len(place.channels) < len(packed.live)
    fall = now.state.leave_out(place.channels) if few else 0.0
    used = packed.w[:, list(place.channels)] > 0.0
    count = int(2 * np.sum(used * packed.columns[:, None]))
    return Candidate("elsewhere", place, now.evidence(fall, count), fall, count=count)


def _fitted(now: Round, kind: str, place: Place) -> Candidate:
    """Fit a kind at a place; factors from the reversed sign where that fits better."""
    packed = now.packed
    parameters = free(kind, place.channels, len(now.layout.points))
    count = len(parameters)
    start = np.concatenate([np.zeros(count), now.estimate.values])
    if kind in ("gain", "phase", "drift"):
        reverse = np.zeros(len(start))
        reverse[0] = -2.0
        moved = packed.geometry.moved(parameters + now.expected, reverse, packed.tau, packed.rho)
        start = reverse if State(packed, moved).energy < State(packed).energy else start
    fit = joint(packed, parameters + now.expected, start)
    fall = now.estimate.chi2 - fit.chi2
    sd = np.sqrt(np.maximum(np.diag(fit.covariance)[:count] * now.noise.level, 0.0))
    return Candidate(kind, place, now.evidence(fall, count), fall, fit.values[:count], sd)


def _exchanged(now: Round, suspects: Sequence[int]) -> list[Candidate]:
    """Fit the likeliest exchanges of names."""
    packed = now.packed
    some = exchanges(packed.geometry, now.layout, now.live, suspects)
    some.sort(key=lambda one: State(packed, one.geometry).energy)
    found = []
    for one in some[:_MOST_EXCHANGES]:
        fall = now.estimate.chi2 - joint(packed, now.expected, geometry=one.geometry).chi2
        evidence = now.evidence(fall, 0) - np.log(len(set(now.layout.points)))
        found.append(Candidate("label_swap", Place(one.what, one.channels), evidence, fall, exchange=one))
    return found


def _louder(now: Round) -> list[Candidate]:
    """Return the candidates of channels that are louder than stated, by their likelihood."""
    energy, freedom = now.state.channel_energy
    found = []
    for channel in now.live:
        ratio = energy[channel] / now.noise.level / max(freedom[channel], 1e-9)
        if now.levels is not None:
            ratio *= now.levels[channel] ** 2
        if freedom[channel] > 8.0 and ratio > 1.0:
            fall = energy[channel] * (1.0 - 1.0 / ratio)
            evidence = now.evidence(fall, 1) - 0.5 * freedom[channel] * np.log(ratio)
            if now.levels is not None:
                evidence = -now.channel_noise[channel] - 0.5 * np.log(now.packed.values)
            size = np.array([np.sqrt(ratio)])
            sd = size / np.sqrt(2.0 * freedom[channel])
            found.append(Candidate("noise", Place("channel", (channel,)), evidence, 0.0, size, sd))
    return found

"""Fit the faults that may explain a misfit, exchanged names among them, and weigh them by their evidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from kinematics.faults.fault_kinds import Finding, Place, free, places
from kinematics.faults.rounds import Round
from kinematics.joint.estimate import State, joint
from kinematics.joint.tangents import Geometry

_CHANCE_SD = 3.0  # standard deviations that the squares of values left out may differ from their mean
_LEAST_EXPLAINED = 0.9  # of what leaving the channels out explains, for a kind to be believed
_CANDIDATES = {"channel": 3, "point": 2, "laser": 3, "body": 1}
_MOST_EXCHANGES = 3  # that are fitted in full: the most likely by their score, for time only


def fit_candidates(now: Round) -> list[Finding]:
    """Fit the faults whose tests or whose omission explain most, the likeliest first."""
    fitted: list[Finding] = []
    unlike: list[Finding] = []
    for owner, most in _CANDIDATES.items():
        tests = [now.tests[k] for k in np.argsort(now.log_p) if now.tests[k].place.owner == owner]
        places = list(dict.fromkeys(test.place for test in tests))
        without = {place: _unlike_others(now, place) for place in places}
        largest = sorted(places, key=lambda place: -without[place].fall)
        for place in dict.fromkeys(places[:most] + largest[:most]):
            fitted += [_fitted(now, test.kind, place) for test in tests if test.place == place]
            if owner in ("channel", "point"):
                unlike.append(without[place])
    named = [
        one for one in fitted
        if all(_replaces(now, one, other) for other in unlike if other.place == one.place)
    ]  # fmt: skip
    suspects = [channel for one in unlike for channel in one.channels]
    unlike = [one for one in unlike if not any(_replaces(now, kind, one) for kind in named)]
    found = [*named, *unlike, *_exchanged(now, suspects), *_louder(now)]
    return sorted(found, key=lambda one: -one.evidence)


def _replaces(now: Round, named: Finding, unlike: Finding) -> bool:
    """Return whether a kind at some of the channels explains about what leaving all of them out does."""
    if not set(named.channels) <= set(unlike.channels):
        return False
    own = unlike.fall / now.noise.level - unlike.count
    chance = _CHANCE_SD * np.sqrt(2.0 * unlike.count)
    return bool(named.fall / now.noise.level >= _LEAST_EXPLAINED * own - chance)


def _unlike_others(now: Round, place: Place) -> Finding:
    """Return the finding that these channels do not follow the motion of the others."""
    packed, own = now.packed, list(place.channels)
    errors, state = now.believed
    before = state.energy + float(now.expected.prior @ errors**2)
    fall = 0.0
    if 2 * len(own) < len(now.live):
        fall = now.estimate.chi2 - before + state.leave_out(own)
    count = int(2 * np.sum((packed.w[:, own] > 0.0) * packed.columns[:, None]))
    log_p = float(now.noise.log_tail(max(fall, 0.0), max(count, 1)))
    return Finding(
        "elsewhere", place, log_p=log_p, evidence=now.evidence(fall, count), fall=fall, count=count
    )


def _fitted(now: Round, kind: str, place: Place) -> Finding:
    """Fit a kind at a place; factors from the reversed sign where that fits better."""
    packed = now.packed
    parameters = free(kind, place.channels, len(now.layout.points))
    count = len(parameters)
    start = np.concatenate([np.zeros(count), now.believed[0]])
    if kind in ("gain", "phase", "drift"):
        reverse = np.zeros(len(start))
        reverse[0] = -2.0
        moved = packed.geometry.moved(parameters + now.expected, reverse, packed.tau, packed.omega)
        start = reverse if State(packed, moved).energy < State(packed).energy else start
    fit = joint(packed, parameters + now.expected, start)
    fall = now.estimate.chi2 - fit.chi2
    sd = np.sqrt(np.maximum(np.diag(fit.covariance)[:count] * now.noise.level, 0.0))
    log_p = float(now.noise.log_tail(max(fall, 0.0), count))
    return Finding(kind, place, fit.values[:count], sd, log_p, now.evidence(fall, count), fall, count)


def _exchanged(now: Round, suspects: Sequence[int]) -> list[Finding]:
    """Fit the likeliest exchanges of names."""
    some = sorted(_exchanges(now, suspects), key=lambda one: State(now.packed, one[1]).energy)
    found = []
    for place, geometry in some[:_MOST_EXCHANGES]:
        fall = now.estimate.chi2 - joint(now.packed, now.expected, geometry=geometry).chi2
        evidence = now.evidence(fall, 0) - float(np.log(len(set(now.layout.points))))
        log_p = float(now.noise.log_tail(max(fall, 0.0), 1))
        found.append(
            Finding("label_swap", place, log_p=log_p, evidence=evidence, fall=fall, geometry=geometry)
        )
    return found


def _exchanges(now: Round, suspects: Sequence[int]) -> Iterator[tuple[Place, Geometry]]:
    """Yield the exchanges in which a suspected channel takes part, and that change anything.

    Two points change places when they have equally many channels: their positions alone (names in points.csv)
    or with their beams (names of rows). Two lasers change with all their channels, two beams at one point.
    """
    points, given = now.layout.by_point(now.live), now.packed.geometry
    names = {now.layout.points[channel] for channel in suspects} & set(points)
    pairs = [
        (what, points[one], points[other])
        for one, other in combinations(points, 2)
        if one in names or other in names
        for what in ("points", "rows")
    ]
    pairs += [("beams", [a], [b]) for name in names for a, b in combinations(points[name], 2)]
    pairs += [("lasers", *pair) for pair in combinations(now.layout.by_laser(now.live).values(), 2)]
    seen = {_key(given)}
    for what, one, other in pairs:
        if len(one) != len(other):
            continue
        positions, directions = given.positions_m.copy(), given.directions.copy()
        if what in ("points", "rows"):
            positions[one], positions[other] = given.positions_m[other[0]], given.positions_m[one[0]]
        if what != "points":
            directions[one], directions[other] = given.directions[other], given.directions[one]
        changed = replace(given, positions_m=positions, directions=directions)
        if _key(changed) not in seen:
            seen.add(_key(changed))
            yield Place("points" if what == "rows" else what, (*one, *other)), changed


def _key(geometry: Geometry) -> bytes:
    """Return a key that is equal for geometries equal within 1 nm and 1 urad."""
    whole = np.hstack([geometry.positions_m * 1e9, geometry.directions * 1e6])
    return bytes((np.round(whole) + 0.0).tobytes())


def _louder(now: Round) -> list[Finding]:
    """Return channels, points and lasers that are louder than stated or than the others, by likelihood."""
    energy, freedom = now.state.channel_energy
    found = []
    for place in places(now.layout, now.live):
        own = list(place.channels)
        if place.owner == "body" or not np.all(now.loudness[own] > 1.0):
            continue
        share = freedom[own] / np.sum(freedom[own])
        ratio = float(share @ now.loudness[own])
        # one factor for all must describe them as well as one each does, by the criterion of Schwarz
        apart = float(freedom[own] @ (np.log(ratio) - np.log(now.loudness[own])))
        if apart > (len(own) - 1) * np.log(now.packed.values):
            continue
        # of several channels that are louder alike, the sum of their log probabilities
        log_p = float(np.sum(now.channel_noise[own]))
        evidence = -log_p - 0.5 * float(np.log(now.packed.values))
        if not now.levels.spread.any():
            fall = float(np.sum(energy[own])) * (1.0 - 1.0 / ratio)
            evidence = now.evidence(fall, 1) - 0.5 * float(np.sum(freedom[own])) * float(np.log(ratio))
        size = np.array([np.sqrt(ratio)])
        sd = size / np.sqrt(2.0 * np.sum(freedom[own]))
        found.append(Finding("noise", place, size, sd, log_p, evidence, count=1))
    return found

"""Find which channel, point or body does not fit a rigid motion, and what is wrong with it.

The lines are packed first (faults/packed). Score tests of every kind of fault at every place,
corrected for their number, say whether anything is wrong; the most significant suspects are then fitted and
weighed by their evidence. The culprit is left out, or corrected where all beams are concerned, and the search
repeated, so that one culprit is not blamed on its neighbours; with several culprits each is judged again at
the end with the others gone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.adequate import account_for_it, corrected
from kinematics.faults.fault_model import solve
from kinematics.faults.findings import Finding, can_lose
from kinematics.faults.masked import masked_pair
from kinematics.faults.noise.unknown_noise import evened
from kinematics.faults.packed.compact import Compact
from kinematics.faults.packed.mixing import Mixing, block_covariance, by_chance, scaled
from kinematics.faults.refilling import filled_freely, refilled
from kinematics.faults.scattered import scattered
from kinematics.faults.search import FALSE_ALARM, Search
from kinematics.faults.structure import Structure
from kinematics.fit.beams import BeamSet

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_BESIDE = 0.1
_REFILLS = 3


@dataclass(frozen=True)
class Diagnosis:
    """What was found in one body and run.

    Attributes
    ----------
    findings : tuple of Finding
        One per culprit; empty when the body moves rigidly within its noise.
    energy : ndarray, (channel,)
        Leverage-corrected mean residual energy of each channel in units of its stated noise, with the
        culprits left out for the other channels.
    level : float
        Median of the energies that remain: 1 when the stated noise is right.
    level_p : float
        Probability of so large a total residual of the remaining channels under the stated noise.
    structure : Structure
        Of the residuals that remain.
    lines : ndarray, (channel,)
        Number of complex values behind each energy.
    offsets_m : ndarray, (channel, 3)
        Position errors, within their stated sd, that were allowed for.
    kept : float
        Share of the misfit beyond noise that the first finding leaves by itself, 0 to 1; 1 without a finding,
        when that concerns all beams, and when the body is not rigid; 0 for two faults that hid each other.
    """

    findings: tuple[Finding, ...]
    energy: Array
    level: float
    level_p: float
    structure: Structure
    lines: NDArray[np.int64]
    offsets_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    kept: float = 1.0

    @property
    def level_matters(self) -> bool:
        """Whether the level is known well enough to differ from 1."""
        return float(np.sum(self.lines)) * (self.level - 1.0) ** 2 > 16.0


def diagnose(
    data: Compact,
    position_sd_m: Array,
    noise_known: bool = True,
    alarm: float = FALSE_ALARM,
    bounded: bool = False,
) -> Diagnosis:
    """Search one body in one run for faults.

    Parameters
    ----------
    data : Compact
    position_sd_m : ndarray, (channel,)
        Stated standard deviation of the point positions, m; NaN or zero when not stated.
    noise_known : bool
        The sd are absolute; otherwise only their ratios mean something.
    alarm : float
        Probability of any finding in clean data. One beside others must be surer by a factor of ten: what
        remains holds the errors of their estimates.
    """
    prior = np.where(np.isfinite(position_sd_m), position_sd_m, 0.0)
    most = max(2, len(set(data.points)) // 3)
    doubt = None
    if not noise_known:
        data, doubt = evened(data, prior)
    data = data if bounded else _mixed(data)
    findings: list[Finding] = []
    current = data
    searches: list[Search] = []

    def searched(some: Compact) -> Search:
        return Search(some, prior, noise_known, alarm, doubt)

    while True:
        search = Search(current, prior, noise_known, _BESIDE * alarm if findings else alarm, doubt)
        searches.append(search)
        found = search.best()
        if found is None:
            break
        if filled_freely(current) or (found.kind == "flexible" and current.source.filled is not None):
            for suspect in [found] if found.fit is not None else found.rivals:
                better, filled, again = _refilled(current, prior, noise_known, alarm, doubt, suspect)
                if again is not None:
                    found, current, searches[-1] = better, filled, again
                    data = data if findings else filled
                    break
        if found.kind == "flexible":
            found = _explained(current, prior, noise_known, alarm, doubt, found)
        if found.kind == "flexible" or len(findings) >= most:
            body = found if not findings and found.kind == "flexible" else searches[0].flexible()
            spread = scattered(searches[0], prior, doubt, findings)
            pair = None if spread is not None else masked_pair(searches[0], data, searched)
            if pair is not None:
                return _made(tuple(pair[0]), searches[0], pair[1], data, 0.0)
            return _made((spread or body,), searches[0], search, data)
        findings = _joined(findings, found)
        current = cleared(current, found)
        if not noise_known and found.kind != "noise" and current.mixing is None:
            current, doubt = evened(current, prior)
    if findings and searches[0].structure.significant:
        after = Search(corrected(data, findings), prior, noise_known, alarm, doubt)
        if not account_for_it(searches[0], after, findings):
            spread = scattered(searches[0], prior, doubt, findings)
            pair = None if spread is not None else masked_pair(searches[0], data, searched)
            if pair is not None:
                return _made(tuple(pair[0]), searches[0], pair[1], data, 0.0)
            return _made((spread or searches[0].flexible(),), searches[0], search, data)
    kept = 1.0
    if findings and findings[0].owner != "body":
        kept = searches[1].excess() / max(searches[0].excess(), 1e-300)
    if len(findings) > 1:
        spread = scattered(searches[0], prior, doubt, findings)
        if spread is not None:
            return _made((spread,), searches[0], searches[0], data)
        findings = _again(data, prior, noise_known, alarm, doubt, findings)
    return _made(tuple(findings), searches[0], search, data, kept)


def _refilled(
    data: Compact, prior: Array, noise_known: bool, alarm: float, doubt: Array | None, found: Finding
) -> tuple[Finding, Compact, Search | None]:
    """Return a finding with gaps filled by it, in turn until it stays, the data so, and their search.

    The search is None where it finds something else there.
    """
    filled, last = data, None
    for _ in range(_REFILLS):
        trial = refilled(data, found)
        search = Search(trial, prior, noise_known, alarm, doubt)
        better = search.best()
        if better is None or better.fit is None or set(better.channels) != set(found.channels):
            break
        settled = better.kind == found.kind and _settled(better, found)
        found, filled, last = better, trial, search
        if settled:
            break
    return found, filled, last


def _settled(one: Finding, two: Finding) -> bool:
    """Tell whether two estimates of a fault differ by less than half their standard deviations."""
    if one.fit is None or two.fit is None:
        return True
    moved = np.abs(one.fit.parameters - two.fit.parameters)
    return bool(np.all(moved <= 0.5 * np.sqrt(np.maximum(np.diag(one.fit.covariance), 0.0))))


def _explained(
    data: Compact, prior: Array, noise_known: bool, alarm: float, doubt: Array | None, found: Finding
) -> Finding:
    """Return a fault at one place that leaves nothing to be found, instead of a body that is not rigid."""
    for other in found.rivals:
        if Search(cleared(data, other), prior, noise_known, alarm, doubt).best() is None:
            return other
    return found


def _joined(findings: list[Finding], found: Finding) -> list[Finding]:
    """Return the findings with one more; noise of a channel found noisy before raises that one's."""
    for number, other in enumerate(findings):
        if found.kind == other.kind == "noise" and found.channels == other.channels:
            louder = replace(other, size=other.size * found.size)
            return [*findings[:number], louder, *findings[number + 1 :]]
    return [*findings, found]


def cleared(data: Compact, found: Finding) -> Compact:
    """Return the data without a finding: its channels left out, weakened, or corrected."""
    if found.kind == "noise":
        return data.weighted(found.channels, found.size).repacked()
    if found.fit is None:
        return data
    if found.owner in ("laser", "lasers", "body") or not can_lose(data, found.channels):
        return found.fit.fault.undone(data, found.fit.parameters).repacked()
    return data.without(found.channels).repacked()


def _mixed(data: Compact) -> Compact:
    """Return the data with the noise that the channels of each point are found to have in common."""
    state = solve(data)
    residual = state.rest()
    found = block_covariance(residual, state.project(), data.points, data.live)
    if found is None:
        return data
    shared = scaled(found, residual.shape[1])[0]
    if by_chance(shared, np.maximum(1.0 - state.h, 0.0), data.points, data.live, residual.shape[1]):
        return data
    return replace(data, mixing=Mixing.of(shared, data.live)).repacked()


def _again(
    data: Compact, prior: Array, noise_known: bool, alarm: float, doubt: Array | None, findings: list[Finding]
) -> list[Finding]:
    """Judge every finding again, the others gone."""
    made: list[Finding] = []
    for number, finding in enumerate(findings):
        others = data
        for other in [*made, *findings[number + 1 :]]:
            others = cleared(others, other)
        found = Search(others, prior, noise_known, alarm, doubt).best()
        if found is not None and set(found.channels) & set(finding.channels):
            made.append(found if found.kind != "flexible" else finding)
        elif found is not None:
            made.append(finding)
    return made


def _made(
    findings: tuple[Finding, ...], first: Search, last: Search, data: Compact, kept: float = 1.0
) -> Diagnosis:
    whole = any(finding.kind == "flexible" for finding in findings)
    energy = first.energy()
    if not whole:
        energy[last.live] = last.energy()[last.live]
    offsets = (first if whole else last).data.arms_m - (first if whole else last).raw.arms_m
    return Diagnosis(
        findings,
        energy,
        last.level,
        last.level_p(),
        (first if whole else last).structure,
        np.where(data.a > 0.0, data.y.shape[1] + data.rest.shape[1], 0),
        offsets,
        1.0 if whole else kept,
    )


def nothing_found(beams: BeamSet, sd: Array) -> Diagnosis:
    """Return the diagnosis of data that are too few to search."""
    count = len(beams.rows)
    return Diagnosis(
        (),
        np.ones(count),
        1.0,
        1.0,
        Structure(0.0, 1.0, True, 0.0, np.zeros(count)),
        np.sum(np.isfinite(sd), axis=1),
        np.zeros((count, 3)),
    )


__all__ = ["FALSE_ALARM", "Diagnosis", "Finding", "cleared", "diagnose", "nothing_found"]

"""Find which channel, point or body does not fit a rigid motion, and what is wrong with it.

The lines are packed first (kinematics.faults.compact). Score tests of every kind of fault at every place,
corrected for their number, say whether anything is wrong; the most significant suspects are then fitted and
weighed by their evidence. The culprit is left out, or corrected where all beams are concerned, and the search
repeated, so that one culprit is not blamed on its neighbours; with several culprits each is judged again at
the end with the others gone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.compact import Compact
from kinematics.faults.fault_model import solve
from kinematics.faults.findings import Finding, can_lose
from kinematics.faults.mixing import Mixing, axes_of, block_covariance, by_chance, scaled
from kinematics.faults.search import FALSE_ALARM, NOISY_UNKNOWN, Search
from kinematics.faults.structure import Structure
from kinematics.fit.beams import BeamSet

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


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
        when that concerns all beams, and when the body is not rigid.
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
    data: Compact, position_sd_m: Array, noise_known: bool = True, alarm: float = FALSE_ALARM
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
        Probability of any finding in clean data.
    """
    prior = np.where(np.isfinite(position_sd_m), position_sd_m, 0.0)
    most = max(2, len(set(data.points)) // 3)
    data = _mixed(data if noise_known else _even(_levelled(data)))
    findings: list[Finding] = []
    current = data
    searches: list[Search] = []
    while True:
        search = Search(current, prior, noise_known, alarm)
        searches.append(search)
        found = search.best()
        if found is None:
            break
        if found.kind == "flexible":
            found = _explained(current, prior, noise_known, alarm, found)
        if found.kind == "flexible" or len(findings) >= most:
            body = found if not findings and found.kind == "flexible" else searches[0].flexible()
            return _made((body,), searches[0], search, data)
        findings.append(found)
        current = cleared(current, found)
    kept = 1.0
    if findings and findings[0].owner != "body":
        kept = searches[1].excess() / max(searches[0].excess(), 1e-300)
    if len(findings) > 1:
        findings = _again(data, prior, noise_known, alarm, findings)
    return _made(tuple(findings), searches[0], search, data, kept)


def _explained(data: Compact, prior: Array, noise_known: bool, alarm: float, found: Finding) -> Finding:
    """Return a fault at one place that leaves nothing to be found, instead of a body that is not rigid."""
    for other in found.rivals:
        if Search(cleared(data, other), prior, noise_known, alarm).best() is None:
            return other
    return found


def cleared(data: Compact, found: Finding) -> Compact:
    """Return the data without a finding: its channels left out, weakened, or corrected."""
    if found.kind == "noise":
        return data.weighted(found.channels, found.size).repacked()
    if found.fit is None:
        return data
    if found.owner in ("laser", "lasers", "body") or not can_lose(data, found.channels):
        return found.fit.fault.undone(data, found.fit.parameters).repacked()
    return data.without(found.channels).repacked()


def _even(data: Compact) -> Compact:
    """Return data of unknown noise with weights by what the lines without motion show of each channel."""
    blank = np.zeros(len(data.points))
    search = Search(data, blank, False)
    if search.samples < 32 or search.level <= 0.0:
        return data
    if data.divisor.shape[1] > 1:
        size = np.abs(search.rest) ** 2
        level = [
            float(np.median(np.mean(size[search.live][:, data.rest_part == k], axis=1)))
            for k in range(data.divisor.shape[1])
        ]
        if min(level) > 0.0:
            data = data.levelled(np.array(level) / float(np.mean(level)))
            search = Search(data, blank, False)
    ratio = (search.ratios / search.level - search.h) / np.maximum(1.0 - search.h, 0.05)
    live = [c for c in data.live if ratio[c] < NOISY_UNKNOWN**2]
    a = data.a.copy()
    a[live] /= np.sqrt(np.maximum(ratio[live], 0.1))
    return replace(data, a=a / np.sqrt(search.level)).repacked()


def _levelled(data: Compact) -> Compact:
    """Return data of unknown noise whose beams along one axis have the noise that most of them have."""
    axes = axes_of(data.directions, data.live)
    if len(axes) < 2 or min(map(len, axes)) < 3:
        return data
    search = Search(data, np.zeros(len(data.points)), False)
    if search.samples < 32 or search.level <= 0.0:
        return data
    a = data.a.copy()
    for own in axes:
        a[own] /= np.sqrt(max(float(np.median(search.ratios[own])) / search.level, 1e-6))
    return replace(data, a=a).repacked()


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
    data: Compact, prior: Array, noise_known: bool, alarm: float, findings: list[Finding]
) -> list[Finding]:
    """Judge every finding again, the others gone."""
    made: list[Finding] = []
    for number, finding in enumerate(findings):
        others = data
        for other in [*made, *findings[number + 1 :]]:
            others = cleared(others, other)
        found = Search(others, prior, noise_known, alarm).best()
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

"""Gains that differ from channel to channel, or from point to point, all a little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.faults.noise_size import channel_noise
from legacy.kinematics.faults.nuisance import Marginal, Nuisance, information_of, likeliest_size
from legacy.kinematics.faults.packed_readings import Factor, Packed
from legacy.kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from legacy.kinematics.faults.score_information import IMAGINARY, REAL, State
from legacy.stapeskit.arrays import Array, ComplexArray

# Fewer channels or points show no scatter.
_LEAST_OWNERS = 4
# Residual directions per degree of freedom below which gains and a body that bends look alike.
_REDUNDANT = 2.0
# The range of relative errors that is searched.
_SMALLEST, _LARGEST = 1e-4, 0.5
# Log likelihood that scatter must gain, and smallest scatter of interest.
_GAIN, _WORTH = 10.0, 1e-3
# Rank correlation with the order of the file from which on the points drift.
_IN_ORDER = 0.8
_ROUNDS = 3
# Up to so many channels their gains are compared jointly: the memory goes with the square.
_MOST_CHANNELS = 3000
Owners = list[list[int]]


@dataclass(frozen=True)
class Scatter:
    """Relative errors (owner,) of groups of channels, complex, with their common sd and log likelihood."""

    error: ComplexArray
    sd: float
    gain: float


def drifting_points(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield factors of the points that rise or fall in the order of the file."""
    data = suspect.packed(suspect.plain, False)
    for owners, scatter in _scatters(suspect, data, [(list(data.by_point.values()), True)]):
        if _in_order(data, owners, scatter):
            first, last = np.abs(1.0 + scatter.error[[0, -1]])
            words = {"first": data.points[owners[0][0]], "last": data.points[owners[-1][0]]}
            yield _without(suspect, data, owners, scatter), {"factor": last / first, **words}


def scattered_gains(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield gains scattered over channels, and complex factors scattered over points, the likelier first."""
    data = suspect.packed(suspect.plain, False)
    tried = [([[channel] for channel in data.live], False), (list(data.by_point.values()), True)]
    for owners, scatter in _scatters(suspect, data, tried):
        if _in_order(data, owners, scatter):
            continue
        most = int(np.argmax(np.abs(scatter.error)))
        channel, per_point = owners[most][0], any(len(own) > 1 for own in owners)
        point, name = f"point {data.points[channel]}", f"channel {suspect.body.channel_name(channel)}"
        words = {
            "what": "points" if per_point else "channels",
            "sd": 100.0 * scatter.sd,
            "most": point if per_point else name,
            "factor": abs(1.0 + scatter.error[most]),
        }
        yield _without(suspect, data, owners, scatter), words


def _scatters(
    suspect: MisfittingBody, data: Packed, tried: list[tuple[Owners, bool]]
) -> list[tuple[Owners, Scatter]]:
    """Return the likely scatters of the factors of owners, the likelier first."""
    if len(data.live) > _MOST_CHANNELS:
        return []
    nuisance = Nuisance.of(data, suspect.position_sd_m)
    fits = [(owners, _scatter(data, nuisance, owners, turned)) for owners, turned in tried]
    likely = [
        (owners, scatter)
        for owners, scatter in fits
        if len(owners) >= _LEAST_OWNERS and scatter.gain > _GAIN and scatter.sd > _WORTH
    ]
    return sorted(likely, key=lambda one: -one[1].gain)


def _in_order(data: Packed, owners: Owners, scatter: Scatter) -> bool:
    """Return whether the factors of points follow the order of the file."""
    rank = np.argsort(np.argsort(np.abs(1.0 + scatter.error)))
    return len(owners) == len(set(data.points)) and (
        abs(np.corrcoef(rank, np.arange(len(rank)))[0, 1]) > _IN_ORDER
    )


def _without(suspect: MisfittingBody, data: Packed, owners: Owners, scatter: Scatter) -> Remedy:
    value = suspect.value.copy()
    for own, error in zip(owners, scatter.error, strict=True):
        value[own] = value[own] / (1.0 + error)
    alike = len(data.live) - data.size < _REDUNDANT * data.size
    return Remedy([c for own in owners for c in own], suspect.with_value(value), scatter.sd, alike)


def _scatter(data: Packed, nuisance: Nuisance, owners: Owners, turned: bool) -> Scatter:
    """Return the likeliest relative errors of groups of channels, independent and of one common size.

    Notes
    -----
    At the likeliest size sd of the errors they are the means (N + 1 / 2 sd^2)^-1 g, with score g and
    information N, next to errors of positions with a stated sd; repeated with the errors undone, as the
    motion is found anew.
    """
    which = (REAL, IMAGINARY) if turned else (REAL,)
    error, sd, gain = np.zeros(len(owners), dtype=complex), 0.0, 0.0
    current = data
    for turn in range(_ROUNDS):
        state = State.of(current)
        score, information = information_of(state, owners, which)
        level = channel_noise(state).level
        score, information = score / level, information / level
        if len(nuisance.sd):
            explained, lost = _positions(Marginal(state, nuisance), owners, which, level)
            score, information = score - explained, information - lost
        if turn == 0:
            sizes = np.geomspace(_SMALLEST, _LARGEST, 80)
            sd, gain = likeliest_size(score, information, sizes)
        step = np.linalg.solve(information + 0.5 / sd**2 * np.eye(len(score)), score)
        step = step.reshape(len(owners), len(which)) @ np.array([1.0, 1j])[: len(which)]
        error = (1.0 + error) * (1.0 + step) - 1.0
        current = data.under(replace(data.assumed, factors=tuple(map(_constant, owners, error))))
    return Scatter(error, sd, gain)


def _positions(near: Marginal, owners: Owners, which: tuple[int, ...], level: float) -> tuple[Array, Array]:
    """Return what errors of positions with a stated sd take of score (n k,) and information (n k, n k)."""
    shared = []
    for own in owners:
        group = np.array([own], dtype=np.intp)
        t = near.state.tangents(group[0], which)[:, :, None]
        shared.append(near.common(group, t, near.state.sums(group, t).taken)[0])
    shared_information = np.concatenate(shared) / level
    solved = np.linalg.solve(
        near.information / level + np.diag(0.5 / near.nuisance.sd**2), shared_information.T
    ).T
    return solved @ near.score / level, solved @ shared_information.T


def _constant(channels: list[int], error: complex) -> tuple[list[int], Factor]:
    return channels, lambda tau, _ratio: np.full(len(tau), 1.0 + error)

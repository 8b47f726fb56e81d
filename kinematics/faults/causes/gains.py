"""Gains that differ from channel to channel, or from point to point, all a little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.causes.misfit_causes import Explanation, MisfittingBody
from kinematics.faults.noise_size import channel_noise
from kinematics.faults.packed_readings import Factor, Packed
from kinematics.faults.score_information import IMAGINARY, REAL, State
from kinematics.faults.uncertain_positions import Marginal, Nuisance, information_of, likeliest_size
from stapeskit.arrays import Array, ComplexArray
from stapeskit.option_names import named

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


@dataclass(frozen=True)
class Scatter:
    """Relative errors (owner,) of groups of channels, complex, with their common sd and log likelihood."""

    error: ComplexArray
    sd: float
    gain: float


def gains(suspect: MisfittingBody) -> Iterator[Explanation]:
    """Yield gains scattered over channels, and complex factors scattered over points, the likelier first."""
    data = suspect.packed(suspect.plain, False)
    nuisance = Nuisance.of(data, suspect.position_sd_m)
    live, size = data.live, data.size
    if len(live) > _MOST_CHANNELS:
        return
    alike = len(live) - size < _REDUNDANT * size
    points: dict[str, list[int]] = {}
    for channel in live:
        points.setdefault(data.points[channel], []).append(channel)
    tried = [([[channel] for channel in live], False), (list(points.values()), True)]
    fits = [(owners, _scatter(data, nuisance, owners, turned)) for owners, turned in tried]
    for owners, scatter in sorted(fits, key=lambda entry: -entry[1].gain):
        if len(owners) >= _LEAST_OWNERS and scatter.gain > _GAIN and scatter.sd > _WORTH:
            yield _explanation(suspect, data, owners, scatter, alike)


def _explanation(
    suspect: MisfittingBody, data: Packed, owners: list[list[int]], scatter: Scatter, alike: bool
) -> Explanation:
    value = suspect.value.copy()
    for own, error in zip(owners, scatter.error, strict=True):
        value[own] = value[own] / (1.0 + error)
    channels = [channel for own in owners for channel in own]
    sd = 100.0 * scatter.sd
    most = owners[int(np.argmax(np.abs(scatter.error)))][0]
    factor = abs(1.0 + scatter.error[int(np.argmax(np.abs(scatter.error)))])
    per_point = any(len(own) > 1 for own in owners)
    of_points = len(owners) == len(set(data.points))
    if of_points and abs(_rank_correlation(np.abs(1.0 + scatter.error))) > _IN_ORDER:
        first, last = abs(1.0 + scatter.error[0]), abs(1.0 + scatter.error[-1])
        text = (
            f"the readings change from point to point in the order of the file, by a factor of "
            f"{last / first:.3g} from point {data.points[owners[0][0]]} to {data.points[owners[-1][0]]}"
        )
        step = (
            "The motion changed while the points were recorded one after the other (drying, drift of the "
            "source): measure the first point again at the end, or give a reference recorded with each point"
        )
        code, verdict = "drift_between_points", "drift"
    else:
        what = "points" if per_point else "channels"
        name = f"point {data.points[most]}" if per_point else f"channel {suspect.body.channel_name(most)}"
        text = (
            f"the gains of the {what} scatter by about {sd:.2g} % (standard deviation), most at {name} "
            f"(factor {factor:.4g})"
        )
        step = (
            f"Calibrate the channels, or state the scatter and fit it with {named('calibrate')} "
            f"{named('gain_sd')} {sd:.2g}"
        )
        code, verdict = "gains_scattered", "gain"
    return Explanation.of(code, verdict, channels, (text, step), scatter.sd, suspect.with_value(value), alike)


def _scatter(data: Packed, nuisance: Nuisance, owners: list[list[int]], turned: bool) -> Scatter:
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


def _positions(
    near: Marginal, owners: list[list[int]], which: tuple[int, ...], level: float
) -> tuple[Array, Array]:
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


def _rank_correlation(value: Array) -> float:
    """Return the rank correlation of values with their order."""
    rank = np.argsort(np.argsort(value))
    return float(np.corrcoef(rank, np.arange(len(value)))[0, 1]) if np.ptp(value) > 0.0 else 0.0

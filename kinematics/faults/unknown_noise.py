"""Noise that is not stated: that of each channel, as far as residuals tell it from that of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.channel_noise import ChannelNoise
from kinematics.faults.compact import Compact
from kinematics.faults.fault_model import State, solve
from kinematics.faults.mixing import axes_of

Array = NDArray[np.float64]
NOISY = 2.0
_LEAST_SAMPLES = 32
_MOST_JOINTLY = 150
_ROUNDS = 6
_QUIETEST = 0.05
_RIDGE = 1e-3
_SURE = 2.0


def evened(data: Compact) -> tuple[Compact, Array]:
    """Return data of unknown noise with weights by what the residuals show of each channel.

    Returns
    -------
    Compact
        Channels with more than NOISY times the noise of those along their axis keep the weight of these, for
        the search to find.
    ndarray, (channel,)
        Variance of the logarithm of each channel's noise variance beside the others': its uncertainty.

    Notes
    -----
    Channels of one laser are mostly alike, and lasers too: the logarithms of their variances are taken for
    draws around a common one, and shrunk towards it by what their scatter beyond that of estimates allows
    (empirical Bayes: Smyth 2004, doi:10.2202/1544-6115.1027; scatter by DerSimonian and Laird 1986,
    doi:10.1016/0197-2456(86)90046-2). Estimates are those of restricted likelihood, see ``_variances``.
    """
    nothing = np.zeros(len(data.points))
    state = solve(data)
    found = ChannelNoise.of(state, state.rest())
    if found.number < _LEAST_SAMPLES or not found.level > 0.0:
        return data, nothing
    levelled = _course(data, state)
    if levelled is not data:
        data, state = levelled, solve(levelled)
        found = ChannelNoise.of(state, state.rest())
    value, doubt = _variances(found, state)
    live = data.live
    groups = axes_of(data.directions, live)
    if len(groups) < 2 or min(map(len, groups)) < 3:
        groups = [live]
    size, own = _shrunk(np.log(value), doubt, groups)
    a = data.a.copy()
    a[live] /= np.exp(0.5 * size[live])
    same = float(np.max(np.abs(size[live] - size[live[0]]), initial=0.0)) < 1e-9
    data = replace(data, a=a)
    return (data if same else data.repacked()), own


def _variances(found: ChannelNoise, state: State) -> tuple[Array, Array]:
    """Return the noise variance of each channel (channel,), and the variance of its logarithm.

    Notes
    -----
    Iterated MINQUE (Rao 1971, doi:10.1016/0047-259X(71)90001-7), whose fixed point is the maximum of the
    restricted likelihood: with P the projector off the rows for the present variances s, (P o P) s equals
    the diagonal of P S P, S the residual covariance. One noisy channel then stays one, whatever its
    leverage. Many channels hold little leverage each, and are taken one by one.
    """
    count, live, n = len(state.span), np.array(state.data.live), found.number
    value, doubt = np.full(count, found.level), np.full(count, np.inf)
    h = state.h[live]
    if len(live) > _MOST_JOINTLY:
        left = np.maximum(1.0 - h, _QUIETEST)
        value[live] = np.maximum((found.ratios[live] / found.level - h) / left, _QUIETEST) * found.level
        doubt[live] = 1.0 / (n * left**2)
        return value, doubt
    span = state.span[live]
    covariance = np.real(found.held[live] @ found.held[live].conj().T) / n / found.level
    size = np.ones(len(live))
    ridge = _RIDGE * np.eye(len(live))
    for turn in range(_ROUNDS):
        inverse = 1.0 / size
        rows = inverse[:, None] * span
        project = np.diag(inverse) - rows @ np.linalg.solve(span.T @ rows, rows.T)
        scale = np.sqrt(size)
        even = project * np.outer(scale, scale)
        mixed = even**2 + ridge
        seen = np.einsum("ij,jk,ki->i", project, covariance, project, optimize=True) * size
        if turn == 0:
            doubt[live] = np.diag(np.linalg.inv(mixed)) / n
        new = np.maximum(size * np.linalg.solve(mixed, seen + _RIDGE), _QUIETEST)
        moved, size = float(np.max(np.abs(np.log(new / size)))), new
        if moved < 0.01:
            break
    value[live] = size * found.level
    return value, doubt


def _shrunk(value: Array, doubt: Array, groups: list[list[int]]) -> tuple[Array, Array]:
    """Return logarithms (channel,) shrunk towards those of their group, and what remains uncertain of them.

    Values far above the others of their group get what the group has.
    """
    middle = np.array([np.median(value[own]) for own in groups])
    usual = [
        np.array([c for c in own if value[c] - at < 2.0 * np.log(NOISY)])
        for own, at in zip(groups, middle, strict=True)
    ]
    mean = np.array([_mean(value[own], doubt[own])[0] for own in usual])
    deviation = np.concatenate([value[own] - at for own, at in zip(usual, mean, strict=True)])
    errors = np.concatenate([doubt[own] for own in usual])
    scatter, sure = _scatter(deviation, errors, len(groups))
    found = [_mean(value[own], doubt[own] + scatter) for own in usual]
    mean, unsure = np.array([at for at, _ in found]), np.array([wide for _, wide in found])
    between, distinct = _scatter(mean - _mean(mean, unsure)[0], unsure, 1)
    keep = between / (between + unsure) if distinct else np.zeros(len(mean))
    whole = _mean(mean, unsure + between)[0]
    made, own_doubt = np.zeros(len(value)), np.zeros(len(value))
    for own, some, at, share, wide in zip(groups, usual, mean, keep, unsure, strict=True):
        made[own] = whole + share * (at - whole)
        own_doubt[own] = scatter + (share * wide if distinct else between)
        if sure:
            held = scatter / (scatter + doubt[some])
            made[some] += held * (value[some] - made[some])
            own_doubt[some] = share * wide * (1.0 - held) ** 2 + held * doubt[some]
    return made, own_doubt


def _mean(value: Array, variance: Array) -> tuple[float, float]:
    weight = 1.0 / variance
    return float(np.sum(weight * value) / np.sum(weight)), float(1.0 / np.sum(weight))


def _scatter(deviation: Array, variance: Array, means: int) -> tuple[float, bool]:
    """Return the variance of values beyond that of their errors, at least none, and whether it is sure."""
    free = len(deviation) - means
    if free < 1:
        return 0.0, False
    weight = 1.0 / variance
    excess = float(np.sum(weight * deviation**2)) - free
    found = excess / float(np.sum(weight) - means * np.sum(weight**2) / np.sum(weight))
    return max(found, 0.0), excess > _SURE * np.sqrt(2.0 * free)


def _course(data: Compact, state: State) -> Compact:
    """Return data whose noise differs from segment to segment, where it does, with the same everywhere."""
    parts = data.divisor.shape[1]
    if parts < 2:
        return data
    size = np.abs(state.rest()) ** 2
    live = state.data.live
    left = np.maximum(1.0 - state.h[live], _QUIETEST)[:, None]
    free = len(live) - state.span.shape[1]
    level, doubt = np.ones(parts), np.full(parts, np.inf)
    for k in range(parts):
        held = size[live][:, data.rest_part == k]
        if held.shape[1]:
            level[k] = float(np.median(np.mean(held / left, axis=1)))
            doubt[k] = 0.5 * np.pi / (held.shape[1] * free)
    if not np.min(level) > 0.0 or not np.all(np.isfinite(doubt)):
        return data
    value = np.log(level)
    mean = _mean(value, doubt)[0]
    scatter, sure = _scatter(value - mean, doubt, 1)
    if not sure:
        return data
    made = np.exp(scatter / (scatter + doubt) * (value - mean))
    return data.levelled(made / float(np.mean(made)))

"""Noise that is not stated: that of each channel, as far as residuals tell it from that of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_model import State, solve
from kinematics.faults.noise.channel_noise import ChannelNoise
from kinematics.faults.noise.few_lines import level_of_all
from kinematics.faults.packed.compact import Compact
from kinematics.faults.packed.mixing import axes_of
from kinematics.faults.refit import Places

Array = NDArray[np.float64]
# How many times the sd of the others noise must be to be called a fault.
NOISY = 2.0
# Fewer complex values than this tell channels not apart.
_LEAST_SAMPLES = 32
# Up to so many channels are estimated jointly: the time goes with the cube of their number.
_MOST_JOINTLY = 150
# Rounds of the estimate, done when the logarithms move by less.
_ROUNDS, _SETTLED = 6, 0.01
# The least variance over the common one, and the weight of a prior at 1 that keeps the equations solvable.
_QUIETEST, _RIDGE = 0.05, 1e-3
# Standard deviations of chi2 from which on scatter is sure.
_SURE = 2.0
# A segment with less of the noise of the loudest has no channel to spare: what is left there is rounding.
_ROUNDING = 1e-6


def evened(data: Compact, prior_m: Array) -> tuple[Compact, Array]:
    """Return data of unknown noise with weights by what the residuals show of each channel.

    Parameters
    ----------
    data : Compact
    prior_m : ndarray, (channel,)
        Stated standard deviations of the positions, m; zero when not stated.

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
    doi:10.1016/0197-2456(86)90046-2, here for correlated errors). Scatter that is not sure moves nothing, and
    remains as doubt. Estimates are those of restricted likelihood, see ``_variances``.
    """
    nothing = np.zeros(len(data.points))
    state = solve(data)
    found = ChannelNoise.of(state, state.rest())
    if found.number < _LEAST_SAMPLES:
        level = level_of_all(state, state.rest(), Places.of(data, prior_m))[0]
        return (replace(data, a=data.a / np.sqrt(level)) if level > 0.0 else data), nothing
    if not found.level > 0.0:
        return data, nothing
    levelled = _course(data, state)
    if levelled is not data:
        data, state = levelled, solve(levelled)
        found = ChannelNoise.of(state, state.rest())
        if not found.level > 0.0:
            return data, nothing
    value, precision = _variances(found, state)
    live = np.array(data.live)
    groups = axes_of(data.directions, data.live)
    if len(groups) < 2 or min(map(len, groups)) < 3:
        groups = [data.live]
    one_of = np.stack([np.isin(live, own) for own in groups], axis=1).astype(float)
    size, doubt = _shrunk(_logarithm(value), precision, one_of)
    own = nothing
    own[live] = doubt
    size = np.where(size > 0.0, np.exp(size), np.maximum(1.0 + np.minimum(size, 0.0), _QUIETEST))
    a = data.a.copy()
    a[live] /= np.sqrt(size * found.level)
    same = float(np.ptp(size)) < 1e-9
    data = replace(data, a=a)
    return (data if same else data.repacked()), own


def _variances(found: ChannelNoise, state: State) -> tuple[Array, Array]:
    """Return the noise variance of each channel in use over the common one (n,), and its precision (n, n).

    Notes
    -----
    Iterated MINQUE (Rao 1971, doi:10.1016/0047-259X(71)90001-7), whose fixed point is the maximum of the
    restricted likelihood: with P the projector off the rows for the present variances s, (P o P) s equals
    the diagonal of P S P, S the residual covariance of N complex values, and N (P o P) is the information
    on s. One noisy channel then stays one, whatever its leverage. Many channels hold little leverage each,
    and are taken one by one.
    """
    live, n = np.array(state.data.live), found.number
    h = state.h[live]
    if len(live) > _MOST_JOINTLY:
        left = np.maximum(1.0 - h, _QUIETEST)
        return np.maximum((found.ratios[live] / found.level - h) / left, _QUIETEST), n * np.diag(left**2)
    span = state.span[live]
    covariance = np.real(found.held[live] @ found.held[live].conj().T) / n / found.level
    size: Array = np.ones(len(live))
    ridge = _RIDGE * np.eye(len(live))
    first = ridge
    for turn in range(_ROUNDS):
        rows = span / size[:, None]
        project = np.diag(1.0 / size) - rows @ np.linalg.solve(span.T @ rows, rows.T)
        information = project**2 * np.outer(size, size) + ridge
        first = information if turn == 0 else first
        seen = np.einsum("ij,jk,ki->i", project, covariance, project, optimize=True) * size
        new = np.maximum(size * np.linalg.solve(information, seen + _RIDGE), _QUIETEST)
        moved, size = float(np.max(np.abs(np.log(new / size)))), new
        if moved < _SETTLED:
            break
    return size, n * first


def _logarithm(value: Array) -> Array:
    """Return the logarithm of variances; of small ones, which scatter widely, what they lack of 1."""
    return np.where(value > 1.0, np.log(np.maximum(value, 1.0)), value - 1.0)


def _shrunk(value: Array, precision: Array, one_of: Array) -> tuple[Array, Array]:
    """Return values (n,) shrunk towards those of their group, and the variance that they keep.

    Values far above the others of their group get what the group has.

    Parameters
    ----------
    value : ndarray, (n,)
    precision : ndarray, (n, n)
        Inverse covariance of their errors.
    one_of : ndarray, (n, group)
        1 for the group that each is of.
    """
    middle = np.array([np.median(value[own > 0.0]) for own in one_of.T])
    usual = value - one_of @ middle < 2.0 * np.log(NOISY)
    x, group = value[usual], one_of[usual]
    held = precision[np.ix_(usual, usual)]
    if not np.all(usual):
        crossed = precision[np.ix_(usual, ~usual)]
        held = held - crossed @ np.linalg.solve(precision[np.ix_(~usual, ~usual)], crossed.T)
    scatter, sure = _scatter(x, held, group)
    if sure:
        held = np.asarray(np.linalg.inv(np.linalg.inv(held) + scatter * np.eye(len(x))))
    inner = group.T @ held @ group
    mean = np.linalg.solve(inner, group.T @ held @ x)
    every = np.ones((len(mean), 1))
    between, distinct = _scatter(mean, inner, every)
    doubt = np.full(len(mean), between)
    if distinct:
        whole = np.linalg.inv(np.linalg.inv(inner) + between * np.eye(len(mean)))
        centre = float(np.sum(whole @ mean) / np.sum(whole))
        doubt = np.diag(np.linalg.inv(inner + np.eye(len(mean)) / between))
        kept = centre + between * whole @ (mean - centre)
    else:
        kept = np.full(len(mean), float(np.sum(inner @ mean) / np.sum(inner)))
    made, own = one_of @ kept, one_of @ doubt + scatter
    if sure:
        made[usual] += scatter * held @ (x - group @ mean)
        own[usual] -= scatter**2 * np.diag(held)
    return made, own


def _scatter(value: Array, precision: Array, group: Array) -> tuple[float, bool]:
    """Return the variance of values within groups beyond that of their errors, and whether it is sure."""
    free = len(value) - group.shape[1]
    if free < 1:
        return 0.0, False
    taken = precision @ group
    left = precision - taken @ np.linalg.solve(group.T @ taken, taken.T)
    excess = float(value @ left @ value) - free
    return max(excess / float(np.trace(left)), 0.0), excess > _SURE * np.sqrt(2.0 * free)


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
    if not np.min(level) > _ROUNDING * np.max(level) or not np.all(np.isfinite(doubt)):
        return data
    value, precision = np.log(level), np.diag(1.0 / doubt)
    scatter, sure = _scatter(value, precision, np.ones((parts, 1)))
    if not sure:
        return data
    mean = float(np.sum(value / doubt) / np.sum(1.0 / doubt))
    made = np.exp(scatter / (scatter + doubt) * (value - mean))
    return data.levelled(made / float(np.mean(made)))

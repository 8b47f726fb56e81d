"""Noise that is not stated: weights by what the residuals show of each channel and part of the lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.noise_size import LEAST_SAMPLES, ChannelNoise, channel_noise, common_level
from legacy.kinematics.faults.nuisance import Nuisance, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Packed
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.fit.laser_groups import laser_channels
from legacy.stapeskit.arrays import Array

# How many times the sd of the others noise must be to be called a fault.
NOISY = 2.0
# Up to so many channels are estimated jointly: the time goes with the cube of their number.
_MOST_JOINTLY = 150
# Rounds of the estimate, done when the logarithms move by less.
_ROUNDS, _SETTLED = 6, 0.01
# The least variance over the common one, and the weight of a prior at 1 that keeps the equations solvable.
_QUIETEST, _RIDGE = 0.05, 1e-3
# Standard deviations of chi2 from which on scatter is sure.
_SURE = 2.0
# Computation: noise of a part over that of the loudest, below which only rounding is left.
_ROUNDING = 1e-6
# Number of parts of the lines; fewest lines with gaps of which the noise of parts is compared.
_PARTS, _LEAST_GROUPS = 12, 24


def equalise_noise(data: Packed, nuisance: Nuisance) -> Packed:
    """Return data of unknown noise with weights by what the residuals show of each channel.

    Channels with more than NOISY times the noise of those along their axis keep the weight of these.

    Notes
    -----
    Channels of one laser are mostly alike, and lasers too: the logarithms of their variances are taken for
    draws around a common one, and shrunk towards it by what their scatter beyond that of estimates allows
    (empirical Bayes: Smyth 2004, doi:10.2202/1544-6115.1027; scatter by DerSimonian and Laird 1986,
    doi:10.1016/0197-2456(86)90046-2, here for correlated errors). Scatter that is not sure changes nothing.
    Estimates are those of restricted likelihood, see ``_variances``.
    """
    level = common_level(data, nuisance)[0]
    if not level > 0.0:
        return data
    data = data.louder(float(np.sqrt(level)))
    state = estimate_nuisance(data, nuisance).state
    noise = channel_noise(state)
    if noise.least < LEAST_SAMPLES or not noise.level > 0.0:
        return data
    levelled = _course(data, state)
    if levelled is not data:
        data, state = levelled, estimate_nuisance(levelled, nuisance).state
        noise = channel_noise(state)
        if not noise.level > 0.0:
            return data
    value, precision = _variances(noise, state)
    live = np.array(data.live)
    groups = laser_channels(data.assumed.directions, data.live)
    if len(groups) < 2 or min(map(len, groups)) < 3:
        groups = [data.live]
    one_of = np.stack([np.isin(live, own) for own in groups], axis=1).astype(float)
    size = _shrunk(_logarithm(value), precision, one_of)
    size = np.where(size > 0.0, np.exp(size), np.maximum(1.0 + np.minimum(size, 0.0), _QUIETEST))
    factor = np.ones(len(data.points))
    factor[live] = np.sqrt(size * noise.level)
    return data.under(replace(data.assumed, loud=data.assumed.loud * factor))


def _variances(noise: ChannelNoise, state: State) -> tuple[Array, Array]:
    """Return the noise variance of each channel in use over the common one (n,), and its precision.

    Notes
    -----
    Iterated MINQUE (Rao 1971, doi:10.1016/0047-259X(71)90001-7), whose fixed point is the maximum of the
    restricted likelihood: with P the projector off the rows for the present variances s, (P o P) s equals
    the diagonal of P S P, S the residual covariance of N complex values, and N (P o P) is the information
    on s. One noisy channel then stays one, whatever its leverage. Many channels hold little leverage each,
    and are taken one by one, as are those with gaps: their precision is a diagonal (n,), else (n, n).
    """
    live = np.array(state.data.live)
    number = noise.number[live]
    h = np.mean(state.leverage[:, live], axis=0)
    if len(live) > _MOST_JOINTLY or not noise.held.shape[1]:
        left = np.maximum(1.0 - h, _QUIETEST)
        value = np.maximum((noise.ratios[live] / noise.level - h) / left, _QUIETEST)
        return value, number * left**2
    span = np.real(state.span[0][live])
    covariance = np.real(noise.held[live] @ noise.held[live].conj().T) / number[0] / noise.level
    size: Array = np.ones(len(live))
    ridge = _RIDGE * np.eye(len(live))
    first = ridge
    for turn in range(_ROUNDS):
        rows = span / size[:, None]
        project = np.diag(1.0 / size) - rows @ np.linalg.solve(span.T @ rows, rows.T)
        information = project**2 * np.outer(size, size) + ridge
        first = information if turn == 0 else first
        seen = np.sum((project @ covariance) * project, axis=1) * size
        new = np.maximum(size * np.linalg.solve(information, seen + _RIDGE), _QUIETEST)
        moved, size = float(np.max(np.abs(np.log(new / size)))), new
        if moved < _SETTLED:
            break
    return size, number[0] * first


def _logarithm(value: Array) -> Array:
    """Return the logarithm of variances; of small ones, which scatter widely, what they lack of 1."""
    return np.where(value > 1.0, np.log(np.maximum(value, 1.0)), value - 1.0)


def _shrunk(value: Array, precision: Array, one_of: Array) -> Array:
    """Return values (n,) shrunk towards those of their group.

    Values far above the others of their group get what the group has.

    Parameters
    ----------
    value : ndarray, (n,)
    precision : ndarray, (n, n) or (n,)
        Inverse covariance of their errors, or its diagonal.
    one_of : ndarray, (n, group)
        1 for the group that each is of.
    """
    middle = np.array([np.median(value[own > 0.0]) for own in one_of.T])
    usual = value - one_of @ middle < 2.0 * np.log(NOISY)
    x, group = value[usual], one_of[usual]
    held = _among(precision, usual)
    scatter, sure = _scatter(x, held, group)
    if sure:
        held = _inverse(_plus(_inverse(held), scatter))
    inner = group.T @ _times(held, group)
    mean = np.linalg.solve(inner, group.T @ _times(held, x))
    between, distinct = _scatter(mean, inner, np.ones((len(mean), 1)))
    if distinct:
        whole = np.linalg.inv(np.linalg.inv(inner) + between * np.eye(len(mean)))
        centre = float(np.sum(whole @ mean) / np.sum(whole))
        kept = centre + between * whole @ (mean - centre)
    else:
        kept = np.full(len(mean), float(np.sum(inner @ mean) / np.sum(inner)))
    shrunk = one_of @ kept
    if sure:
        shrunk[usual] += scatter * _times(held, x - group @ mean)
    return np.asarray(shrunk)


def _among(precision: Array, some: NDArray[np.bool_]) -> Array:
    """Return the precision of some values, the others unknown."""
    if precision.ndim == 1 or np.all(some):
        return precision[some] if precision.ndim == 1 else precision
    crossed = precision[np.ix_(some, ~some)]
    taken = crossed @ np.linalg.solve(precision[np.ix_(~some, ~some)], crossed.T)
    return np.asarray(precision[np.ix_(some, some)] - taken)


def _times(matrix: Array, value: Array) -> Array:
    """Return a matrix (n, n), or a diagonal (n,), times values (n,) or (n, k)."""
    if matrix.ndim == 2:
        return np.asarray(matrix @ value)
    return np.asarray((matrix * value.T).T)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a matrix (n, n), or of a diagonal (n,)."""
    return np.asarray(np.linalg.inv(matrix) if matrix.ndim == 2 else 1.0 / matrix)


def _plus(matrix: Array, size: float) -> Array:
    """Add a multiple of the unit matrix to a matrix (n, n), or to a diagonal (n,)."""
    return np.asarray(matrix + size * np.eye(len(matrix)) if matrix.ndim == 2 else matrix + size)


def _scatter(value: Array, precision: Array, group: Array) -> tuple[float, bool]:
    """Return the variance of values within groups beyond that of their errors, and whether it is sure."""
    free = len(value) - group.shape[1]
    if free < 1:
        return 0.0, False
    taken = _times(precision, group)
    inner, pull = group.T @ taken, taken.T @ value
    excess = float(value @ _times(precision, value) - pull @ np.linalg.solve(inner, pull)) - free
    whole = precision if precision.ndim == 1 else np.diag(precision)
    trace = float(np.sum(whole) - np.trace(np.linalg.solve(inner, taken.T @ taken)))
    return max(excess / trace, 0.0), excess > _SURE * np.sqrt(2.0 * free)


def _course(data: Packed, state: State) -> Packed:
    """Return data with the same noise in all parts of the lines, where it differs."""
    live = data.live
    pieces = np.array_split(np.arange(len(data.weight)), min(_PARTS, len(data.weight)))
    samples = data.rest.shape[2]
    if len(pieces) < 2 or (not samples and len(data.weight) < _LEAST_GROUPS):
        return data
    held = state.plain(state.rest if samples else state.e)[:, live]
    used = data.weight[:, live] > 0.0
    left = np.where(used, np.maximum(1.0 - state.leverage[:, live], _QUIETEST), 0.0) * held.shape[2]
    energy = np.sum(np.abs(held) ** 2, axis=2)
    level, variance = np.ones(len(pieces)), np.ones(len(pieces))
    for k, own in enumerate(pieces):
        size = np.sum(energy[own], axis=0) / np.maximum(np.sum(left[own], axis=0), 1e-9)
        level[k] = float(np.median(size[np.any(used[own], axis=0)]))
        variance[k] = 0.5 * np.pi / max(float(np.sum(state.free()[own])) * held.shape[2], 1.0)
    if not np.min(level) > _ROUNDING * np.max(level):
        return data
    value, precision = np.log(level), 1.0 / variance
    scatter, sure = _scatter(value, precision, np.ones((len(pieces), 1)))
    if not sure:
        return data
    mean = float(np.sum(value / variance) / np.sum(1.0 / variance))
    course = np.exp(scatter / (scatter + variance) * (value - mean))
    return data.under(replace(data.assumed, level=np.sqrt(course / float(np.mean(course)))))

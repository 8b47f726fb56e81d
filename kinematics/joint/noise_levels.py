"""How loud groups of lines and channels are: the one estimate of noise that is not stated, or only roughly.

Shapes: c channels, n lines or groups of lines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinematics.joint.estimate import State
from stapeskit.arrays import Array

_POOLED_DOF = 400  # squares of neighbours that are pooled: the level is known to 1 / sqrt(2 * 400), 3.5 %
_REFLECTION = 0.25  # spread of noise between points, in natural logarithms: reflection and focus differ
_QUARTILES = 1.349  # distance of the quartiles of a normal distribution, in standard deviations
LEAST_FREEDOM = 8.0
"""Degrees of freedom of the noise of a channel from which on it is estimated: the variance to sqrt(2 / 8)."""
_SAMPLE = 100_000  # stated sd that are looked at
_FEWEST = 3  # channels of a laser whose median is that of the laser


def pooled_levels(energy: Array, freedom: Array) -> Array:
    """Return the noise over the assumed one, (n,), that neighbours show together.

    ``energy`` (n,) are sums of squares over noise that hold no motion, NaN where missing.
    """
    good = np.isfinite(energy) & (freedom > 0)
    count, total = len(energy), float(np.sum(freedom[good]))
    width = min(count, max(1, int(np.ceil(_POOLED_DOF / max(total / count, 1e-9)))))
    sums = np.concatenate([[0.0], np.cumsum(np.where(good, energy, 0.0))])
    counts = np.concatenate([[0.0], np.cumsum(np.where(good, freedom, 0.0))])
    start = np.clip(np.arange(count) - width // 2, 0, count - width)
    number = counts[start + width] - counts[start]
    whole = sums[-1] / total if total > 0.0 else 1.0
    level = np.where(number > 0.0, (sums[start + width] - sums[start]) / np.maximum(number, 1e-9), whole)
    return np.asarray(np.sqrt(np.maximum(level, 0.0)))


class ChannelLevels(NamedTuple):
    """Noise of channels over the assumed one.

    Attributes
    ----------
    level : ndarray, (c,)
        Over the middle of all.
    apart : ndarray, (c,)
        Part of it that is the channel's own, not its laser's.
    spread : ndarray, (c,)
        Standard deviation of the logarithm of ``apart``; 0 where the noise is stated.
    unsure : ndarray, (c,)
        Variance of the logarithm of ``level`` as it was estimated; 0 where it was not.
    """

    level: Array
    apart: Array
    spread: Array
    unsure: Array

    @classmethod
    def as_assumed(cls, channels: int, spread: Array | float = 0.0) -> ChannelLevels:
        """Return levels of 1, none of which was estimated."""
        one, zero = np.ones(channels), np.zeros(channels)
        return cls(one, one, zero + spread, zero)


def channel_levels(
    state: State, laser: NDArray[np.intp], assumed: Array, known: Array | None = None
) -> ChannelLevels:
    """Estimate how loud channels are from what does not follow the motion.

    Parameters
    ----------
    state : State
        A fit with noise of ``assumed`` levels.
    laser : ndarray, (c,), int
        Lasers have a usual noise of their own. A vibrometer that reports x, y, z instead of its beams is the
        case in mind: these lie within some 20 degrees of z, so that x and y are several times as noisy.
    known : ndarray, (c,), optional
        Standard deviation of the logarithm of the stated noise, as few digits leave it.

    Notes
    -----
    Levels are shrunk towards the usual one (Efron and Morris 1975, doi:10.1080/01621459.1975.10479864): the
    stated one by its spread; else the middle one by the scatter of the middle half of channels, which a
    faulty one does not move, and which is at least that of reflecting surfaces.
    """
    energy, freedom = state.own_noise
    energy = energy * assumed**2
    some = freedom > LEAST_FREEDOM
    spread = np.full(len(freedom), _REFLECTION) if known is None else known
    if not spread.any() or np.count_nonzero(some) < 2:
        return ChannelLevels.as_assumed(len(freedom), spread)
    logs = np.zeros(len(freedom))
    logs[some] = 0.5 * np.log(np.maximum(energy[some], 1e-300) / freedom[some])
    usual = np.zeros(len(freedom))
    chance = 0.5 / np.maximum(freedom, 1.0)
    if known is None:
        logs -= np.median(logs[some])
        for number in np.unique(laser):
            own = laser == number
            if np.count_nonzero(own & some) >= _FEWEST:
                usual[own] = np.median(logs[own & some])
        width = float(np.diff(np.quantile((logs - usual)[some], [0.25, 0.75]))[0]) / _QUARTILES
        spread = np.maximum(spread, np.sqrt(max(width**2 - float(np.median(chance[some])), 0.0)))
    share = np.where(some, spread**2 / (spread**2 + chance), 0.0)
    apart = (logs - usual) * share
    return ChannelLevels(np.exp(usual + apart), np.exp(apart), spread, share * chance)


def digits_spread(sd: Array) -> Array:
    """Return the relative standard deviation that few digits leave of the stated noise of channels, (c,).

    Three digits leave 0; one value for all is taken as it is. sd (r, c, L) of rms amplitudes have their
    digits before they are multiplied with sqrt 2.
    """
    some = sd[:, :, :: max(1, sd.size // _SAMPLE)]
    some = np.where(some > 0.0, some, np.nan)
    known = np.unique(some[np.isfinite(some)])
    for factor in (1.0, np.sqrt(2.0)) if known.size > 1 else ():
        least = 10.0 ** np.floor(np.log10(known[0] / factor) + 1e-9)
        first = 10.0 ** np.floor(np.log10(some / factor) + 1e-9)
        for unit in (first, np.full(some.shape, least), 0.1 * first):
            digits = some / factor / unit
            if not np.any(np.abs(digits - np.round(digits)) > 1e-6 * digits):
                return np.sqrt(np.nan_to_num(np.nanmean(digits**-2.0, axis=(0, 2))) / 12.0)
    return np.zeros(sd.shape[1])

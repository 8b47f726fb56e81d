"""Smooth standard deviations that were estimated from few averages over neighbouring lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

Mask = NDArray[np.bool_]
# Range of averages in which scatter of the stated sd is looked for: below no sd exists, above it is below 5
# %.
_LEAST_AVERAGES = 3.0
_MOST_AVERAGES = 200.0
# Fewest lines that show scatter.
_LEAST_LINES = 32
_LEAST_SCATTER: float = calibrated("few_averages.least_scatter")
_MOST_SCATTER: float = calibrated("few_averages.most_scatter")
# Probability below which one stated sd is an outlier, with this much allowed for rounding in the file.
_APART = 1e-6
_ROUNDING = 1.3
# Lines to each side that give the local level.
_NEAR = 8
# Channels that show common scatter; median of chi2 with one degree of freedom.
_LEAST_CHANNELS = 6
_NOTABLE_COMMON: float = calibrated("few_averages.notable_common")
# Median of chi2 with one degree of freedom.
_MEDIAN = 0.455
# Lines from which on the level may bend over frequency.
_TREND_FROM = 100
# Degrees of freedom of a rigid body, which the channels of a line spend.
_MOTION = 6


def steady_noise(
    sd: Array, n_avg: Array | float, body: str, *, from_coherence: bool = True
) -> tuple[Array, list[Notice]]:
    """Return standard deviations smoothed over neighbouring lines of each channel.

    Parameters
    ----------
    sd : ndarray, (..., freq)
        Of the real (= imaginary) part; NaN where missing.
    n_avg : ndarray, broadcastable to (..., freq), or float
        Number of averages K of which each sd was estimated.
    body : str
        Name for the notice.
    from_coherence : bool
        The sd follow from the coherence: their squares are K / (K - 1) too small.

    Returns
    -------
    ndarray, (..., freq)
        ``sd`` itself where its scatter is not what K averages give: sd that are known better are smooth, and
        noise that is rough in itself has nothing to share.
    list of Notice
        ``noise_steadied``.

    Notes
    -----
    K averages give a variance as chi2 with d = 2 (K - 1) degrees of freedom over d. Weights and chi2 made of
    them are wrong by the mean of 1 / chi2 and more. The mean over neighbouring lines, of a width that
    predicts left-out lines best (least gamma deviance), has many degrees of freedom; each variance is drawn
    to it by the degrees of freedom that its scatter leaves it (Smyth 2004, doi:10.2202/1544-6115.1027; one
    more for the mean keeps chi2 of such estimates within its 95 % point as often as of known noise).
    What all channels of a line share, the size of a random excitation, stays. A line whose noise stands out
    from its neighbours keeps its own.
    """
    shape = sd.shape if sd.ndim == 3 else (1, *sd.shape)
    counts = np.broadcast_to(np.asarray(n_avg, dtype=float), sd.shape).reshape(shape)
    steady, good, width = np.array(sd.reshape(shape)), np.zeros(shape, dtype=bool), 0
    for run in range(shape[0]):
        count, variance = counts[run], steady[run] ** 2
        usable = np.isfinite(variance) & (variance > 0.0)
        usable &= (count >= _LEAST_AVERAGES) & (count <= _MOST_AVERAGES)
        usable &= np.sum(usable, axis=1, keepdims=True) >= _LEAST_LINES
        freedom = np.where(usable, 2.0 * (count - 1.0), 4.0)
        result = _steady(np.where(usable, variance, 1.0), freedom, usable) if np.any(usable) else None
        if result is None:
            continue
        good[run], width = usable, result[1]
        small = count / np.maximum(count - 1.0, 1.0) if from_coherence else 1.0
        steady[run] = np.where(usable, np.sqrt(result[0] * small), steady[run])
    if not np.any(good):
        return sd, []
    typical = float(np.median(counts[good]))
    text = (
        f"the standard deviations of body {body} are estimates from {typical:.3g} averages: each was "
        f"smoothed by those of {width} neighbouring lines of its channel."
    )
    return np.asarray(steady.reshape(sd.shape)), [Notice("noise_steadied", text)]


def _steady(variance: Array, freedom: Array, good: Mask) -> tuple[Array, int] | None:
    """Return smoothed variances (channel, freq) and the width; None when their scatter is another."""
    from scipy.special import chdtr, chdtrc, digamma, polygamma

    half_freedom, place = np.unique(freedom / 2.0, return_inverse=True)
    place = place.reshape(freedom.shape)
    shift = (np.log(half_freedom) - digamma(half_freedom))[place]
    expected = polygamma(1, half_freedom)[place]
    logs = np.log(variance) + shift
    if _local_scatter(logs, expected, good) < _LEAST_SCATTER:
        return None
    trend = _trend(logs, good)
    shared, wider = _common(logs - trend, expected, good)
    trend = trend + shared
    level, log_level = variance / np.exp(trend), logs - trend
    centre, _ = _average_neighbours(log_level, good.astype(float), _NEAR, True)
    ratio = level / np.exp(centre)
    alone = chdtrc(freedom, freedom * ratio / _ROUNDING) < _APART
    alone |= chdtr(freedom, freedom * ratio * _ROUNDING) < _APART
    used = good & ~alone
    if np.sum(used) < 0.8 * np.sum(good):
        return None
    weight = np.where(used, freedom, 0.0)
    half = _best_half(level, weight, used)
    mean, number = _average_neighbours(level, weight, half, True)
    own = expected + 2.0 / np.maximum(number, 1.0)
    scatter = float(np.sum((log_level - np.log(mean))[used] ** 2) / np.sum(own[used]))
    if not _LEAST_SCATTER < scatter < _MOST_SCATTER:
        return None
    excess = scatter - 1.0 - 3.0 * np.sqrt(3.0 / np.sum(used))
    width = 2 * half + 1
    if excess <= 0.02:
        mean, number = _average_neighbours(level, weight, half, False)
        mean = mean * number / np.maximum(number - 2.0, 1.0)
        shrunk = np.where(used, mean, level * freedom / np.maximum(freedom - 2.0, 1.0))
        return shrunk * wider * np.exp(trend), width
    prior = np.minimum(_from_trigamma((scatter - 1.0) * float(np.mean(expected[used]))), number)
    prior = np.where(used, np.maximum(prior, 2.0), 2.0)
    shrunk = ((prior - 1.0) * mean + freedom * level) / np.maximum(prior + freedom - 2.0, 1.0)
    return shrunk * wider * np.exp(trend), width


def _trend(logs: Array, good: Mask) -> Array:
    """Return a cubic (a mean, of few lines) through the logarithms of every row."""
    lines = logs.shape[1]
    base = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, lines), 3 if lines >= _TREND_FROM else 0)
    weight = good.astype(float)
    gram = np.einsum("fi,rf,fj->rij", base, weight, base, optimize=True) + 1e-9 * np.eye(base.shape[1])
    right = (weight * np.where(good, logs, 0.0)) @ base
    return np.asarray(np.linalg.solve(gram, right[:, :, None])[:, :, 0] @ base.T)


def _local_scatter(logs: Array, expected: Array, good: Mask) -> float:
    """Return the squares of second differences between every other line over what estimates give.

    It is their median, which few steps of the noise do not move.
    """
    near = good[:, 4:] & good[:, 2:-2] & good[:, :-4]
    if not np.any(near):
        return 0.0
    steps = (logs[:, 2:-2] - 0.5 * (logs[:, 4:] + logs[:, :-4]))[near]
    return float(np.median(steps**2 / expected[:, 2:-2][near])) / _MEDIAN / 1.5


def _common(logs: Array, expected: Array, good: Mask) -> tuple[Array, Array]:
    """Return the factor that all channels of a line share (freq,), as with a rough excitation.

    It is their mean, shrunk to what its scatter from line to line has beyond that of the estimates. With it
    comes a factor (freq,) for the variances: what is left unknown of the shared part spreads chi2 of a line
    as the F distribution does, and the factor brings its 95 % point back to that of known noise.
    """
    count = np.sum(good, axis=0)
    none, even = np.zeros(logs.shape[1]), np.ones(logs.shape[1])
    if np.median(count) < _LEAST_CHANNELS:
        return none, even
    safe = np.maximum(count, 1)
    mean = np.sum(np.where(good, logs, 0.0), axis=0) / safe
    own = np.sum(np.where(good, expected, 0.0), axis=0) / safe**2
    many = count >= _LEAST_CHANNELS
    near = many[4:] & many[2:-2] & many[:-4]
    steps = (mean[2:-2] - 0.5 * (mean[4:] + mean[:-4]))[near]
    total = float(np.median(steps**2)) / _MEDIAN / 1.5 if steps.size >= _LEAST_LINES // 2 else 0.0
    if total < _NOTABLE_COMMON * float(np.mean(own[many])):
        return none, even
    share = 1.0 - np.minimum(own / total, 1.0)
    return np.where(many, mean * share, 0.0), np.where(many, _spread(own * share, count), 1.0)


def _spread(unknown: Array, count: NDArray[np.intp]) -> Array:
    """Return the 95 % point of F over that of chi2, for the variance of a log noise (freq,) left unknown."""
    from scipy.special import chdtri, fdtri

    own = 2.0 * np.maximum(count - _MOTION, 1.0)
    other = 2.0 / np.maximum(unknown, 1e-6)
    return np.asarray(fdtri(own, other, 0.95) * own / chdtri(own, 0.05))


def _average_neighbours(values: Array, weight: Array, half: int, without: bool) -> tuple[Array, Array]:
    """Return the weighted mean of up to ``half`` lines on both sides, and its sum of weights.

    ``without`` leaves out the line itself and the next on both sides, with which a window of the analyser
    correlates it. Towards the ends the stretch shrinks evenly, to four lines.
    """
    lines = values.shape[1]
    place = np.arange(lines)
    reach = np.minimum(half, np.maximum(np.minimum(place, place[::-1]), 4))
    start, stop = np.maximum(place - reach, 0), np.minimum(place + reach + 1, lines)
    inner, outer = np.maximum(place - 1, 0), np.minimum(place + 2, lines)

    def summed(terms: Array) -> Array:
        total = np.cumsum(np.pad(terms, ((0, 0), (1, 0))), axis=1)
        total_of = total[:, stop] - total[:, start]
        return total_of - (total[:, outer] - total[:, inner]) if without else total_of

    number = np.maximum(summed(weight), 0.0)
    total = summed(np.where(weight > 0.0, values * weight, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(number > 0.0, total / number, 1.0)
    return mean, number


def _best_half(level: Array, weight: Array, used: Mask) -> int:
    """Return the half width whose means predict the lines left out best."""
    best, chosen = np.inf, 4
    half = 4
    while half <= max(4, level.shape[1] // 2):
        mean, _ = _average_neighbours(level, weight, half, True)
        mean = np.maximum(mean, 1e-12)
        score = float(np.sum(weight[used] * (np.log(mean[used]) + level[used] / mean[used])))
        if score < best:
            best, chosen = score, half
        half *= 2
    return chosen


def _from_trigamma(value: float) -> float:
    """Return d for which trigamma(d / 2) is ``value``, by bisection."""
    from scipy.special import polygamma

    low, high = 1e-3, 1e6
    for _ in range(100):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if polygamma(1, middle) > value else (low, middle)
    return float(2.0 * low)

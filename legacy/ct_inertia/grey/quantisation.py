"""What storing did to grey values: a range with two ends and steps; levels from before, and the mean effect.

A stored value is the true one plus noise, clipped to the range and rounded to a step. Near an end of the
range, and where steps are no smaller than the noise, its mean is not the true value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density, normal_quantile
from legacy.stapeskit.arrays import Array

# Values looked at for the step; more different ones than this have none that matters.
_SAMPLE, _MOST_STEPS = 400_000, 4096
# Bins of the histogram, where there are more steps: so many to a standard deviation of noise.
_MANY, _PER_NOISE = 200, 6.0
# Grid of level and noise, and how often it closes in on the posterior.
_LEVELS, _NOISES, _ZOOMS, _WITHIN = 41, 21, 5, 6.0
# Relative standard deviation of a noise that is taken from another material: noise of one scan differs by
# this much between air, plastic and bone.
_NOISE_SD = calibrated("store.noise_sd")
# Share of voxels that are anything else; share below which a grey value among few is an edge or dust.
_STRAY, _RARE = 1e-7, 0.01
# Steps above this share of the range: few enough to hold a whole material each.
_WIDE_STEP = 0.02
# Steps beyond the values seen that a material's noise may reach.
_BEYOND = 40
# Steps below this share of the noise leave the mean as it is (by less than 1e-4 of a step).
_FINE_STEP = 0.7


@dataclass(frozen=True)
class Level:
    """A grey level and its noise from before storing, with standard deviations.

    ``at_low`` and ``at_high`` are the shares of voxels at the ends of the range.
    """

    level: float
    noise: float
    sd: float
    at_low: float
    at_high: float


@dataclass(frozen=True)
class Quantisation:
    """Lowest and highest stored grey value, and the step between neighbouring ones (0: none).

    Where steps are wide, the highest grey value may be a step that holds all of a material: it is an end of
    the range only where the format ends there.
    """

    low: float
    high: float
    step: float

    @property
    def clips_low(self) -> bool:
        """Whether lower grey values may have been stored as the lowest one."""
        return self.low == 0.0 or not self._has_wide_steps

    @property
    def clips_high(self) -> bool:
        """Whether higher grey values may have been stored as the highest one."""
        bits = np.log2(max(self.high + self.step, 1.0))
        return not self._has_wide_steps or bool(abs(bits - np.rint(bits)) < 1e-9)

    @property
    def _has_wide_steps(self) -> bool:
        return self.step > _WIDE_STEP * (self.high - self.low)

    def mean_stored(self, true: Array, noise: float) -> Array:
        """Return the mean stored value (n,) of voxels of true values (n,) with a noise.

        Notes
        -----
        Clipped normal: E max(x, 0) = s (a Phi(a) + phi(a)), a = mean / s; for steps, the sum of the
        probabilities that the noise carries a value across each edge between two steps.
        """
        noise = max(noise, 1e-9 * max(self.high - self.low, 1e-30))
        if self.step < _FINE_STEP * noise:  # both ends clip, for steps are narrow
            return self.low + noise * (_ramp((true - self.low) / noise) - _ramp((true - self.high) / noise))
        below = 0 if self.clips_low else _BEYOND
        above = 0 if self.clips_high else _BEYOND
        start = self.low - below * self.step
        total = np.full(np.shape(true), start)
        for edge in np.arange(start + 0.5 * self.step, self.high + above * self.step, self.step):
            total += self.step * normal_cdf((true - edge) / noise)
        return total

    def mean_between(self, true: Array, low: Level, high: Level) -> Array:
        """Return the mean stored value (n,) where the noise changes from one level to another."""
        part = np.clip((true - low.level) / (high.level - low.level), 0.0, 1.0)
        below, above = self.mean_stored(true, low.noise), self.mean_stored(true, high.noise)
        return np.asarray((1.0 - part) * below + part * above)


def quantisation_of(values: NDArray[Any]) -> Quantisation:
    """Return range and step of stored grey values."""
    known = np.unique(values.ravel()[:: max(1, values.size // _SAMPLE)]).astype(float)
    step = float(np.diff(known).min()) if 1 < known.size <= _MOST_STEPS else 0.0
    return Quantisation(float(values.min()), float(values.max()), step)


def level_of(
    values: Array, store: Quantisation, noise: float | None = None, correlation: float = 1.0
) -> Level:
    """Fit a normal distribution to stored grey values: each is known to its step, the ends to one side.

    Parameters
    ----------
    values : ndarray, (n,)
    store : Quantisation
    noise : float, optional
        Its noise as another material shows it, known to 15 %.
    correlation : float
        Voxels per independent one.

    Returns
    -------
    Level
        Means and standard deviation of the posterior, on a grid that closes in.
    """
    values = _without_rare(values)
    tiny = 1e-6 * max(abs(store.high), abs(store.low), 1.0)
    at_low = float(np.mean(values <= store.low + tiny)) if store.clips_low else 0.0
    at_high = float(np.mean(values >= store.high - tiny)) if store.clips_high else 0.0
    spread = float(np.subtract(*np.percentile(values, (75.0, 25.0)))) / 1.349
    size = max(noise or 0.0, spread, 0.5 * store.step, 1e-12)
    low, high, count = _histogram(values, store, size, tiny)
    count = count / max(correlation, 1.0)
    middle = float(np.median(values))
    span = [middle - _WITHIN * size, middle + _WITHIN * size, np.log(0.03 * size), np.log(_WITHIN * size)]
    for pile, end, sign in ((at_low, store.low, 1.0), (at_high, store.high, -1.0)):
        beyond = sign * (values[sign * (values - end) > tiny] - end)
        if pile > 0.3 and beyond.size > 20:
            # Truncated normal: with a = (end - level) / noise, the mean beyond is noise (hazard(a) - a).
            a = float(normal_quantile(pile))
            hazard = float(normal_density(a)) / (1.0 - pile)
            size = max(float(beyond.mean()), 0.5 * store.step) / max(hazard - a, 1e-3)
            level = end - sign * a * size
            span = [level - 3.0 * size, level + 3.0 * size, np.log(0.4 * size), np.log(2.5 * size)]
    for _ in range(_ZOOMS):
        m, s = np.linspace(span[0], span[1], _LEVELS), np.linspace(span[2], span[3], _NOISES)
        z = np.exp(s)[None, :, None]
        share = normal_cdf((high - m[:, None, None]) / z) - normal_cdf((low - m[:, None, None]) / z)
        fit = np.log((1.0 - _STRAY) * share + _STRAY / max(len(count), 10)) @ count
        if noise is not None:
            fit = fit - 0.5 * ((s - np.log(noise)) / _NOISE_SD) ** 2
        p = np.exp(fit - fit.max())
        p /= p.sum()
        mean = np.array([p.sum(axis=1) @ m, p.sum(axis=0) @ s])
        sd = np.sqrt([p.sum(axis=1) @ (m - mean[0]) ** 2, p.sum(axis=0) @ (s - mean[1]) ** 2])
        sd = np.maximum(sd, 0.5 * np.array([m[1] - m[0], s[1] - s[0]]))
        span = [mean[0] - _WITHIN * sd[0], mean[0] + _WITHIN * sd[0]]
        span += [mean[1] - _WITHIN * sd[1], mean[1] + _WITHIN * sd[1]]
    return Level(float(mean[0]), float(np.exp(mean[1])), float(sd[0]), at_low, at_high)


def _without_rare(values: Array) -> Array:
    """Leave out rare grey values where two steps hold nearly all: they would pass for wide noise."""
    levels, count = np.unique(values, return_counts=True)
    most = np.sort(count)[::-1]
    if levels.size >= 30 or most[1:2].sum() <= 0.6 * most[1:].sum() - 0.5:
        return values
    return np.asarray(values[np.isin(values, levels[count > _RARE * values.size])])


def _histogram(values: Array, store: Quantisation, noise: float, tiny: float) -> tuple[Array, Array, Array]:
    """Return lower and upper limits and counts of bins; those at the ends of the range are open."""
    first, last = (
        (values <= store.low + tiny) & store.clips_low,
        (values >= store.high - tiny) & store.clips_high,
    )
    inner = values[~first & ~last]
    width = max(store.step, 1e-12)
    if inner.size and float(np.ptp(inner)) > _MANY * width:
        width = max(width, noise / _PER_NOISE)
    keys, count = np.unique(np.floor((inner - store.low) / width + 1e-9), return_counts=True)
    low = store.low + keys * width - 0.5 * store.step
    ends = store.low + 0.5 * store.step, store.high - 0.5 * store.step
    high = low + width
    low = np.maximum(low, ends[0]) if store.clips_low else low
    high = np.minimum(high, ends[1]) if store.clips_high else high
    for some, a, b in ((first, -np.inf, ends[0]), (last, ends[1], np.inf)):
        if np.any(some):
            low, high, count = np.r_[low, a], np.r_[high, b], np.r_[count, np.count_nonzero(some)]
    return low, high, count.astype(float)


def _ramp(a: Array) -> Array:
    return a * normal_cdf(a) + normal_density(a)

"""What storing did to grey values: a range with two ends and steps; levels from before, and the mean effect.

A stored value is the true one plus noise, clipped to the range and rounded to a step. Near an end of the
range, and where steps are no smaller than the noise, its mean is not the true value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Labelled
from ct_inertia.calibrated import calibrated
from ct_inertia.find.distance import capped_distance
from ct_inertia.grey.start import Start
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_SAMPLE, _MOST_VALUES = 400_000, 4096  # values looked at; more different ones have no step that matters
_FINE_STEP = 0.7  # steps below this share of the noise leave the mean as it is, by less than 1e-4 of a step
_WIDE_STEP = 0.02  # steps above this share of the range: few enough to hold a whole material each
_PILE = 0.01  # share of a material's voxels at an end of the range from which it is clipped
_STRAY = 1e-7  # share of voxels that are anything else
_BINS_PER_NOISE, _MOST_BINS = 6.0, 400
_LEVELS, _NOISES, _ZOOMS, _WITHIN = 41, 21, 5, 6.0  # grid of level and noise, and how often it closes in
_LEAST_DEEP = 200  # voxels of pure bone from which its level is read
_MODEL_SD = calibrated("storing.model_sd")
_WITHIN_STEP = calibrated("storing.within_step")
_NOISE_SD = calibrated("storing.noise_sd")
_MOST_CLIPPED = calibrated("storing.most_clipped")
_OTHER_NOISE = calibrated("storing.other_noise")
_LEAST_KNOWN = calibrated("storing.least_known")


@dataclass(frozen=True)
class StoredLevel:
    """A grey level and its noise from before storing; ``at_low``, ``at_high``: shares at the ends."""

    level: float
    noise: float
    sd: float
    at_low: float
    at_high: float


@dataclass(frozen=True)
class Storing:
    """Lowest and highest stored grey value, the step between neighbouring ones (0: none), and two materials.

    Attributes
    ----------
    low, high, step : float
    air, bone : StoredLevel
    """

    low: float
    high: float
    step: float
    air: StoredLevel
    bone: StoredLevel

    @property
    def coarse(self) -> bool:
        """Whether steps are no smaller than the noise."""
        return self.step > _FINE_STEP * min(self.air.noise, self.bone.noise)

    @property
    def air_sd(self) -> float:
        """Standard deviation of the level of air that storing leaves."""
        return self._level_sd(self.air)

    @property
    def bone_sd(self) -> float:
        """Standard deviation of the level of bone that storing leaves."""
        return self._level_sd(self.bone)

    def _level_sd(self, level: StoredLevel) -> float:
        moved = float(self.change(np.array([level.level], dtype=np.float32))[0])
        within = _WITHIN_STEP * self.step if self.coarse else 0.0
        return float(np.sqrt(level.sd**2 + (_MODEL_SD * moved) ** 2 + within**2))

    def noise_ratio(self, shown: float) -> float:
        """Return the noise of air from before storing over that of stored voxels, at least 1."""
        return max(1.0, self.air.noise / max(shown, 1e-30)) if self.air.at_low > _PILE else 1.0

    def change(self, model: Grey) -> Grey:
        """Return the mean stored value less the true one (any shape), for true grey values without noise."""
        margin = 6.0 * max(self.air.noise, self.bone.noise, self.step)
        grid = np.linspace(self.low - margin, self.high + margin, 2001)
        part = np.clip((grid - self.air.level) / (self.bone.level - self.air.level), 0.0, 1.0)
        stored = (1.0 - part) * self._mean(grid, self.air.noise) + part * self._mean(grid, self.bone.noise)
        return np.interp(model, grid, stored - grid).astype(np.float32)

    def _mean(self, true: Array, noise: float) -> Array:
        """Return the mean stored value (n,) of voxels of true values (n,) with a noise.

        Notes
        -----
        Clipped normal: E max(x, 0) = s (a Phi(a) + phi(a)), a = mean / s; for wide steps the sum of the
        probabilities that noise carries a value across each edge between two steps.
        """
        from scipy.special import ndtr

        noise = max(noise, 1e-9 * max(self.high - self.low, 1e-30))
        if self.step < _FINE_STEP * noise:
            return self.low + noise * (_ramp((true - self.low) / noise) - _ramp((true - self.high) / noise))
        below, above = (0 if clips else 40 for clips in _clips(self.low, self.high, self.step))
        edges = np.arange(self.low - (below - 0.5) * self.step, self.high + above * self.step, self.step)
        steps = ndtr((true[:, None] - edges) / noise).sum(axis=1)
        return np.asarray(self.low - below * self.step + self.step * steps)


def storing_around(labelled: Labelled, begin: Start) -> Storing | None:
    """Find what storing did to the scan around the stapes; see `find_storing`."""
    box = labelled.box
    stored = (box.grey if box.single is None else box.single)[begin.part]
    depth = capped_distance(~begin.masks["stapes"], box.spacing_mm, 3.2 * begin.sigma_mm)
    deep = depth > np.float32(3.0 * begin.sigma_mm)
    if np.count_nonzero(deep) < _LEAST_DEEP:
        deep = depth > np.float32(0.8 * float(depth.max()))
    air = stored[begin.far]
    return find_storing(stored, air[:: max(1, air.size // _SAMPLE)], stored[deep], begin.correlation)


def storing_notices(storing: Storing | None) -> list[Notice]:
    """Report clipped air, clipped bone and coarse steps."""
    notices: list[Notice] = []
    if storing is None:
        return notices
    if storing.air.at_low > _PILE:
        text = (
            f"{100.0 * storing.air.at_low:.0f} % of the air voxels lie at the lowest grey value: the export "
            "has clipped them. That was corrected for, and the budget holds what remains (levels). Export "
            "with a window that begins below air and its noise."
        )
        notices.append(Notice("air_clipped", text))
    if storing.bone.at_high > _PILE:
        text = (
            f"{100.0 * storing.bone.at_high:.0f} % of the voxels deep inside bone lie at the highest grey "
            "value: the export has clipped them. That was corrected for, and the budget holds what remains "
            "(levels). Export with a window that ends above bone and its noise."
        )
        notices.append(Notice("bone_clipped", text))
    if storing.coarse:
        share = 100.0 * storing.step / (storing.bone.level - storing.air.level)
        text = (
            f"The grey values have steps of {share:.1f} % of the contrast between air and bone, no smaller "
            "than the noise: levels are uncertain by a fraction of one grey step (budget: levels). Export "
            "with 16 bits."
        )
        notices.append(Notice("grey_steps_coarse", text))
    return notices


def find_storing(
    stored: NDArray[Any], air: NDArray[Any], bone: NDArray[Any], correlation: float
) -> Storing | None:
    """Find what storing did to air and bone; None where neither an end of the range nor steps matter.

    Parameters
    ----------
    stored : ndarray
        Grey values of single voxels as stored, for range and step.
    air, bone : ndarray, (n,)
        Those of pure air and of pure bone.
    correlation : float
        Voxels per independent one.

    Raises
    ------
    StapeskitError
        A level that the stored values leave open: nearly all air at the lowest value, or both materials in
        one step each.
    """
    if air.size < 50 or bone.size < 20:
        return None
    low, high = float(stored.min()), float(stored.max())
    known = np.unique(stored.ravel()[:: max(1, stored.size // _SAMPLE)]).astype(float)
    step = float(np.diff(known).min()) if 1 < known.size <= _MOST_VALUES else 0.0
    tiny = 1e-6 * max(abs(high), abs(low), 1.0)
    spread = float(np.subtract(*np.percentile(air, (75.0, 25.0)))) / 1.349
    piles = float(np.mean(air <= low + tiny)), float(np.mean(bone >= high - tiny))
    if max(piles) < _PILE and step < _FINE_STEP * max(spread, 1e-30):
        return None
    ends = low, high, step
    air_level = stored_level(air.astype(float), ends, correlation=correlation)
    bone_level = stored_level(bone.astype(float), ends, correlation=correlation)
    if air_level.at_low > 0.3:
        air_level = stored_level(air.astype(float), ends, bone_level.noise, correlation)
    if bone_level.at_high > 0.3:
        bone_level = stored_level(bone.astype(float), ends, air_level.noise, correlation)
    storing = Storing(low, high, step, air_level, bone_level)
    _refuse_open(storing)
    return storing


def stored_level(
    values: Array, ends: tuple[float, float, float], noise: float | None = None, correlation: float = 1.0
) -> StoredLevel:
    """Fit a normal distribution to stored grey values: each is known to its step, the ends to one side.

    Parameters
    ----------
    values : ndarray, (n,)
    ends : (low, high, step)
    noise : float, optional
        Its noise as another material shows it, known to a calibrated share.
    correlation : float
        Voxels per independent one.

    Returns
    -------
    StoredLevel
        Means and standard deviation of the posterior on a grid of level and noise that closes in.
    """
    from scipy.special import ndtr

    low, high, step = ends
    tiny = 1e-6 * max(abs(high), abs(low), 1.0)
    clips_low, clips_high = _clips(low, high, step)
    at_low = float(np.mean(values <= low + tiny)) if clips_low else 0.0
    at_high = float(np.mean(values >= high - tiny)) if clips_high else 0.0
    spread = float(np.subtract(*np.percentile(values, (75.0, 25.0)))) / 1.349
    size = max(noise or 0.0, spread, 0.5 * step, 1e-12)
    lower, upper, count = _bins(values, (low, high, max(step, 1e-12)), size, (clips_low, clips_high))
    count = count / max(correlation, 1.0)
    span = _first_span(values, size, (at_low, at_high), (low, high, step))
    mean, sd = np.zeros(2), np.zeros(2)
    for _ in range(_ZOOMS):
        levels, logs = np.linspace(span[0], span[1], _LEVELS), np.linspace(span[2], span[3], _NOISES)
        scale = np.exp(logs)[None, :, None]
        share = ndtr((upper - levels[:, None, None]) / scale) - ndtr((lower - levels[:, None, None]) / scale)
        fit = np.log((1.0 - _STRAY) * share + _STRAY / max(len(count), 10)) @ count
        if noise is not None:
            fit = fit - 0.5 * ((logs - np.log(noise)) / _NOISE_SD) ** 2
        weight = np.exp(fit - fit.max())
        weight /= weight.sum()
        mean = np.array([weight.sum(axis=1) @ levels, weight.sum(axis=0) @ logs])
        sd = np.array(
            [weight.sum(axis=1) @ (levels - mean[0]) ** 2, weight.sum(axis=0) @ (logs - mean[1]) ** 2]
        )
        sd = np.maximum(np.sqrt(sd), 0.5 * np.array([levels[1] - levels[0], logs[1] - logs[0]]))
        span = [
            mean[0] - _WITHIN * sd[0],
            mean[0] + _WITHIN * sd[0],
            mean[1] - _WITHIN * sd[1],
            mean[1] + _WITHIN * sd[1],
        ]
    return StoredLevel(float(mean[0]), float(np.exp(mean[1])), float(sd[0]), at_low, at_high)


def _first_span(
    values: Array, size: float, piles: tuple[float, float], ends: tuple[float, float, float]
) -> list[float]:
    """Return the first range of level and log noise; by the truncated normal where clipped.

    Notes
    -----
    With a = (end - level) / noise the mean beyond the end is noise (hazard(a) - a).
    """
    from scipy.special import ndtri

    low, high, step = ends
    middle = float(np.median(values))
    span = [middle - _WITHIN * size, middle + _WITHIN * size, np.log(0.03 * size), np.log(_WITHIN * size)]
    for pile, end, sign in ((piles[0], low, 1.0), (piles[1], high, -1.0)):
        beyond = sign * (values - end)
        beyond = beyond[beyond > 1e-9]
        if pile > 0.3 and beyond.size > 20:
            a = float(ndtri(min(pile, 0.999)))
            hazard = float(np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi)) / (1.0 - min(pile, 0.999))
            width = max(float(beyond.mean()), 0.5 * step) / max(hazard - a, 1e-3)
            level = end - sign * a * width
            span = [level - 3.0 * width, level + 3.0 * width, np.log(0.4 * width), np.log(2.5 * width)]
    return span


def _clips(low: float, high: float, step: float) -> tuple[bool, bool]:
    """Return whether values may have been clipped at either end of the range.

    Where steps are wide, the highest grey value may be a step that holds all of a material: it is an end of
    the range only where the format ends there.
    """
    if step <= _WIDE_STEP * (high - low):
        return True, True
    bits = np.log2(max(high + step, 1.0))
    return low == 0.0, bool(abs(bits - np.rint(bits)) < 1e-9)


def _bins(
    values: Array, ends: tuple[float, float, float], noise: float, clips: tuple[bool, bool]
) -> tuple[Array, Array, Array]:
    """Return lower and upper limits and counts of bins; those at the ends of the range are open."""
    low, high, step = ends
    tiny = 1e-6 * max(abs(high), abs(low), 1.0)
    first, last = (values <= low + tiny) & clips[0], (values >= high - tiny) & clips[1]
    inner = values[~first & ~last]
    width = step
    if inner.size and float(np.ptp(inner)) > _MOST_BINS * width:
        width = max(width, noise / _BINS_PER_NOISE)
    keys, count = np.unique(np.floor((inner - low) / width + 1e-9), return_counts=True)
    lower = low + keys * width - 0.5 * step
    upper = lower + width
    lower = np.maximum(lower, low + 0.5 * step) if clips[0] else lower
    upper = np.minimum(upper, high - 0.5 * step) if clips[1] else upper
    for some, a, b in ((first, -np.inf, low + 0.5 * step), (last, high - 0.5 * step, np.inf)):
        if some.any():
            lower, upper, count = np.r_[lower, a], np.r_[upper, b], np.r_[count, np.count_nonzero(some)]
    return lower, upper, count.astype(float)


def _refuse_open(storing: Storing) -> None:
    """Refuse levels that the stored grey values leave open."""
    air, bone = storing.air, storing.bone
    contrast = bone.level - air.level
    unknown = max(air.sd, bone.sd) > _LEAST_KNOWN * contrast
    hidden = air.at_low > _MOST_CLIPPED and air.noise > _OTHER_NOISE * bone.noise
    burnt = bone.at_high > _MOST_CLIPPED and bone.noise > _OTHER_NOISE * air.noise
    if unknown or hidden or burnt or not contrast > 0.0:
        raise StapeskitError.of(
            "the range of the grey values",
            "wide enough to hold air and bone with their noise",
            f"{100.0 * air.at_low:.0f} % of the air at the lowest value, {100.0 * bone.at_high:.0f} % of "
            f"the bone at the highest, steps of {100.0 * storing.step / max(contrast, 1e-30):.2g} % of "
            "their contrast",
            next_step="Export 16 bits with a window that begins below air and ends above bone",
        )


def _ramp(a: Array) -> Array:
    from scipy.special import ndtr

    return np.asarray(a * ndtr(a) + np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi))

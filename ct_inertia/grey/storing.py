"""Clipping and rounding of stored grey values: the levels before them, and their mean effect.

A stored value is the true one plus noise, clipped to the range and rounded to a step. Near an end of the
range, and where steps are no smaller than the noise, its mean is not the true value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Labelled
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.start import Start
from ct_inertia.voxels.distance import capped_distance
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_SAMPLE, _MOST_VALUES = 400_000, 4096  # values looked at; more different ones have no step that matters
_FINE_STEP = 0.7  # steps below this share of the noise leave the mean as it is, by less than 1e-4 of a step
_WIDE_STEP = 0.02  # steps above this share of the range: few enough to hold a whole material each
_PILE = 0.01  # share of a material's voxels at an end of the range from which it is clipped
_HIDDEN = 0.3  # the same, from which another material gives the noise
_STRAY = 1e-7  # share of voxels that are anything else
_BIN = 0.25  # of the spread of the values: wider bins lose what the values say of the level
_NARROWEST = 1e-5  # of the range: a material may be one value throughout, and its spread 0
_GRID, _ZOOMS = (41, 21), 7  # levels and noises that are tried, and how often the grid closes in
_WITHIN = 6.0  # standard deviations of the posterior that a closer grid reaches to
_LEAST_DEEP = 200  # voxels of pure bone from which its level is read
_STILL = 2e-3  # of the contrast: less between neighbours in bone is no noise; scans have 5e-3 and more
_FAINT, _DIM = 0.01, 0.1  # of the contrast, from an end of the range: the last and the rest of an edge's tail
_SOFT = 0.25  # faint voxels per dim one: 0.5 to 1.5 where blur fades, 0.11 on the line that a window cuts
_MODEL_SD = calibrated("storing.model_sd")
_WITHIN_STEP = calibrated("storing.within_step")
_NOISE_SD = calibrated("storing.noise_sd")
_MOST_CLIPPED = calibrated("storing.most_clipped")
_OTHER_NOISE = float(np.exp(3.0 * _NOISE_SD))  # ratio of noises of which neither can be the other's
_LEAST_KNOWN = calibrated("storing.least_known")


@dataclass(frozen=True)
class Range:
    """Lowest and highest stored grey value, and the step between neighbouring ones (0: none).

    ``may_clip`` is False for a picture without noise: all of a material has one value in it, its level.
    """

    low: float
    high: float
    step: float
    may_clip: bool = True

    @property
    def rounding(self) -> float:
        """Difference up to which values are equal."""
        return 1e-6 * max(abs(self.high), abs(self.low), 1.0)

    @property
    def clips(self) -> tuple[bool, bool]:
        """Whether values may have been clipped at the low and at the high end.

        Where steps are wide, the highest grey value may be a step that holds all of a material: it is an end
        of the range only where the format ends there.
        """
        if not self.may_clip or self.step <= _WIDE_STEP * (self.high - self.low):
            return self.may_clip, self.may_clip
        bits = np.log2(max(self.high + self.step, 1.0))
        return self.low == 0.0, bool(abs(bits - np.rint(bits)) < 1e-9)

    def piles(self, values: NDArray[Any]) -> tuple[float, float]:
        """Return the shares of values at the low and at the high end, 0 where nothing clips."""
        at = values <= self.low + self.rounding, values >= self.high - self.rounding
        low, high = (float(np.mean(end)) if clips else 0.0 for end, clips in zip(at, self.clips, strict=True))
        return low, high


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
    """A range, and two materials in it from before storing."""

    range: Range
    air: StoredLevel
    bone: StoredLevel

    @property
    def contrast(self) -> float:
        """Of bone over air."""
        return self.bone.level - self.air.level

    @property
    def coarse(self) -> bool:
        """Whether steps are no smaller than the noise."""
        return self.range.step > _FINE_STEP * min(self.air.noise, self.bone.noise)

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
        within = _WITHIN_STEP * self.range.step if self.coarse else 0.0
        return float(np.sqrt(level.sd**2 + (_MODEL_SD * moved) ** 2 + within**2))

    def change(self, model: Grey) -> Grey:
        """Return the mean stored value less the true one (any shape), for true grey values without noise."""
        low, high = self.range.low, self.range.high
        margin = 6.0 * max(self.air.noise, self.bone.noise, self.range.step)
        grid = np.linspace(low - margin, high + margin, 2001)
        part = np.clip((grid - self.air.level) / self.contrast, 0.0, 1.0)
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

        low, high, step = self.range.low, self.range.high, self.range.step
        noise = max(noise, 1e-9 * max(high - low, 1e-30))
        if step < _FINE_STEP * noise:
            a, b = (true - low) / noise, (true - high) / noise
            ramps = [x * ndtr(x) + np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) for x in (a, b)]
            return np.asarray(low + noise * (ramps[0] - ramps[1]))
        below, above = (0 if clips else 40 for clips in self.range.clips)
        edges = np.arange(low - (below - 0.5) * step, high + above * step, step)
        return np.asarray(low - below * step + step * ndtr((true[:, None] - edges) / noise).sum(axis=1))

    def notices(self) -> list[Notice]:
        """Report clipped air, clipped bone and coarse steps."""
        notices = []
        for share, code, which, advice in (
            (self.air.at_low, "air_clipped", ("air voxels", "lowest"), "begins below air"),
            (self.bone.at_high, "bone_clipped", ("voxels deep inside bone", "highest"), "ends above bone"),
        ):
            if share > _PILE:
                text = (
                    f"{100.0 * share:.0f} % of the {which[0]} lie at the {which[1]} grey value: the export "
                    "has clipped them. That was corrected for, and the budget holds what remains (levels). "
                    f"Export with a window that {advice} and its noise."
                )
                notices.append(Notice(code, text))
        if self.coarse:
            text = (
                f"The grey values have steps of {100.0 * self.range.step / self.contrast:.1f} % of the "
                "contrast between air and bone, no smaller than the noise: levels are uncertain by a "
                "fraction of one grey step (budget: levels). Export with 16 bits."
            )
            notices.append(Notice("file_read", text))
        return notices

    def corrected(self, begin: Start) -> Start:
        """Take levels and noise of a start from before storing."""
        contrasts = {
            name: value if name == "plate" else self.contrast * value / begin.contrasts["stapes"]
            for name, value in begin.contrasts.items()
        }
        clipped = self.air.at_low > _PILE
        return replace(
            begin,
            air=self.air.level,
            noise=max(begin.noise, self.air.noise) if clipped else begin.noise,
            air_sd=float(np.hypot(begin.air_sd, self.air_sd)),
            contrasts=contrasts,
        )


def storing_around(labelled: Labelled, begin: Start) -> Storing | None:
    """Find what storing did to the scan around the stapes; see `find_storing`."""
    stored = labelled.box.stored[begin.part]
    depth = capped_distance(~begin.masks["stapes"], labelled.box.spacing_mm, 3.2 * begin.sigma_mm)
    deep = depth > np.float32(3.0 * begin.sigma_mm)
    if np.count_nonzero(deep) < _LEAST_DEEP:
        deep = depth > np.float32(0.8 * float(depth.max()))
    pairs = deep[..., 1:] & deep[..., :-1]
    steps = np.abs(np.diff(stored.astype(np.float32), axis=-1)[pairs])
    bone_step = float(np.median(steps)) if steps.size else np.inf
    return find_storing(stored, stored[begin.far], stored[deep], begin.correlation, bone_step)


def find_storing(
    stored: NDArray[Any], air: NDArray[Any], bone: NDArray[Any], correlation: float, bone_step: float = np.inf
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
    bone_step : float
        Usual difference of neighbours in pure bone, which tells a picture without noise from a clipped one.

    Raises
    ------
    StapeskitError
        A level that the stored values leave open: nearly all air at the lowest value, or both materials in
        one step each.
    """
    if air.size < 50 or bone.size < 20:
        return None
    air = air[:: max(1, air.size // _SAMPLE)].astype(float)
    bone = bone.astype(float)
    known = np.unique(stored.ravel()[:: max(1, stored.size // _SAMPLE)]).astype(float)
    step = float(np.diff(known).min()) if 1 < known.size <= _MOST_VALUES else 0.0
    ends = Range(float(stored.min()), float(stored.max()), step)
    piles = replace(ends, step=0.0).piles(air)[0], replace(ends, step=0.0).piles(bone)[1]
    still = _STILL * float(np.median(bone) - np.median(air))
    if bone_step < still and _fades(stored, ends, still / _STILL, piles):
        ends, piles = replace(ends, may_clip=False), (0.0, 0.0)
    if max(piles) < _PILE and step < (_FINE_STEP * _spread(air) if ends.may_clip else still):
        return None
    levels = [stored_level(values, ends, correlation=correlation) for values in (air, bone)]
    if levels[0].at_low > _HIDDEN:
        levels[0] = stored_level(air, ends, levels[1].noise, correlation)
    if levels[1].at_high > _HIDDEN:
        levels[1] = stored_level(bone, ends, levels[0].noise, correlation)
    storing = Storing(ends, levels[0], levels[1])
    _refuse_open(storing)
    return storing


def _fades(stored: NDArray[Any], ends: Range, contrast: float, piles: tuple[float, float]) -> bool:
    """Return whether edges fade into every end of the range at which a material piles up.

    Without noise all of a material has one value and is not clipped: blur fades into it. A picture whose
    noise lies beyond its window has constant materials as well, but its edges end in them like a line.
    """
    for pile, away in zip(piles, (stored - ends.low, ends.high - stored), strict=True):
        faint = max(_FAINT * contrast, 1.5 * ends.step)
        at_end, in_tail = (np.count_nonzero((away > 0) & (away < end)) for end in (faint, _DIM * contrast))
        if pile >= _PILE and at_end <= _SOFT * (in_tail - at_end):
            return False
    return True


def stored_level(
    values: Array, ends: Range, noise: float | None = None, correlation: float = 1.0
) -> StoredLevel:
    """Fit a normal distribution to stored grey values: each is known to its step, the ends to one side.

    Parameters
    ----------
    values : ndarray, (n,)
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

    lower, upper, count = _intervals(values, ends)
    size = max(float(np.std(values)), 0.5 * ends.step, noise or 0.0, 1e-12)
    middle = np.array([float(np.median(values)), np.log(size)])
    reach = np.array([10.0 * size, np.log(30.0)])
    sd = reach
    for _ in range(_ZOOMS):
        levels, logs = (np.linspace(m - r, m + r, n) for m, r, n in zip(middle, reach, _GRID, strict=True))
        scale = np.exp(np.clip(logs, *np.log(size * np.array([1e-6, 1e6]))))[None, :, None]
        share = ndtr((upper - levels[:, None, None]) / scale) - ndtr((lower - levels[:, None, None]) / scale)
        fit = np.log((1.0 - _STRAY) * share + _STRAY / max(len(count), 10)) @ (count / max(correlation, 1.0))
        if noise is not None:
            fit = fit - 0.5 * ((logs - np.log(noise)) / _NOISE_SD) ** 2
        weight = np.exp(fit - fit.max())
        weight /= weight.sum()
        by_level, by_noise = weight.sum(axis=1), weight.sum(axis=0)
        middle = np.array([by_level @ levels, by_noise @ logs])
        variance = np.array([by_level @ (levels - middle[0]) ** 2, by_noise @ (logs - middle[1]) ** 2])
        sd = np.maximum(np.sqrt(variance), reach / (np.array(_GRID) - 1.0))
        reach = _WITHIN * sd
    return StoredLevel(float(middle[0]), float(np.exp(middle[1])), float(sd[0]), *ends.piles(values))


def _intervals(values: Array, ends: Range) -> tuple[Array, Array, Array]:
    """Return lower and upper limits of intervals, and how many values each holds; clipped ends are open."""
    half = max(0.5 * ends.step, ends.rounding)
    low, high = ends.low + half, ends.high - half
    fine = _BIN * _spread(values[(values > low) & (values < high)])
    width = (
        max(fine, _NARROWEST * (high - low), 1e-12)
        if ends.step == 0.0
        else ends.step * max(1.0, np.floor(fine / ends.step))
    )
    edges = np.concatenate([np.arange(low, high, width), [high]])
    clips_low, clips_high = ends.clips
    edges = np.concatenate(
        [[-np.inf if clips_low else low - 2.0 * half], edges, [np.inf if clips_high else high + 2.0 * half]]
    )
    place, count = np.unique(np.searchsorted(edges, values, side="right"), return_counts=True)
    return edges[place - 1], edges[place], count.astype(float)


def _spread(values: Array) -> float:
    return float(np.subtract(*np.percentile(values, (75.0, 25.0)))) / 1.349 if values.size else 0.0


def _refuse_open(storing: Storing) -> None:
    """Refuse levels that the stored grey values leave open."""
    air, bone, contrast = storing.air, storing.bone, storing.contrast
    unknown = max(air.sd, bone.sd) > _LEAST_KNOWN * contrast
    hidden = air.at_low > _MOST_CLIPPED and air.noise > _OTHER_NOISE * bone.noise
    burnt = bone.at_high > _MOST_CLIPPED and bone.noise > _OTHER_NOISE * air.noise
    if unknown or hidden or burnt or not contrast > 0.0:
        raise StapeskitError.of(
            "the range of the grey values",
            "wide enough to hold air and bone with their noise",
            f"{100.0 * air.at_low:.0f} % of the air at the lowest value, {100.0 * bone.at_high:.0f} % of "
            f"the bone at the highest, steps of {100.0 * storing.range.step / max(contrast, 1e-30):.2g} % of "
            "their contrast",
            next_step="Export 16 bits with a window that begins below air and ends above bone",
        )

"""Do repeats and levels of one excitation agree? Drift, creep, nonlinearity and outliers, with p-values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.measurement import Take
from legacy.kinematics.repeats.repeat_shapes import Shapes
from legacy.kinematics.repeats.repeat_tests import (
    SHAPE,
    RepeatTest,
    gain_tests,
    regressors,
    scatter_test,
    shape_tests,
)
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Share of good sets of repeats that may raise an alarm, over all tests together.
ALARM = 0.05
_NOTABLE_SCATTER: float = calibrated("repeats.notable_scatter")
# Probability below which scatter beyond the stated noise is reported.
_CERTAIN = 1e-3
_SHIFT_SHARE: float = calibrated("repeats.shift_share")
_LEAST_OUTLIER_GAIN: float = calibrated("repeats.least_outlier_gain")
_OUTLIER_RATIO: float = calibrated("repeats.outlier_ratio")


def _words(take: Take) -> str:
    """Name a take within its run."""
    level = f"level {take.level:.12g}" if np.isfinite(take.level) else ""
    return " at ".join(filter(None, [f"repeat {take.repeat}" if take.repeat else "", level])) or take.run


@dataclass(frozen=True)
class RunRepeats:
    """The comparison of the takes of one run.

    Attributes
    ----------
    takes : tuple of Take, (take,)
    gain, phase_deg : ndarray, (take,)
        Amplitude of each take relative to their geometric mean (per unit of level when levels are stated),
        and phase relative to the mean.
    found : tuple of RepeatTest
        Those that raise an alarm.
    lines, channels : int
        Lines on which the takes could be compared, and channels measured in all takes.
    sd_factor : float
        Factor by which the repeats scatter more than the stated noise; NaN when none is stated.
    gain_sd, phase_sd : float
        Standard deviation of the pooled gain (relative) and phase (rad) from the scatter between takes.
    noise_from_repeats : bool
        The noise of the pooled values was estimated from the scatter between the takes.
    were_pooled : bool
        The takes were pooled into one run; else each is a separate run.
    shift : ndarray, (take,)
        Relative shift of each take's responses along the frequency (a moving resonance); NaN when it cannot
        be identified. ``shift_share`` is the part of all differences that it explains.
    """

    run: str
    takes: tuple[Take, ...]
    gain: Array
    phase_deg: Array
    tests: tuple[RepeatTest, ...]
    found: tuple[RepeatTest, ...]
    lines: int
    channels: int
    sd_factor: float
    gain_sd: float
    phase_sd: float
    noise_from_repeats: bool = False
    were_pooled: bool = True
    shift: Array = field(default_factory=lambda: np.empty(0))
    shift_share: float = 0.0

    @property
    def verdict(self) -> str:
        """``repeats_agree``, ``repeats_untested``, or the code of the most certain finding."""
        if self.found:
            return code_of(min(self.found, key=lambda test: test.p_value))
        return "repeats_agree" if self.tests else "repeats_untested"

    @property
    def summary(self) -> str:
        """Return one sentence for the terminal and the report."""
        many = _count(self.takes)
        scatter = 100.0 * float(np.std(self.gain, ddof=1))
        turn = float(np.std(self.phase_deg, ddof=1))
        gains = f"amplitudes scatter by {scatter:.2g} %, phases by {turn:.2g} degrees"
        fate = "were pooled" if self.were_pooled else "were kept separate"
        if self.verdict == "repeats_agree":
            return f"{many} agree in shape ({gains}) and {fate}"
        if self.verdict == "repeats_untested":
            return f"{many} {fate} untested ({gains}): too few lines, channels or repeats to compare"
        but = "though they disagree: " if self.were_pooled else "and disagree: "
        return f"{many} {fate} {but}" + "; ".join(self.said(test) for test in self.found)

    def said(self, test: RepeatTest) -> str:
        """Write one finding in words."""
        p = f"p = {test.p_value:.2g}"
        percent = f"{100.0 * test.size:+.2g} %"
        which = _words(self.takes[test.take]) if test.take >= 0 else ""
        return {
            "gain_trend": f"the amplitude of all channels drifts by {percent} over the repeats ({p})",
            "phase_trend": f"the phase of all channels drifts by {np.degrees(test.size):+.2g} degrees ({p})",
            "gain_outlier": f"{which} differs by {percent} in amplitude from the others ({p})",
            "gain_level": f"the amplitude grows as level to the power {1.0 + test.size:.3g} ({p})",
            "shape_trend": f"the responses change relative to each other by {percent} from the first repeat "
            f"to the last{self._describe_shift()} ({p})",
            "shape_level": f"the responses change relative to each other by {percent} from the lowest level "
            f"to the highest{self._describe_shift()} ({p})",
            "shape_outlier": f"{which} differs by {percent} in its shape from the others ({p})",
            "shape_scatter": f"the repeats scatter {test.size:.2g} times as much as the stated noise ({p})",
        }[test.name]

    def _describe_shift(self) -> str:
        """Return how far resonances seem to have moved, when that explains the differences."""
        if self.shift_share < _SHIFT_SHARE:
            return ""
        time, level = regressors(self.takes)
        order = time if time is not None else level
        if order is None:
            return ""
        ends = [float(np.mean(self.shift[order == end])) for end in (order.min(), order.max())]
        if level is not None and any(test.name == "shape_level" for test in self.found):
            ends = [float(np.mean(self.shift[level == end])) for end in (level.min(), level.max())]
        return f", as if resonances moved by {100.0 * (ends[1] - ends[0]):+.2g} %"

    def notices(self, several: bool) -> list[Notice]:
        """Return one warning for each finding."""
        where = f" of run {self.run}" if several else ""
        many = _count(self.takes)
        notices = [
            Notice(_CODES[test.name], f"{many}{where}: {self.said(test)}. {_ADVICE[_CODES[test.name]]}")
            for test in self.found
        ]
        apart = self._apart()
        return notices + ([Notice("repeat_outlier", f"{many}{where}: {apart}")] if apart else [])

    def _apart(self) -> str:
        """Report the take whose gain differs far more than the others', unless a test has reported it."""
        if any(test.name not in SHAPE and test.name != "shape_scatter" for test in self.found):
            return ""
        size, turn = self.gain / np.median(self.gain), self.phase_deg - np.median(self.phase_deg)
        turn = (turn + 180.0) % 360.0 - 180.0
        far = np.hypot(np.log(size), np.radians(turn))
        worst = int(np.argmax(far))
        others = np.delete(far, worst)
        if (
            len(others) < 2
            or far[worst] < _LEAST_OUTLIER_GAIN
            or far[worst] < _OUTLIER_RATIO * np.max(others)
        ):
            return ""
        fate = "the mean of all was taken, and its scatter" if self.were_pooled else "the scatter"
        return (
            f"{_words(self.takes[worst])} differs by {100.0 * (size[worst] - 1.0):+.2g} % in amplitude and "
            f"{turn[worst]:+.3g} degrees in phase, in all channels alike, from the middle of them; {fate} "
            "is kept as an error that all lines share. Responses per reference do not contain it."
        )

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON-able data."""
        return {
            "run": self.run,
            "verdict": self.verdict,
            "summary": self.summary,
            "takes": [
                {
                    "repeat": take.repeat,
                    "level": take.level if np.isfinite(take.level) else None,
                    "relative_gain": float(gain),
                    "relative_phase_deg": float(turn),
                }
                for take, gain, turn in zip(self.takes, self.gain, self.phase_deg, strict=True)
            ],
            "tests": [
                {"name": t.name, "p_value": t.p_value, "size": t.size, "found": t in self.found}
                for t in self.tests
            ],
            "sd_factor": self.sd_factor if np.isfinite(self.sd_factor) else None,
            "noise_from_repeats": self.noise_from_repeats,
            "pooled": self.were_pooled,
            "frequency_shift": [float(s) if np.isfinite(s) else None for s in self.shift],
            "frequency_shift_share": self.shift_share,
            "lines": self.lines,
            "channels": self.channels,
        }


_CODES = {
    "gain_trend": "repeat_drift",
    "phase_trend": "repeat_drift",
    "gain_outlier": "repeat_outlier",
    "gain_level": "level_gain",
    "shape_trend": "repeat_creep",
    "shape_level": "level_nonlinear",
    "shape_outlier": "repeat_outlier",
    "shape_scatter": "repeat_scatter",
}
_ADVICE = {
    "repeat_drift": "Responses per reference do not contain it.",
    "repeat_creep": "The specimen changes in time (drying, a shifting resonance): use the first repeats.",
    "repeat_outlier": "Look at that repeat, and leave it out if there is a reason.",
    "repeat_scatter": "The pooled standard deviations were widened accordingly.",
    "level_nonlinear": "A linear model holds for one level only: fit the levels apart.",
    "level_gain": "Check the level column (decibels belong into level_db) and the exciter.",
}


def code_of(test: RepeatTest) -> str:
    """Return the stable code of a finding."""
    return _CODES[test.name]


def compare(
    run: str, takes: Sequence[Take], shapes: Shapes, stated: bool, alarm: float = ALARM
) -> RunRepeats:
    """Test the takes of one run.

    Parameters
    ----------
    takes : sequence of Take, (take,)
    shapes : Shapes
        Of the same takes.
    stated : bool
        The noise scale is the standard deviation itself.
    alarm : float
        Probability of any alarm when takes differ by their noise and by random gains only.

    Notes
    -----
    Gains: regression of log amplitude and phase of the takes on time (and log level), t tests, and
    externally studentised residuals for outliers (Cook and Weisberg 1982), so that amplitudes that scatter
    from repeat to repeat are no alarm. Shapes: what the takes leave beside one common shape is split into
    orthogonal contrasts over the takes (trend, level, one take against the others); each is compared with the
    remaining contrasts by an F test, or with the stated noise by chi2 where none remain. Degrees of freedom
    after Satterthwaite 1946 (doi:10.2307/3002019) for unequal noise, reduced for noise that is
    correlated between neighbouring lines (windowed spectra). The level of single tests follows Sidak 1967.
    """
    time, level = regressors(takes)
    tests = [*gain_tests(shapes, time, level), *shape_tests(shapes, time, level, stated)]
    single = 1.0 - (1.0 - alarm) ** (1.0 / max(len(tests), 1))
    repeat_tests = _verdict([test for test in tests if test.p_value < single])
    scatter = scatter_test(shapes, stated)
    factor = scatter.size if scatter else float("nan")
    if scatter is not None:
        tests.append(scatter)
        shape_found = any(test.name in SHAPE for test in repeat_tests)
        if scatter.p_value < _CERTAIN and factor > _NOTABLE_SCATTER and not shape_found:
            repeat_tests.append(scatter)
    spread = shapes.log_gain - (0.0 if level is None else level - level.mean())
    count = len(takes)
    return RunRepeats(
        run,
        tuple(takes),
        np.exp(spread),
        np.degrees(shapes.phase),
        tuple(tests),
        tuple(repeat_tests),
        int(np.sum(shapes.clear)),
        int(np.max(shapes.counts, initial=0)),
        factor,
        float(np.std(spread, ddof=1) / np.sqrt(count)),
        float(np.std(shapes.phase, ddof=1) / np.sqrt(count)),
    )


def _verdict(alarms: list[RepeatTest]) -> list[RepeatTest]:
    """Keep the finding on shapes that explains most, and one on gains that is no trace of it."""
    shapes = sorted((test for test in alarms if test.name in SHAPE), key=lambda test: -test.share)[:1]
    least = shapes[0].size if shapes else 0.0
    gains = [test for test in alarms if test.name not in SHAPE and abs(test.size) > least]
    return sorted(gains, key=lambda test: test.p_value)[:1] + shapes


def _count(takes: Sequence[Take]) -> str:
    levels = len({take.level for take in takes if np.isfinite(take.level)})
    repeats = len({take.repeat for take in takes})
    words = []
    if repeats > 1:
        words.append(f"{repeats} repeats")
    if levels > 1:
        words.append(f"{levels} levels")
    return " at ".join(words) if words else f"{len(takes)} takes"

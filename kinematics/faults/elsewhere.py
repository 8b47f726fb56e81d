"""What else explains a misfit that no single fault does: single values, lines, or errors of many places.

Shapes: c channels, N lines of all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.scores import Noise, one_pattern
from kinematics.fit.reference import format_stretches
from kinematics.joint.estimate import State, inverse, system
from kinematics.joint.expected import Layout
from kinematics.joint.pack import Readings
from kinematics.joint.tangents import GAIN, PHASE, SHIFT, Parameters
from stapeskit.arrays import Array

_FAR = 14.0  # squares over their typical size: 1e-3 of values by chance (exp(-14 / 2)), 30 sd^2 of parts
_MOST_FAR = 0.1  # share of values up to which they are single ones
_LOUD_LINE = 5.0  # median square of a line over that of most
_MOST_LOUD = 0.2  # share of lines up to which they are some
_ONE_CHANNEL = 0.4  # share of a line's squares in one channel: a value far off, not a loud line
_LONGEST = 3  # lines of a stretch, in the mean: a body that bends does so over a band
_MAINS_HZ, _NEAR_MAINS_HZ = (50.0, 60.0), 0.5
_LEAST_GAIN = 10.0  # log likelihood that a scatter must gain: odds of 20 000
_IN_ORDER = 0.8  # rank correlation with the order of the file
_SIZES = np.geomspace(1e-4, 0.5, 60)


@dataclass(frozen=True)
class Cause:
    """A cause that many channels share: stable code of the warning, and what was found, in words."""

    code: str
    text: str
    step: str


def other_causes(readings: Readings, state: State, noise: Noise, layout: Layout) -> list[Cause]:
    """Look for outliers, loud lines, and random errors of gains or positions.

    Parameters
    ----------
    readings : Readings
    state : State
        The motion with the expected errors.
    noise : Noise
    layout : Layout
    """
    found = _scatter(state, noise, layout)
    if found or one_pattern(state, noise):
        return found
    return _single_values(readings, state)


def _residual_squares(readings: Readings, state: State) -> Array:
    """Return squares of residuals of all values over their noise and 1 - leverage, (c, N); NaN if unused."""
    rows = state.rows @ state.packed.visible
    live = np.isfinite(readings.noise_factor)
    sd = readings.sd * np.where(live, readings.noise_factor, np.nan)[:, None]
    used = np.isfinite(readings.value) & np.isfinite(sd)
    root = np.where(used, 1.0 / np.where(used, sd, 1.0), 0.0)
    weight = np.median(root, axis=1)
    q, _ = np.linalg.qr(weight[:, None] * rows)
    y = np.where(used, readings.value / readings.geometry.factor.T, 0.0) * weight[:, None]
    full = used.sum(axis=0) >= used.sum(axis=0).max()
    e = y - q @ (q.T @ y)
    own = np.maximum(1.0 - np.sum(q**2, axis=1), 0.05)
    squares = np.abs(e * np.where(weight > 0.0, 1.0, 0.0)[:, None]) ** 2 / own[:, None]
    ratio = root / np.where(weight > 0.0, weight, 1.0)[:, None]
    return np.where(used & full, squares * ratio**2, np.nan)


def _single_values(readings: Readings, state: State) -> list[Cause]:
    """Look for few values far off, or for lines that are louder than the others."""
    squares = _residual_squares(readings, state)
    known = squares[np.isfinite(squares)]
    if known.size < 50:
        return []
    typical = float(np.median(known)) / np.log(2.0)
    with np.errstate(invalid="ignore"):
        far = squares > _FAR * typical
    every = np.isfinite(squares).any(axis=0)
    lines = np.zeros(squares.shape[1])
    lines[every] = np.nanmedian(squares[:, every], axis=0) / np.log(2.0)
    loud = lines > _LOUD_LINE * float(np.median(lines[every]))
    stretches = np.count_nonzero(np.diff(np.concatenate([[0], loud.astype(int)])) == 1)
    isolated = bool(np.count_nonzero(loud) <= _LONGEST * stretches)
    largest = np.nanmax(squares[:, loud], axis=0, initial=0.0) if loud.any() else np.zeros(1)
    spread = np.nansum(squares[:, loud], axis=0) if loud.any() else np.ones(1)
    isolated = bool(isolated and np.median(largest / spread) < _ONE_CHANNEL)
    if 1 < np.count_nonzero(loud) < _MOST_LOUD * len(loud) and isolated:
        return [_loud_lines(readings, loud)]
    count = int(np.count_nonzero(far))
    if 3 + 1e-3 * known.size < count < _MOST_FAR * known.size:
        worst = np.bincount(np.nonzero(far)[0], minlength=len(far)).argmax()
        text = f"{count} of {known.size} values lie far off the rigid motion, most in channel {{{worst}}}"
        return [
            Cause("sparse_outliers", text, "Fit with --robust huber, or look for drop-outs of the signal")
        ]
    return []


def _loud_lines(readings: Readings, loud: NDArray[np.bool_]) -> Cause:
    """Describe lines that all channels read louder, and whether they are multiples of mains."""
    freq = np.unique(readings.freq_hz[loud])
    every = np.unique(readings.freq_hz)
    where = format_stretches(every, np.isin(every, freq))
    for mains in _MAINS_HZ:
        off = np.abs(freq - mains * np.round(freq / mains))
        if np.all(off < _NEAR_MAINS_HZ):
            step = f"Leave them out, or average longer between multiples of {mains:.0f} Hz"
            text = f"lines at multiples of {mains:.0f} Hz do not fit a rigid motion: {where}"
            return Cause("mains_lines", text, step)
    return Cause("loud_lines", f"{len(freq)} lines do not fit a rigid motion: {where}", "Leave them out")


def _scatter(state: State, noise: Noise, layout: Layout) -> list[Cause]:
    """Look for random errors of one kind at all channels or points."""
    live = state.packed.live.tolist()
    points = list(layout.by_point(live).values())
    whole = max(state.energy / noise.level - state.freedom, 1e-9)
    trials = {
        "factors of points": (points, (GAIN, PHASE), "%", 100.0),
        "gains of channels": ([[channel] for channel in live], (GAIN,), "%", 100.0),
        "positions": (points, SHIFT, "mm", 1e3),
    }
    best: tuple[float, Cause] | None = None
    for name, (places, tangents, unit, factor) in trials.items():
        sd, gain, sizes = random_errors(state, places, tangents, noise)
        if gain < max(_LEAST_GAIN, 0.25 * whole) or (best and gain < best[0]):
            continue
        text = f"the {name} differ by {factor * sd:.2g} {unit} (standard deviation)"
        code, step = "gains_scattered", "Calibrate the channels, or state larger errors of gains"
        if name == "positions":
            code, step = (
                "positions_scattered",
                "State them as sd_mm in points.csv, or measure the points again",
            )
        order = np.argsort(np.argsort(sizes[:: len(tangents)]))
        if len(points) > 5 and abs(np.corrcoef(order, np.arange(len(order)))[0, 1]) > _IN_ORDER:
            code, text = "drift_between_points", f"{text}, growing in the order of the file"
            step = (
                "The sample or the excitation changed during the scan: repeat it, or use a reference channel"
            )
        best = (gain, Cause(code, text, step))
    return [best[1]] if best else []


def random_errors(
    state: State, places: Sequence[Sequence[int]], tangents: Sequence[int], noise: Noise
) -> tuple[float, float, Array]:
    """Estimate random errors of one kind at all places.

    Returns
    -------
    float
        Their likeliest standard deviation (of lengths in m).
    float
        Log likelihood gained by it.
    ndarray, (places * tangents,)
        Each error.

    Notes
    -----
    Random effects: with score b and information N of all errors, the log likelihood of their variance s is
    1/2 b^T (N + 1/s)^-1 b - 1/2 log det(1 + s N) (Searle, Casella and McCulloch 1992, Variance Components).
    """
    channels = len(state.geometry.positions_m)
    entries = [(list(own), tangent, 1.0) for own in places for tangent in tangents]
    score, information, _ = system(state, Parameters.of(channels, entries))
    score, information = score / noise.level, information / noise.level
    value, vector = np.linalg.eigh(information)
    value = np.maximum(value, 0.0)
    along = (vector.T @ score) ** 2
    scale = float(state.packed.scale[3]) if tangents[0] in SHIFT else 1.0
    variance = (scale * _SIZES[:, None]) ** 2
    gain = np.sum(
        0.5 * along * variance / (1.0 + variance * value) - 0.5 * np.log1p(variance * value), axis=1
    )
    best = int(np.argmax(gain))
    sd = scale * float(_SIZES[best])
    return sd, float(gain[best]), inverse(information + np.eye(len(score)) / sd**2) @ score

"""Other explanations of a misfit than one fault: single values, lines, or errors at many places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kinematics.faults.checks import LEAST_VALUES
from kinematics.faults.rounds import Round
from kinematics.faults.scores import pattern_gain
from kinematics.faults.unstated_noise import line_residuals
from kinematics.fit.reference import format_stretches
from kinematics.joint.estimate import inverse, system
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
    """A cause that many channels share: code of the warning, what was found, and where most of it is."""

    code: str
    text: str
    step: str
    channel: int | None = None


def other_causes(now: Round) -> list[Cause]:
    """Look for random errors of gains or positions, then for loud lines, then for single values far off."""
    bending = pattern_gain(now.state, now.noise.level)
    found = _scatter(now, max(_LEAST_GAIN, bending))
    if found or bending > 0.25 * now.state.energy / now.noise.level:  # half of the squares
        return found
    lines = line_residuals(now.readings, now.state)
    squares = np.abs(lines.scaled) ** 2 / np.maximum(lines.own, 0.05)[:, None]
    if np.count_nonzero(np.isfinite(squares)) < LEAST_VALUES:
        return []
    return _loud_lines(now.readings.freq_hz, squares) or _single_values(squares)


def _loud_lines(freq_hz: Array, squares: Array) -> list[Cause]:
    """Look for few lines, apart from each other, that all channels read louder; tell multiples of mains."""
    some = np.flatnonzero(np.isfinite(squares).any(axis=0))
    middle = np.nanmedian(squares[:, some], axis=0)
    loud = np.zeros(squares.shape[1], dtype=bool)
    loud[some] = middle > _LOUD_LINE * np.median(middle)
    stretches = np.count_nonzero(np.diff(loud.astype(int), prepend=0) == 1)
    count = int(np.count_nonzero(loud))
    if not 1 < count < min(_MOST_LOUD * len(loud), _LONGEST * int(stretches) + 1):
        return []
    part = squares[:, loud]
    if np.median(np.nanmax(part, axis=0) / np.nansum(part, axis=0)) >= _ONE_CHANNEL:
        return []
    freq, every = np.unique(freq_hz[loud]), np.unique(freq_hz)
    text, step = f"{len(freq)} lines do not fit a rigid motion", "Leave them out"
    for mains in _MAINS_HZ:
        if np.all(np.abs(freq - mains * np.round(freq / mains)) < _NEAR_MAINS_HZ):
            text = f"{len(freq)} lines at multiples of {mains:.0f} Hz do not fit a rigid motion"
            step = f"Leave them out, or average longer between multiples of {mains:.0f} Hz"
    return [Cause("outliers", f"{text}: {format_stretches(every, np.isin(every, freq))}", step)]


def _single_values(squares: Array) -> list[Cause]:
    """Look for few values far off."""
    number = np.count_nonzero(np.isfinite(squares))
    far = np.nan_to_num(squares) > _FAR * float(np.nanmedian(squares)) / np.log(2.0)
    count = np.count_nonzero(far)
    if not 3 + 1e-3 * number < count < _MOST_FAR * number:
        return []
    text = f"{count} of {number} values lie far off the rigid motion"
    step = "Fit with --robust huber, or look for drop-outs of the signal"
    return [Cause("outliers", text, step, int(np.argmax(far.sum(axis=1))))]


def _scatter(now: Round, least: float) -> list[Cause]:
    """Look for random errors of one kind at all channels or points that gain most log likelihood."""
    points = list(now.layout.by_point(now.live).values())
    gains = ("%", 100.0, "Calibrate the channels, or state larger errors of gains")
    places = ("mm", 1e3, "State them as sd_mm in points.csv, or measure the points again")
    found = []
    for name, own, tangents, (unit, factor, step) in (
        ("factors of points", points, (GAIN, PHASE), gains),
        ("gains of channels", [[channel] for channel in now.live], (GAIN,), gains),
        ("positions", points, SHIFT, places),
    ):
        sd, gain, sizes = random_errors(now, own, tangents)
        if gain < least:
            continue
        code, text = (
            "channels_scattered",
            f"the {name} differ by {factor * sd:.2g} {unit} (standard deviation)",
        )
        order = np.argsort(np.argsort(sizes[:: len(tangents)]))
        if len(points) > 5 and abs(np.corrcoef(order, np.arange(len(order)))[0, 1]) > _IN_ORDER:
            code, text = "drift_between_points", f"{text}, growing in the order of the file"
            step = "The sample or the excitation changed during the scan: repeat it, or use a reference"
        least, found = gain, [Cause(code, text, step)]
    return found


def random_errors(
    now: Round, places: Sequence[Sequence[int]], tangents: Sequence[int]
) -> tuple[float, float, Array]:
    """Estimate random errors of one kind at all places, the expected errors left free.

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
    entries = [(list(own), tangent, 1.0) for own in places for tangent in tangents]
    random = Parameters.of(len(now.layout.points), entries)
    score, whole, _ = system(now.state, random + now.expected)
    count = len(random)
    information = whole[:count, :count]
    if len(now.expected):
        known = inverse(whole[count:, count:] + np.diag(now.expected.prior))
        information = information - whole[:count, count:] @ known @ whole[count:, :count]
    score, information = score[:count] / now.noise.level, information / now.noise.level
    value, vector = np.linalg.eigh(information)
    value = np.maximum(value, 0.0)
    along = (vector.T @ score) ** 2
    sizes = _SIZES * (float(now.packed.scale[3]) if tangents[0] in SHIFT else 1.0)
    grown = sizes[:, None] ** 2 * value
    gain = 0.5 * np.sum(along * sizes[:, None] ** 2 / (1.0 + grown) - np.log1p(grown), axis=1)
    best = int(np.argmax(gain))
    errors = inverse(information + np.eye(len(score)) / sizes[best] ** 2) @ score
    return float(sizes[best]), float(gain[best]), errors

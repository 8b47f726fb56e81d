"""Other explanations of a misfit than one fault: single values, lines, or errors at many places.

Each states how much log likelihood it gains, less half the logarithm of the number of values for every number
that it takes from the data (Schwarz 1978, doi:10.1214/aos/1176344136); the likeliest is believed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.rounds import Round, null_fit
from kinematics.faults.scores import pattern_gain
from kinematics.faults.unstated_noise import line_residuals
from kinematics.fit.noise import FAR
from kinematics.fit.reference import format_stretches
from kinematics.joint.estimate import State, inverse, system
from kinematics.joint.tangents import GAIN, PHASE, SHIFT, Parameters
from stapeskit.arrays import Array

_MOST_FAR = 0.1  # share of values up to which they are single ones
_BY_CHANCE, _CHANCE = 3, 1e-3  # residuals of few channels are not normal: so many are far off by chance
_MOST_LOUD, _IN_LINES = 0.2, 0.8  # share of lines up to which they are few; share of values far off in them
_LEAST_VALUES = 50  # fewer say too little of a distribution
_MAINS_HZ, _NEAR_MAINS_HZ = (50.0, 60.0), 0.5
_LEAST_GAIN = 10.0  # log likelihood that a cause must gain: odds of 20 000
_IN_ORDER = 0.8  # rank correlation with the order of the file
_SIZES = np.geomspace(1e-4, 0.5, 60)


@dataclass(frozen=True)
class Cause:
    """A cause that many channels share.

    Attributes
    ----------
    gain : float
        Log likelihood.
    code, text, step : str
        Of the warning: its code, what was found, and what to do.
    channel : int or None
        Where most of it is.
    last : Round or None
        Without the values that are far off.
    """

    gain: float
    code: str
    text: str
    step: str
    channel: int | None = None
    last: Round | None = None


def other_causes(now: Round) -> list[Cause]:
    """Return the likeliest cause that many channels share; none where a body that bends is likelier."""
    found = [*_scatter(now), *_far_values(now)]
    best = max(found, key=lambda cause: cause.gain, default=None)
    least = max(_LEAST_GAIN, pattern_gain(now.state, now.noise.level))
    return [] if best is None or best.gain < least else [best]


def _far_values(now: Round) -> Iterator[Cause]:
    """Look for values far off, single ones or those of few lines, without which nothing is wrong."""
    squares = line_residuals(now.readings, State(now.packed)).squares
    known, far = int(np.count_nonzero(np.isfinite(squares))), squares > FAR
    squares, count = np.nan_to_num(squares), int(np.count_nonzero(far))
    if known < _LEAST_VALUES or not _BY_CHANCE + _CHANCE * known < count < _MOST_FAR * known:
        return
    loud = np.count_nonzero(far, axis=0) > 1
    some = 1 < np.count_nonzero(loud) < _MOST_LOUD * len(loud)
    some &= np.count_nonzero(far[:, loud]) > _IN_LINES * count
    value = np.where(far | (loud & some), np.nan, now.readings.value)
    last = null_fit(replace(now.readings, value=value), now.layout)
    if not last.clean():
        return
    text = f"{count} of {known} values lie far off the rigid motion"
    step = "Fit with --robust huber, or look for drop-outs of the signal"
    channel: int | None = int(np.argmax(far.sum(axis=1)))
    if some:
        text, step, channel = *_lines_in_words(now.readings.freq_hz, loud), None
    gain = float(np.sum(squares[far] - 1.0) - count * np.log(known))
    yield Cause(gain, "outliers", text, step, channel, last)


def _lines_in_words(freq_hz: Array, loud: NDArray[np.bool_]) -> tuple[str, str]:
    """Name loud lines, multiples of mains as such, and what to do about them."""
    freq, every = np.unique(freq_hz[loud]), np.unique(freq_hz)
    text, step = f"{len(freq)} lines do not fit a rigid motion", "Leave them out"
    for mains in _MAINS_HZ:
        if np.all(np.abs(freq - mains * np.round(freq / mains)) < _NEAR_MAINS_HZ):
            text = f"{len(freq)} lines at multiples of {mains:.0f} Hz do not fit a rigid motion"
            step = f"Leave them out, or average longer between multiples of {mains:.0f} Hz"
    return f"{text}: {format_stretches(every, np.isin(every, freq))}", step


def _scatter(now: Round) -> Iterator[Cause]:
    """Look for random errors of one kind at all channels or points."""
    points = list(now.layout.by_point(now.live).values())
    gains = ("%", 100.0, "Calibrate the channels, or state larger errors of gains")
    places = ("mm", 1e3, "Compare rows and points (a row too many, exchanged names), or state larger sd_mm")
    for name, own, tangents, (unit, factor, step) in (
        ("factors of points", points, (GAIN, PHASE), gains),
        ("gains of channels", [[channel] for channel in now.live], (GAIN,), gains),
        ("positions", points, SHIFT, places),
    ):
        sd, gain, sizes = random_errors(now, own, tangents)
        text = f"the {name} differ by {factor * sd:.2g} {unit} (standard deviation)"
        order = np.argsort(np.argsort(sizes[:: len(tangents)]))
        if len(points) > 5 and abs(np.corrcoef(order, np.arange(len(order)))[0, 1]) > _IN_ORDER:
            text = f"{text}, growing in the order of the file"
            step = "The sample or the excitation changed during the scan: repeat it, or use a reference"
        yield Cause(gain, "channels_scattered", text, step)


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

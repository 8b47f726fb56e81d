"""Other orders of the lines of a body: sorted as text, "1000, 10000, 200", or two of them exchanged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from legacy.kinematics.faults.proposals.two_bodies import Order
from legacy.stapeskit.arrays import Array, ComplexArray

# How many of the roughest lines are exchanged with each other in trial.
_MOST = 8
# Lines to either side whose median is the usual comparison.
_AROUND = 7
# A jump, in units of its expected square, and what an exchange may leave of it.
_ROUGH, _SETTLES = 30.0, 0.05
# The cubic through the four neighbours of a line, at the line (Lagrange).
_BESIDE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0
# From where the readings of each line are to be taken, and what the sentence says of it.
Ordered = tuple[Order, Mapping[str, object]]


def sorted_as_text(freq_hz: Array) -> Iterator[Ordered]:
    """Yield the order of text, and its inverse.

    Either the column of frequencies was sorted as text, beside values in the order of numbers, or the values
    were (files by their names) beside a column in the order of numbers.
    """
    words = [f"{value:.12g}" for value in freq_hz]
    order = np.array(sorted(range(len(words)), key=words.__getitem__), dtype=np.intp)
    if np.array_equal(order, np.arange(len(words))):
        return
    first = ", ".join(sorted(words)[:3])
    yield order, {"what": "the column freq_hz", "words": first}
    back = np.argsort(order)
    if not np.array_equal(back, order):
        yield back, {"what": "the values", "words": first}


def two_exchanged(course: tuple[ComplexArray, Array, Array]) -> Iterator[Ordered]:
    """Yield the exchange of two lines that makes readings (freq, m) smooth, of their sd and frequencies.

    Notes
    -----
    Each line is compared with the cubic through its four neighbours, in units of its noise and of what this
    comparison gives at the lines around it.
    """
    readings, sd, freq_hz = course
    count = len(readings)
    if count < 16 or not np.all(np.isfinite(readings)) or not np.all(np.isfinite(sd)):
        return
    rough = _roughness(readings)
    noise = 2.0 * sd**2 * (1.0 + float(np.sum(_BESIDE**2)))
    beyond = np.pad(rough, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(beyond, 2 * _AROUND + 1, axis=0), axis=-1)
    scale = np.maximum(noise + 2.0 * usual, 1e-300)
    size = np.mean(rough / scale, axis=1)
    roughest = np.argsort(-size, kind="stable")[:_MOST]
    roughest = roughest[size[roughest] > _ROUGH]
    if not roughest.size:
        return
    least, pair = _SETTLES, list[int]()
    for k, m in combinations(np.unique([*roughest.tolist(), 0, 1, count - 2, count - 1]).tolist(), 2):
        near = np.unique(np.clip([n + j for n in (k, m) for j in range(-2, 3)], 0, count - 1))
        before = np.mean(size[near])
        if max(size[k], size[m]) < _ROUGH or before < _ROUGH:
            continue
        exchanged = readings.copy()
        exchanged[[k, m]] = readings[[m, k]]
        after = np.mean(_roughness(exchanged)[near] / scale[near])
        if after < min(least * before, _ROUGH):
            least, pair = after / before, [k, m]
    if pair:
        lines = np.arange(count)
        lines[pair] = pair[::-1]
        yield lines, {"first": freq_hz[pair[0]], "second": freq_hz[pair[1]]}


def _roughness(readings: ComplexArray) -> Array:
    """Return |line - cubic of its neighbours|^2, (freq, m); zero at the ends."""
    roughness = np.zeros(readings.shape)
    between = sum(_BESIDE[j] * readings[j : len(readings) - 4 + j] for j in range(5))
    roughness[2:-2] = np.abs(readings[2:-2] - between) ** 2
    return roughness

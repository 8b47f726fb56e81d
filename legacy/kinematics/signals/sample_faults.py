"""Faults of samples: clipping, single spikes, constant stretches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Shorter records are not looked at.
_LEAST = 64
# Clipping: width of the outermost stretch as a share of the range, stretches that are compared, by how much
# more must lie in the outermost (a sine: 3), and how many samples and neighbouring pairs of them at least.
_TOP, _BINS, _CROWDED, _FEWEST, _PAIRS = 0.002, 6, 8.0, 8, 3
# Spikes: samples of a stretch whose median is the usual difference, and how many times that stands out.
_BLOCK, _SPIKE = 256, 20.0
# Pauses: equal samples in a row, samples beside them that must move, by how many of the smallest steps.
_STILL, _BESIDE, _MOVING = 8, 16, 20.0


def sample_notices(channels: Mapping[str, Iterable[Array]], leads: Iterable[str], file: str) -> list[Notice]:
    """Warn of channels with clipped, spiky or constant samples.

    Parameters
    ----------
    channels : mapping of str to iterable of ndarray (sample,)
        Records of every channel.
    leads : iterable of str
        References. Pauses are not looked for in them, and spikes nowhere when they are pulses.
    """
    clipped, spikes, still = [], {}, {}
    apart = set(leads)
    records = {name: list(rows) for name, rows in channels.items()}
    pulses = any(count_spikes(row) for name in apart for row in records.get(name, []) if len(row) >= _LEAST)
    resting = [row for name in apart for row in records.get(name, [])]
    for name, rows in records.items():
        good = [row for row in rows if len(row) >= _LEAST and np.all(np.isfinite(row)) and np.ptp(row) > 0.0]
        if any(is_clipped(row) for row in good):
            clipped.append(name)
        if name in apart:
            continue
        spikes[name] = 0 if pulses else sum(count_spikes(row) for row in good)
        still[name] = sum(count_still(row, still_samples(resting, k)) for k, row in enumerate(good))
    notices = []
    if clipped:
        text = (
            f"{', '.join(clipped)} of {file}: clipped; samples crowd at the largest or smallest value. The "
            "responses are too small and distorted there: lower the level or take a wider range."
        )
        notices.append(Notice("clipped", text))
    if any(spikes.values()):
        text = (
            f"isolated spikes rise far above the signal ({_counts(spikes, file)}), as when the laser loses "
            "its light: they are noise in the responses and counted as such. A tracking filter or a better "
            "spot removes them."
        )
        notices.append(Notice("spikes", text))
    if any(still.values()):
        text = (
            f"the signal is constant for {_STILL} samples or more in the midst of motion "
            f"({_counts(still, file)}), as when a decoder holds its last value: such responses are too "
            "small. Measure these points again."
        )
        notices.append(Notice("dropouts", text))
    return notices


def _counts(counts: Mapping[str, int], file: str) -> str:
    return f"{', '.join(f'{name}: {n}' for name, n in counts.items() if n)}; {file}"


def is_clipped(row: Array) -> bool:
    """Return whether samples (n,) crowd in the outermost 0.2 % of their range, against the part below it.

    Towards its extremes noise thins out, and a sine, the most crowded of smooth signals, has three times as
    many samples in the outermost stretch as in the mean of the next five. A pulse rests at one extreme: a
    crowd that holds the median is none. A signal that repeats itself reaches its largest value once a period:
    neighbours must be in the crowd, too.
    """
    low, high, middle = float(np.min(row)), float(np.max(row)), float(np.median(row))
    step = _TOP * (high - low)
    for apart, rest in ((high - row, high - middle), (row - low, middle - low)):
        near = apart[apart < _BINS * step]
        top = int(np.count_nonzero(near < step))
        below = (len(near) - top) / (_BINS - 1)
        if rest > step and top >= _FEWEST and top > _CROWDED * max(below, 1.0):
            crowd = apart < step
            if np.count_nonzero(crowd[1:] & crowd[:-1]) >= _PAIRS:
                return True
    return False


def count_spikes(row: Array) -> int:
    """Count lone samples of (n,), or two or three together, that stand out of their surroundings by 20 times.

    Out of the differences to the mean of the samples four before and after, in units of their median in the
    loudest of three neighbouring stretches, so that a burst that sets in is none; a spike stands out
    from both, which the jump from one step of a stepped sine to the next does not.
    """
    reach = 4
    before, after = row[reach:-reach] - row[: -2 * reach], row[reach:-reach] - row[2 * reach :]
    differences = before + after
    np.abs(differences, out=differences)
    differences *= 0.5
    opposite = ~(before * after > 0.0)
    # in place: a record of an hour is as large as the memory of a small machine
    beyond = np.minimum(np.abs(before, out=before), np.abs(after, out=after), out=before)
    beyond[opposite] = 0.0
    del after, opposite
    count = max(1, len(differences) // _BLOCK)
    edges = np.linspace(0, len(differences), count + 1).astype(int)
    level = np.array([np.median(differences[a:b]) for a, b in pairwise(edges)])
    padded = np.pad(level, 1, mode="edge")
    loud = np.maximum(np.maximum(padded[:-2], padded[2:]), level)
    limit = _SPIKE * np.maximum(loud, max(1e-3 * np.max(level), 1e-4 * np.std(row)))
    out = np.flatnonzero(beyond > np.repeat(limit, np.diff(edges)))
    if not len(out):
        return 0
    tops = [
        part[np.argmax(differences[part])]
        for part in np.split(out, np.flatnonzero(np.diff(out) > 2 * reach) + 1)
    ]
    lone = 0
    for top in tops:
        start, stop = max(0, top - 12), min(len(differences), top + 13)
        beside = differences[start:stop][np.abs(np.arange(start, stop) - top) > 5]
        lone += bool(len(beside) and np.median(beside) < 0.2 * differences[top])
    return lone


def still_samples(leads: list[Array], record: int) -> NDArray[np.bool_] | None:
    """Return where the reference of a record is constant, (sample - 1,); None without one."""
    if not leads:
        return None
    return np.asarray(np.diff(leads[record if record < len(leads) else 0]) == 0.0)


def count_still(row: Array, resting: NDArray[np.bool_] | None = None) -> int:
    """Count stretches of eight equal samples or more with motion right before and after them.

    Parameters
    ----------
    row : ndarray, (sample,)
    resting : ndarray, (sample - 1,), bool, optional
        Where the reference is constant: a pause of both is no fault of the channel.
    """
    steps = np.diff(row)
    moving = np.abs(steps[steps != 0.0])
    if not len(moving):
        return 0
    fine = float(np.min(moving))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (steps == 0.0).astype(np.int8), [0]])))
    starts, stops = edges[::2], edges[1::2]
    extremes = (float(np.min(row)), float(np.max(row)))
    count = 0
    for start, stop in zip(starts, stops, strict=True):
        if stop - start + 1 < _STILL or row[start] in extremes:
            continue
        if resting is not None and len(resting) == len(steps) and np.mean(resting[start:stop]) > 0.5:
            continue
        before, after = row[max(0, start - _BESIDE) : start], row[stop + 1 : stop + 1 + _BESIDE]
        if len(before) == len(after) == _BESIDE:
            beside = min(float(np.std(before)), float(np.std(after)))
            count += beside > max(_MOVING * fine, 0.05 * float(np.std(row)))
    return count

"""Faults of samples: clipping and constant stretches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_STILL = 8  # equal samples in a row in the midst of motion: a decoder that holds its last value
_BESIDE = 16  # samples before and behind such a stretch that must move
_CLIPPED_WORDS = (
    "neighbouring samples lie at the largest or smallest value again and again. The responses are too small "
    "there: lower the level or take a wider range"
)
_STILL_WORDS = (
    f"constant for {_STILL} samples or more in the midst of motion, as when a decoder holds its last value. "
    "Such responses are too small: measure these points again"
)
_CLIPPED = 3  # neighbouring samples at the extreme: a smooth signal touches it once


def sample_notices(channels: Mapping[str, Iterable[Array]], file: str) -> list[Notice]:
    """Warn of channels with clipped or constant samples.

    Parameters
    ----------
    channels : mapping of str to iterable of ndarray (sample,)
        Records of every channel.
    """
    found: dict[str, list[str]] = {_CLIPPED_WORDS: [], _STILL_WORDS: []}
    for name, rows in channels.items():
        moving = [row for row in rows if len(row) >= 4 * _STILL and np.ptp(row) > 0.0]
        if any(is_clipped(row) for row in moving):
            found[_CLIPPED_WORDS].append(name)
        elif any(is_still(row) for row in moving):
            found[_STILL_WORDS].append(name)
    return [
        Notice("samples_stuck", f"{', '.join(names)} of {file}: {text}.")
        for text, names in found.items()
        if names
    ]


def is_clipped(row: Array) -> bool:
    """Return whether samples (n,) stay at an extreme in three stretches or more, and not at rest."""
    low, high, middle = float(np.min(row)), float(np.max(row)), float(np.median(row))
    return any(
        abs(middle - extreme) > 0.01 * (high - low)
        and sum(stop - start >= _CLIPPED for start, stop in _stretches(row == extreme)) >= _CLIPPED
        for extreme in (low, high)
    )


def is_still(row: Array) -> bool:
    """Return whether samples (n,) are equal for a while between samples that move."""
    least, extremes = 0.05 * float(np.std(row)), (np.min(row), np.max(row))
    for start, stop in _stretches(np.diff(row) == 0.0):
        before, after = row[max(0, start - _BESIDE) : start], row[stop + 1 : stop + 1 + _BESIDE]
        inside = len(before) == len(after) == _BESIDE and row[start] not in extremes
        if stop - start + 1 >= _STILL and inside and min(np.std(before), np.std(after)) > least:
            return True
    return False


def _stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and stop of the stretches of a mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))

"""Samples of time series that are clipped, or held while the others move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_CLIPPED = 3  # neighbouring samples at an extreme, and such stretches: a smooth signal touches it once
_HELD = 8  # equal samples in a row in the midst of motion: a decoder that holds its last value
_BESIDE = 16  # samples before and behind such a stretch that must move
_SHORTEST = 32  # samples of a record that is looked at


def sample_notices(channels: Mapping[str, Iterable[Array]], file: str) -> list[Notice]:
    """Warn of channels with clipped or held samples.

    Parameters
    ----------
    channels : mapping of str to iterable of ndarray (sample,)
        Records of every channel.
    """
    clipped = [name for name, rows in channels.items() if any(is_clipped(row) for row in rows)]
    held = [name for name, rows in channels.items() if any(is_held(row) for row in rows)]
    texts = {
        "neighbouring samples lie at the largest or smallest value again and again. The responses are too "
        "small there: lower the level or take a wider range": clipped,
        f"equal for {_HELD} samples or more in the midst of motion, as when a decoder holds its last value "
        "or its signal drops out. Such responses are too small: measure these points again": held,
    }
    return [
        Notice("samples_stuck", f"{', '.join(names)} of {file}: {text}.")
        for text, names in texts.items()
        if names
    ]


def is_clipped(row: Array) -> bool:
    """Return whether samples (n,) stay at an extreme in three stretches or more, and not at rest."""
    low, high, middle = float(np.min(row)), float(np.max(row)), float(np.median(row))
    for extreme in (low, high) if len(row) >= _SHORTEST else ():
        start, stop = _stretches(row == extreme)
        if abs(middle - extreme) > 0.01 * (high - low) and np.sum(stop - start >= _CLIPPED) >= _CLIPPED:
            return True
    return False


def is_held(row: Array) -> bool:
    """Return whether samples (n,) are equal for a while between samples that move, and not at an extreme."""
    least, extremes = 0.05 * float(np.std(row)), (np.min(row), np.max(row))
    starts, stops = _stretches(np.diff(row) == 0.0)
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        before, after = row[max(0, start - _BESIDE) : start], row[stop + 1 : stop + 1 + _BESIDE]
        inside = len(before) == len(after) == _BESIDE and row[start] not in extremes
        if inside and stop - start + 1 >= _HELD and min(np.std(before), np.std(after)) > least:
            return True
    return False


def _stretches(mask: NDArray[np.bool_]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the starts and stops of the stretches of a mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return edges[::2], edges[1::2]

"""The noise of all channels and lines, read piece by piece: as stated, scaled per line, with a floor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

Lines = slice | NDArray[np.intp]
# Values at a time: fits the second cache.
_BLOCK = 40_000
# Relative difference by which products of channel and line noise may round.
_SAME = 1e-12


def blocks(channels: int, lines: int, values: int = _BLOCK) -> Iterator[slice]:
    """Yield runs of lines with about ``values`` values each: 16 bytes of them stay in a processor's cache."""
    width = int(np.clip(values // max(channels, 1), 16, 4096)) & ~15
    for start in range(0, lines, width):
        yield slice(start, min(start + width, lines))


def part_of(values: NDArray[Any], lines: Lines, channels: slice | NDArray[np.bool_]) -> NDArray[Any]:
    """Return the part (channel, n) of values (channel, freq): views are taken before copies."""
    if isinstance(lines, slice):
        return values[:, lines][channels]
    return values[channels][:, lines]


@dataclass(frozen=True)
class LineNoise:
    """Standard deviations of the real (= imaginary) part, m.

    Attributes
    ----------
    stated : ndarray, (channel, freq)
        May be a broadcast view; NaN or infinite where a value is not to be used.
    factor : ndarray, (freq,), or None
        Multiplies ``stated``.
    floor : ndarray, (freq,), or None
        Least standard deviation at each line, m.
    """

    stated: Array
    factor: Array | None = None
    floor: Array | None = None

    def at(self, lines: Lines, channels: slice | NDArray[np.bool_] = slice(None)) -> Array:
        """Return the standard deviations (channel, n) of some lines."""
        sd = part_of(self.stated, lines, channels)
        if self.factor is not None:
            sd = sd * self.factor[lines]
        return sd if self.floor is None else np.maximum(sd, self.floor[lines])

    def common(self) -> tuple[Array, Array] | None:
        """Return a part per channel (channel,), at most 1, and one per line (freq,), m, that multiply to sd.

        None when the ratios of the channels change from line to line, or a value is not to be used.
        """
        return self._common

    @cached_property
    def _common(self) -> tuple[Array, Array] | None:
        channels, lines = self.stated.shape
        if channels == 0 or lines == 0:
            return None
        ones = np.ones(lines)
        if self.stated.strides[0] == 0 or channels == 1:
            line = self.at(slice(None), slice(0, 1))[0]
            return (np.ones(channels), line) if np.all(np.isfinite(line)) else None
        if self.stated.strides[1] == 0 or lines == 1:
            share, line = self.stated[:, 0], ones
        else:
            share, line = self.stated[:, 0], self.stated[0]
        if not (np.all(np.isfinite(share)) and np.min(share) > 0.0):
            return None
        if line is not ones:
            if not self._splits(share, line):
                return None
            line = line / share[0]
        line = line * np.max(share)
        if self.factor is not None:
            line = line * self.factor
        share = share / np.max(share)
        if not np.all(np.isfinite(line)):
            return None
        if self.floor is not None and np.any(np.min(share) * line < self.floor):
            return None
        return share, line

    def _splits(self, share: Array, line: Array) -> bool:
        channels, lines = self.stated.shape
        for part in blocks(channels, lines):
            expected = (share / share[0])[:, None] * line[part]
            with np.errstate(invalid="ignore"):
                if not np.all(np.abs(self.stated[:, part] - expected) <= _SAME * expected):
                    return False
        return True

"""Samples of time series that are clipped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_CLIPPED = 3  # neighbouring samples at an extreme, and such stretches: a smooth signal touches it once
_SHORTEST = 32  # samples of a record that is looked at


def sample_notices(channels: Mapping[str, Iterable[Array]], file: str) -> list[Notice]:
    """Warn of channels with clipped samples.

    Parameters
    ----------
    channels : mapping of str to iterable of ndarray (sample,)
        Records of every channel.
    """
    clipped = [name for name, rows in channels.items() if any(is_clipped(row) for row in rows)]
    if not clipped:
        return []
    text = (
        f"{', '.join(clipped)} of {file}: neighbouring samples lie at the largest or smallest value again "
        "and again. The responses are too small there: lower the level or take a wider range."
    )
    return [Notice("samples_stuck", text)]


def is_clipped(row: Array) -> bool:
    """Return whether samples (n,) stay at an extreme in three stretches or more, and not at rest."""
    low, high, middle = float(np.min(row)), float(np.max(row)), float(np.median(row))
    for extreme in (low, high) if len(row) >= _SHORTEST else ():
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row == extreme, [0]]).astype(int)))
        stretches = np.sum(edges[1::2] - edges[::2] >= _CLIPPED)
        if abs(middle - extreme) > 0.01 * (high - low) and stretches >= _CLIPPED:
            return True
    return False

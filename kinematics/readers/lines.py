"""Frequencies of rows that were written or measured apart, joined to one grid of lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

SAME_LINE = 1e-6
"""Relative difference of one frequency in two places: files have six digits."""

OF_SPACING = 0.01
"""Largest difference of lines that are joined, as a share of their spacing: 1 % of a line width."""

MOST = 1e-4
"""The same relative to the frequency: across a resonance with 10 % damping a response changes by 0.1 %."""

_LEAST_FILLED = 0.01  # a run for each of 100 lines fills 1 in 100; what fills less has columns exchanged
_ANY_PLACES = 4_000_000  # 64 MB of values, of which any share may be empty


def common_grid(grids: Sequence[Array]) -> tuple[Array, list[NDArray[np.intp]], list[Notice]]:
    """Join grids of frequencies, (l,) each, ascending, in Hz.

    Returns the frequencies (L,), of the first grid that has each line; which line each frequency of a grid
    is, (l,) each; and whether lines were joined that differ by more than rounding.
    """
    keys = [np.ascontiguousarray(grid, dtype=float).tobytes() for grid in grids]
    different = dict(zip(keys, grids, strict=True))
    freq = np.concatenate([*different.values()])
    order = np.argsort(freq, kind="stable")
    limit = np.concatenate([_joined_within(grid) for grid in different.values()])[order]
    new = np.diff(freq[order]) > np.minimum(limit[1:], limit[:-1])
    line = np.empty(len(freq), dtype=np.intp)
    line[order] = np.concatenate([[0], np.cumsum(new)])
    lines = freq[np.unique(line, return_index=True)[1]]
    ends = np.cumsum([len(grid) for grid in different.values()])[:-1]
    places = dict(zip(different, np.split(line, ends), strict=True))
    apart = np.abs(freq - lines[line])
    widest = float(np.max(apart[apart > SAME_LINE * freq], initial=0.0))
    text = (
        f"frequencies that differ by up to {widest:.2g} Hz between channels were taken as one line (within "
        "1 % of the line spacing and 1e-4 of the frequency)."
    )
    return lines, [places[key] for key in keys], [Notice("file_read", text)] if widest > 0.0 else []


def _joined_within(grid: Array) -> Array:
    """Return by how much the lines (l,) of a grid may differ from the same lines of another one, Hz."""
    steps = np.concatenate([[np.inf], np.diff(grid), [np.inf]])
    spacing = np.minimum(steps[:-1], steps[1:])
    return np.asarray(np.maximum(np.minimum(OF_SPACING * spacing, MOST * grid), SAME_LINE * grid))


def check_filled(rows: int, lines: int, readings: int, where: str = "") -> None:
    """Refuse readings that share so few runs and lines that arrays of all of them would be almost empty.

    Raises
    ------
    StapeskitError
    """
    if rows * lines > max(_ANY_PLACES, readings / _LEAST_FILLED):
        got = f"{readings} readings of {rows} channels and runs in {lines} lines"
        step = "Check which columns hold the frequency and the run: one has a new value in almost every row"
        raise StapeskitError.of("the readings", "at lines and in runs that channels share", got, where, step)

"""Frequencies of rows that were written or measured apart, joined to one grid of lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError
from stapeskit.warnings import Notice

Index = NDArray[np.intp]

SAME_LINE = 1e-6
"""Relative difference of one frequency in two places: files have six digits."""

OF_SPACING = 0.01
"""Largest difference of lines that are joined, as a share of their spacing: 1 % of a line width."""

MOST = 1e-4
"""The same relative to the frequency: across a resonance with 10 % damping a response changes by 0.1 %."""

_LEAST_FILLED = 0.01  # a run for each of 100 lines fills 1 in 100; what fills less has columns exchanged
_ANY_PLACES = 4_000_000  # 64 MB of values, of which any share may be empty


def common_grid(grids: Sequence[Array]) -> tuple[Array, list[Index], list[Notice]]:
    """Join grids of frequencies, (l,) each, ascending, in Hz.

    Returns the frequencies (L,), of the first grid that has each line; which line each frequency of a grid
    is, (l,) each; and whether lines were joined that differ by more than rounding.
    """
    keys = [np.ascontiguousarray(grid, dtype=float).tobytes() for grid in grids]
    different = dict(zip(keys, grids, strict=True))
    joined, widest = np.empty(0), 0.0
    for grid in different.values():
        _, apart, limit = _nearest(joined, grid)
        matched = apart <= limit
        widest = max(widest, float(np.max(apart[matched & (apart > SAME_LINE * grid)], initial=0.0)))
        joined = np.sort(np.concatenate([joined, grid[~matched]]))
    places = {key: _nearest(joined, grid)[0] for key, grid in different.items()}
    text = (
        f"frequencies that differ by up to {widest:.2g} Hz between channels were taken as one line (within "
        "1 % of the line spacing and 1e-4 of the frequency)."
    )
    return joined, [places[key] for key in keys], [Notice("file_read", text)] if widest > 0.0 else []


def _nearest(lines: Array, grid: Array) -> tuple[Index, Array, Array]:
    """Return the nearest of ascending lines to each frequency, how far it is, and how far it may be."""
    if not len(lines):
        return np.zeros(len(grid), dtype=np.intp), np.full(len(grid), np.inf), np.zeros(len(grid))
    above = np.clip(np.searchsorted(lines, grid), 0, len(lines) - 1)
    below = np.maximum(above - 1, 0)
    nearest = np.where(grid - lines[below] <= lines[above] - grid, below, above)
    spacing = np.minimum(_spacing(lines)[nearest], _spacing(grid))
    limit = np.maximum(np.minimum(OF_SPACING * spacing, MOST * grid), SAME_LINE * grid)
    return nearest, np.abs(lines[nearest] - grid), limit


def _spacing(lines: Array) -> Array:
    """Return the distance of each line from its nearest neighbour."""
    steps = np.concatenate([[np.inf], np.diff(lines), [np.inf]])
    return np.asarray(np.minimum(steps[:-1], steps[1:]))


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


def grid_faults(freq_hz: Array, present: Mapping[str, NDArray[np.bool_]]) -> list[Fault]:
    """List the bodies that share less than half of the lines that they could share with the first one.

    ``present`` says by body where it was measured, (L,).
    """
    faults = []
    measured = {name: np.flatnonzero(row) for name, row in present.items() if np.any(row)}
    for name, lines in list(measured.items())[1:]:
        first_name, first = next(iter(measured.items()))
        common = len(np.intersect1d(first, lines))
        low, high = max(first[0], lines[0]), min(first[-1], lines[-1])
        within = min(int(np.sum((own >= low) & (own <= high))) for own in (first, lines))
        if not common or 2 * common < within:
            spans = [f"{freq_hz[own[0]]:.8g} to {freq_hz[own[-1]]:.8g} Hz" for own in (first, lines)]
            want = "the same within 1 % of their spacing and 1e-4, as far as both bodies were measured"
            got = f"{len(first)} from {spans[0]} and {len(lines)} from {spans[1]}, {common} in common"
            thing, step = f"the frequencies of bodies {first_name} and {name}", "Measure both on one grid"
            faults.append(Fault(thing, want, got, "", step))
    return faults

"""Frequencies of channels that were written or measured apart, joined to one grid of lines."""

from __future__ import annotations

from collections.abc import Sequence

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
    """Join grids of frequencies; lines are joined within 1 % of the spacing and 1e-4 of the frequency.

    Parameters
    ----------
    grids : sequence of ndarray, (l,)
        Frequencies of each channel, Hz, ascending.

    Returns
    -------
    freq_hz : ndarray, (L,)
        Of the first grid that has each line.
    places : list of ndarray, (l,)
        Which line each frequency of a grid is.
    notices : list of Notice
        Whether lines were joined that differ by more than rounding.
    """
    different: dict[bytes, Array] = {}
    for grid in grids:
        different.setdefault(np.ascontiguousarray(grid).tobytes(), grid)
    if len(different) == 1:
        count = len(grids[0])
        return np.asarray(grids[0], dtype=float), [np.arange(count)] * len(grids), []
    joined, widest = np.empty(0), 0.0
    for grid in different.values():
        _, apart, limit = _nearest(joined, grid)
        matched = apart <= limit
        rounding = SAME_LINE * grid
        widest = max(widest, float(np.max(apart[matched & (apart > rounding)], initial=0.0)))
        joined = np.sort(np.concatenate([joined, grid[~matched]]))
    places = {key: _nearest(joined, grid)[0] for key, grid in different.items()}
    notices = []
    if widest > 0.0:
        text = (
            f"frequencies that differ by up to {widest:.2g} Hz between channels were taken as one line "
            "(within 1 % of the line spacing and 1e-4 of the frequency)."
        )
        notices.append(Notice("frequencies_matched", text))
    return joined, [places[np.ascontiguousarray(grid).tobytes()] for grid in grids], notices


def check_filled(rows: int, lines: int, readings: int, where: str) -> None:
    """Refuse readings that share so few runs and lines that arrays of all of them would be almost empty.

    Raises
    ------
    StapeskitError
    """
    if rows * lines > max(_ANY_PLACES, readings / _LEAST_FILLED):
        got = f"{readings} readings of {rows} channels and runs in {lines} lines"
        step = "Check which columns hold the frequency and the run: one has a new value in almost every row"
        raise StapeskitError.of("the readings", "at lines and in runs that channels share", got, where, step)


def _nearest(lines: Array, grid: Array) -> tuple[Index, Array, Array]:
    """Return the nearest of ascending lines to each frequency, how far it is, and how far it may be."""
    if not len(lines):
        return np.zeros(len(grid), dtype=np.intp), np.full(len(grid), np.inf), np.zeros(len(grid))
    after = np.clip(np.searchsorted(lines, grid), 1, max(len(lines) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(lines) - 1)
    nearest = np.where(grid - lines[before] <= lines[after] - grid, before, after)
    spacing = np.minimum(_spacing(lines)[nearest], _spacing(grid))
    limit = np.maximum(np.minimum(OF_SPACING * spacing, MOST * grid), SAME_LINE * grid)
    return nearest, np.abs(lines[nearest] - grid), limit


def _spacing(lines: Array) -> Array:
    """Return the distance of each line from its nearest neighbour."""
    steps = np.concatenate([[np.inf], np.diff(lines), [np.inf]])
    return np.asarray(np.minimum(steps[:-1], steps[1:]))


def grid_faults(freq_hz: Array, present: NDArray[np.bool_], names: Sequence[str]) -> list[Fault]:
    """List the bodies that share less than half of the lines that they could share with the first one.

    Parameters
    ----------
    freq_hz : ndarray, (L,)
    present : ndarray, (body, L), bool
        Where each body was measured.
    """
    faults: list[Fault] = []
    lines = [np.flatnonzero(row) for row in present]
    measured = [number for number in range(len(names)) if len(lines[number])]
    for number in measured[1:]:
        one, other = lines[measured[0]], lines[number]
        low, high = max(one[0], other[0]), min(one[-1], other[-1])
        within = min(int(np.sum((rows >= low) & (rows <= high))) for rows in (one, other))
        common = len(np.intersect1d(one, other))
        if common and 2 * common >= within:
            continue
        grids = " and ".join(_describe(freq_hz[rows]) for rows in (one, other))
        faults.append(
            Fault(
                f"the frequencies of bodies {names[measured[0]]} and {names[number]}",
                "the same within 1 % of their spacing and 1e-4, as far as both bodies were measured",
                f"{grids}, {common} of them in common",
                next_step="Measure both bodies on one grid, or resample one of them",
            )
        )
    return faults


def _describe(freq_hz: Array) -> str:
    if len(freq_hz) < 4:
        return ", ".join(f"{value:.8g}" for value in freq_hz) + " Hz"
    first = ", ".join(f"{value:.8g}" for value in freq_hz[:2])
    return f"{first}, ... {freq_hz[-1]:.8g} Hz ({len(freq_hz)} lines)"

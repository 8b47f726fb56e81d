"""Assign frequencies to lines: equal ones, and those that differ by less than their grids resolve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.warnings import Notice

Index = NDArray[np.intp]
# Relative difference of equal frequencies (six written digits), largest difference of lines that are joined
# as a share of their spacing, and relative to the frequency.
SAME_LINE = 1e-6
OF_SPACING = 0.01
MOST = 1e-4
# Share of lines that must agree for two grids to be one.
_SHARE = 0.5
# Places of runs, channels and lines (64 MB of values) of which any share may be empty, and the least share
# that is filled where there are more. A run for each of 100 lines fills 1 in 100; what fills less has another
# column where the frequency or the run should be, and its arrays would not fit into memory.
_ANY_PLACES, _LEAST_FILLED = 4_000_000, 0.01
# More rigid bodies than these were in no study: the column of bodies holds points.
_MOST_BODIES = 1000


@dataclass(frozen=True)
class Grid:
    """The lines of a measurement.

    Attributes
    ----------
    freq_hz : ndarray, (line,)
        Ascending.
    line : ndarray, (rows,)
        Line of each row.
    """

    freq_hz: Array
    line: Index
    notices: tuple[Notice, ...] = ()


def join_lines(
    freq_hz: Array, channel: Index, body: Index, names: Sequence[str], where: str = ""
) -> tuple[Grid, list[Fault]]:
    """Number the lines of rows whose frequencies may differ a little between channels.

    Parameters
    ----------
    freq_hz : ndarray, (rows,)
        Positive and finite.
    channel, body : ndarray, (rows,)
        Number of the channel (all of one sweep) and of the body of each row.
    names : sequence of str
        Names of the bodies.
    where : str
        File, for messages.

    Returns
    -------
    Grid
    list of str
        Sentences on bodies whose grids do not fit, empty when all do.

    Raises
    ------
    KinematicsError
        The bodies share hardly any lines.

    Notes
    -----
    Frequencies within 1e-6 of each other are one line. So are those within 1 % of the spacing of the lines
    of the channels they come from, but never more than 1e-4 apart: across a resonance with 10 % damping
    that changes a response by 0.1 % at most. The line has the lowest of its frequencies.
    """
    import pandas as pd

    codes, unique = pd.factorize(freq_hz)
    order = np.argsort(unique)
    ascending = np.asarray(unique[order], dtype=float)
    gaps = np.diff(ascending)
    new = np.concatenate([[True], gaps > SAME_LINE * ascending[1:]])
    notices: list[Notice] = []
    if np.any(gaps[new[1:]] < MOST * ascending[1:][new[1:]]):
        spacing = _spacing(codes, channel, unique)[order]
        wide = np.minimum(OF_SPACING * np.minimum(spacing[1:], spacing[:-1]), MOST * ascending[1:])
        joined = new.copy()
        joined[1:] = gaps > np.maximum(wide, SAME_LINE * ascending[1:])
        joined = _without_chains(joined, ascending, wide, new)
        widest = float(np.max(gaps[new[1:] & ~joined[1:]], initial=0.0))
        if widest > 0.0:
            text = (
                f"frequencies that differ by up to {widest:.2g} Hz between channels were taken as one line "
                "(within 1 % of the line spacing and 1e-4 of the frequency)."
            )
            notices.append(Notice("frequencies_matched", text))
        new = joined
    rank = np.empty(len(unique), dtype=np.intp)
    rank[order] = np.cumsum(new) - 1
    grid = Grid(ascending[new], rank[codes], tuple(notices))
    check_filled((1, len(names), len(grid.freq_hz)), len(freq_hz), where)
    present = np.zeros((len(names), len(grid.freq_hz)), dtype=bool)
    present[body, grid.line] = True
    return grid, grid_faults(grid.freq_hz, present, names, where)


def check_bodies(names: Sequence[str], where: str = "") -> None:
    """Refuse so many bodies that they must be points.

    Raises
    ------
    KinematicsError
    """
    if len(names) > _MOST_BODIES:
        step = "Check which column names the body and which the point"
        raise KinematicsError.of("the bodies", f"at most {_MOST_BODIES}", len(names), where, step)


def check_filled(shape: tuple[int, int, int], readings: int, where: str = "") -> None:
    """Refuse readings that share so few runs and lines that arrays of all of them would be almost empty.

    Parameters
    ----------
    shape : tuple of int
        Number of runs, of channels (or bodies) and of lines.
    where : str
        File, for messages.

    Raises
    ------
    KinematicsError
    """
    places = prod(shape)
    if places <= max(_ANY_PLACES, readings / _LEAST_FILLED):
        return
    runs, channels, lines = shape
    got = f"{readings} readings of {channels} channels in {lines} lines and {runs} runs"
    step = "Check which columns hold the frequency and the run: one has a new value in almost every row"
    raise KinematicsError.of("the readings", "at lines and in runs that channels share", got, where, step)


def _spacing(codes: Index, channel: Index, unique: Array) -> Array:
    """Return the distance (unique,) of each frequency from its nearest neighbour in any one channel."""
    freq = unique[codes]
    order = np.lexsort((freq, channel))
    same = np.diff(channel[order]) == 0
    step = np.where(same, np.diff(freq[order]), np.inf)
    step[step <= SAME_LINE * freq[order][1:]] = np.inf
    spacing = np.full(len(unique), np.inf)
    np.minimum.at(spacing, codes[order][1:], step)
    np.minimum.at(spacing, codes[order][:-1], step)
    return spacing


def _without_chains(
    new: NDArray[np.bool_], ascending: Array, wide: Array, strict: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Split a group that is wider than two of its frequencies may differ."""
    starts = np.flatnonzero(new)
    ends = np.append(starts[1:], len(new)) - 1
    limit = np.append(wide, np.inf)
    for start, end in zip(starts, ends, strict=True):
        if end > start and ascending[end] - ascending[start] > float(np.min(limit[start:end])):
            new[start : end + 1] |= strict[start : end + 1]
    return new


def grid_faults(
    freq_hz: Array, present: NDArray[np.bool_], names: Sequence[str], where: str = ""
) -> list[Fault]:
    """List the bodies that share less than half of the lines that they could share with the first one.

    Parameters
    ----------
    freq_hz : ndarray, (line,)
        Ascending.
    present : ndarray, (body, line), bool
        Where each body was measured.
    where : str
        File, for messages.
    """
    faults = []
    measured = [number for number in range(len(names)) if np.any(present[number])]
    for number in measured[1:]:
        first = measured[0]
        grid_a, grid_b = np.flatnonzero(present[first]), np.flatnonzero(present[number])
        low, high = max(grid_a[0], grid_b[0]), min(grid_a[-1], grid_b[-1])
        within = min(int(np.sum((rows >= low) & (rows <= high))) for rows in (grid_a, grid_b))
        common = int(np.sum(present[first] & present[number]))
        if common and common >= _SHARE * within:
            continue
        both = " and ".join(_describe(freq_hz[rows]) for rows in (grid_a, grid_b))
        faults.append(
            Fault(
                f"the frequencies of bodies {names[first]} and {names[number]}",
                "the same within 1 % of their spacing and 1e-4, as far as both bodies were measured",
                f"{both}, {common} of them in common",
                where,
                "Measure both bodies on one grid, or resample one of them",
            )
        )
    return faults


def _describe(freq_hz: Array) -> str:
    """Write a grid as its first lines, its last one, and their number."""
    if len(freq_hz) < 4:
        return ", ".join(f"{value:.8g}" for value in freq_hz) + " Hz"
    first = ", ".join(f"{value:.8g}" for value in freq_hz[:2])
    return f"{first}, ... {freq_hz[-1]:.8g} Hz ({len(freq_hz)} lines)"

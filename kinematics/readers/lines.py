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
    notices = [Notice("file_read", text)] if widest > 0.0 else []
    return lines, [places[key] for key in keys], notices


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


def grid_faults(freq_hz: Array, present: Mapping[str, NDArray[np.bool_]]) -> list[Fault]:
    """List the bodies that share less than half of the lines that they could share with the first one.

    ``present`` says by body where it was measured, (L,).
    """
    faults = []
    measured = [(name, np.flatnonzero(row)) for name, row in present.items() if np.any(row)]
    for name, lines in measured[1:]:
        first_name, first = measured[0]
        common = len(np.intersect1d(first, lines))
        low, high = max(first[0], lines[0]), min(first[-1], lines[-1])
        within = min(int(np.sum((own >= low) & (own <= high))) for own in (first, lines))
        if not common or 2 * common < within:
            want = "the same within 1 % of their spacing and 1e-4, as far as both bodies were measured"
            spans = [
                f"{len(own)} from {freq_hz[own[0]]:.8g} to {freq_hz[own[-1]]:.8g} Hz"
                for own in (first, lines)
            ]
            thing, got = (
                f"the frequencies of bodies {first_name} and {name}",
                f"{' and '.join(spans)}, {common} in common",
            )
            faults.append(Fault(thing, want, got, "", "Measure both on one grid"))
    return faults

"""Check every row of a vibrometer table and assign its take, channel and line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Take
from legacy.kinematics.tidy.frequency_grids import Grid, check_bodies, check_filled, join_lines
from legacy.kinematics.tidy.ldv_checks import (
    check_directions,
    check_frequencies,
    check_takes,
    check_values,
    each,
    numbered,
)
from legacy.kinematics.tidy.ldv_columns import POSITION, Columns
from legacy.kinematics.tidy.ldv_positions import alike_notice, check_positions, unmeasured_notice
from legacy.kinematics.tidy.points_csv import Points
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.tables.csv_table import Table, TextColumn
from legacy.stapeskit.tables.csv_text import no_rows
from legacy.stapeskit.warnings import Notice

Index = NDArray[np.intp]
# Rows that are listed; messages join them to ranges.
_MOST = 2000
# Runs of rows a channel, from which on sorting is faster than going through runs.
_FEW = 4


@dataclass(frozen=True)
class Rows:
    """Rows by their place: take, channel and line of every row; body, point, ... of every channel.

    ``takes`` is empty when every run was measured once, and ``runs`` are the names of the first axis.
    """

    take: Index
    channel: Index
    line: Index
    body: Index
    point: Index
    freq_hz: Array
    directions: Array
    positions_mm: Array
    position_sd_mm: Array
    runs: tuple[str, ...]
    takes: tuple[Take, ...] = ()
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class _Blocks:
    """Stretches of rows that agree in all but frequency and value.

    ``table`` has one row for each; ``of_row`` (rows,) is the stretch of every row.
    """

    table: Table
    of_row: Index
    starts: Index
    place: Index = field(default_factory=lambda: np.empty(0, dtype=np.intp))


def rows_of(table: Table, columns: Columns, listed: Points | None, others: Sequence[Fault] = ()) -> Rows:
    """Check every row and number its take, channel and line.

    Parameters
    ----------
    listed : Points or None
        What a points file says of positions.
    others : sequence of str
        Faults of other files, reported in the same message.

    Raises
    ------
    KinematicsError
        Lists every fault with line and column.
    """
    faults = list(table.faults)
    usable = check_frequencies(table, faults)
    check_values(table, columns, faults)
    before = len(faults)
    blocks = _blocks(table, columns)
    rows = _place(table, columns, listed, blocks, usable, faults)
    if len(faults) > before and len(blocks.starts) < len(table):
        del faults[before:]
        blocks = _Blocks(table, np.arange(len(table)), np.arange(len(table)))
        rows = _place(table, columns, listed, blocks, usable, faults)
    raise_all(KinematicsError, [*faults, *others])
    if rows is None:
        raise KinematicsError(no_rows(table.file, "empty rows"))
    return replace(rows, notices=(*rows.notices, *alike_notice(table), *unmeasured_notice(table, listed)))


def _blocks(table: Table, columns: Columns) -> _Blocks:
    """Find the stretches; where they are short, every row is one stretch."""
    count = len(table)
    new = np.zeros(count, dtype=bool)
    new[:1] = True
    parts: list[Array | Index] = [column.codes for column in table.texts.values()]
    names = [*(POSITION if columns.positions else ()), *columns.direction, columns.level]
    parts += [table.numbers[name] for name in names if name in table.numbers]
    for values in parts:
        new[1:] |= values[1:] != values[:-1]
    starts = np.flatnonzero(new)
    if len(starts) * _FEW > count:
        return _Blocks(table, np.arange(count), np.arange(count))
    numbers = {name: values[starts] for name, values in table.numbers.items()}
    texts = {name: TextColumn(column.codes[starts], column.names) for name, column in table.texts.items()}
    short = replace(table, numbers=numbers, texts=texts, lines=table.lines[starts])
    return _Blocks(short, np.cumsum(new) - 1, starts)


def _place(
    table: Table,
    columns: Columns,
    listed: Points | None,
    blocks: _Blocks,
    usable: NDArray[np.bool_],
    faults: list[Fault],
) -> Rows | None:
    """Number takes, channels and lines; None when no row can be placed."""
    short = blocks.table
    body, point = short.texts["body"], short.texts["point"]
    check_bodies(body.names, table.file)
    for name, column in (("body", body), ("point", point)):
        each(column.codes < 0, name, "a name", lambda _row: "an empty cell", short, faults)
    check_takes(short, columns, faults)
    directions, which = check_directions(short, columns, faults)
    place, place_first = numbered(body.codes * (len(point.names) + 1) + point.codes)
    positions, spread = check_positions(short, columns, listed, place, place_first, faults)
    take, takes = _number_takes(short, columns)
    known = (body.codes >= 0) & (point.codes >= 0) & np.isfinite(directions[:, 0])
    rows = np.flatnonzero(usable & known[blocks.of_row])
    if not rows.size:
        if not faults:
            faults.append(no_rows(table.file, "empty rows"))
        return None
    of_short = np.flatnonzero(known)
    channel_known, first = numbered((place * (int(which.max()) + 1) + which)[of_short])
    first = of_short[first]
    channel = np.full(len(short), -1, dtype=np.intp)
    channel[of_short] = channel_known
    at_channel, at_take = channel[blocks.of_row], take[blocks.of_row]
    grid, apart = _lines(table, rows, at_channel, at_take, body, first)
    if not faults:
        faults += apart
    check_filled((len(takes), len(first), len(grid.freq_hz)), len(rows), table.file)
    whole = (at_take[rows] * (int(at_channel.max()) + 1) + at_channel[rows]) * len(grid.freq_hz) + grid.line
    _duplicates(whole, rows, table, faults)
    several = len(takes) > len({t.run for t in takes})
    runs = tuple(t.name for t in takes) if several else tuple(t.run for t in takes)
    return Rows(
        at_take,
        at_channel,
        grid.line,
        body.codes[first],
        point.codes[first],
        grid.freq_hz,
        directions[first],
        positions[place[first]],
        spread[place[first]],
        runs,
        takes if several else (),
        grid.notices,
    )


def _number_takes(table: Table, columns: Columns) -> tuple[Index, tuple[Take, ...]]:
    """Number the takes of the rows in the order of first appearance."""
    ones = TextColumn(np.zeros(len(table), dtype=np.intp), ("1",))
    run = table.texts["run"] if columns.run else ones
    repeat = table.texts["repeat"] if columns.repeat else TextColumn(ones.codes, ("",))
    level, level_value = ones.codes, np.array([np.nan])
    if columns.level:
        amplitude = table.numbers[columns.level]
        amplitude = 10.0 ** (amplitude / 20.0) if columns.decibels else amplitude
        level, level_first = numbered(amplitude)
        level_value = amplitude[level_first]
    key = (run.codes + 1) * (len(repeat.names) + 1) + repeat.codes + 1
    take, first = numbered(key * (len(level_value) + 1) + level)
    takes = []
    for row in first.tolist():
        name = run.names[run.codes[row]] if run.codes[row] >= 0 else "1"
        again = repeat.names[repeat.codes[row]] if repeat.codes[row] >= 0 else ""
        takes.append(Take(name, again, float(level_value[level[row]])))
    return take, tuple(takes)


def _lines(
    table: Table, rows: Index, channel: Index, take: Index, body: TextColumn, first: Index
) -> tuple[Grid, list[Fault]]:
    """Number the lines of the rows; sweeps over one grid, row after row, need no sorting."""
    freq = table.numbers["freq_hz"]
    width = int(np.argmax(freq[1:] <= freq[:-1])) + 1 if len(freq) > 1 else 1
    if len(rows) == len(table) and len(table) % width == 0:
        sweeps = freq.reshape(-1, width)
        ascending = sweeps[0]
        if np.array_equal(sweeps, np.broadcast_to(ascending, sweeps.shape)) and np.all(
            np.diff(ascending) > 1e-4 * ascending[1:]
        ):
            return Grid(ascending.copy(), np.tile(np.arange(width), len(sweeps))), []
    sweep = channel[rows] * (int(take.max()) + 1) + take[rows]
    return join_lines(freq[rows], sweep, body.codes[first][channel[rows]], body.names, table.file)


def _duplicates(whole: Index, rows: Index, table: Table, faults: list[Fault]) -> None:
    """Add the faults of duplicate rows; ``whole`` numbers the places."""
    occupied = np.zeros(int(whole.max()) + 1, dtype=bool)
    occupied[whole] = True
    if int(np.count_nonzero(occupied)) == len(whole):
        return
    import pandas as pd

    twice = pd.Series(whole).duplicated().to_numpy()
    _, first = numbered(whole)
    codes, _ = pd.factorize(whole)
    for number in np.flatnonzero(twice)[:_MOST]:
        row, earlier = int(rows[number]), int(rows[first[codes[number]]])
        faults.append(
            Fault(
                "a row",
                "the only one of its run, body, point, direction and frequency",
                f"the same as in line {table.lines[earlier]}",
                table.where(row),
                "Number repeats in a column repeat, or remove the row",
            )
        )

"""Check the cells of each row of a vibrometer table."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.tidy.ldv_columns import DIRECTION, Columns
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.frames import axis_vector
from legacy.stapeskit.tables.csv_table import Table
from legacy.stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ

Index = NDArray[np.intp]
# Rows that are listed; messages join them to ranges.
_MOST = 1_000_000


def each(
    bad: NDArray[np.bool_],
    column: str,
    expected: str,
    got: Callable[[int], str],
    table: Table,
    faults: list[Fault],
    step: str = "Correct the cell",
) -> None:
    """Add one sentence for each bad row (rows,) of a table."""
    for row in np.flatnonzero(bad)[:_MOST].tolist():
        faults.append(Fault(column, expected, got(row), table.where(row, column), step))


def check_frequencies(table: Table, faults: list[Fault]) -> NDArray[np.bool_]:
    """Return which rows (rows,) have a positive and finite frequency, and add the others' faults."""
    freq = table.numbers["freq_hz"]
    usable = (freq >= LOWEST_HZ) & (freq <= HIGHEST_HZ)
    if not np.all(usable):
        high = (freq > HIGHEST_HZ) & (freq < np.inf)
        step = "Give the frequency in Hz"
        want = f"at most {HIGHEST_HZ:g} Hz"
        each(high, "freq_hz", want, lambda row: _cell(float(freq[row])), table, faults, step)
        low = (freq > 0.0) & (freq < LOWEST_HZ)
        want = f"{LOWEST_HZ:g} Hz or more"
        each(low, "freq_hz", want, lambda row: _cell(float(freq[row])), table, faults, step)
        each(
            ~usable & ~high & ~low & ~(table.invalid_rows("freq_hz") & np.isnan(freq)),
            "freq_hz",
            "positive and finite",
            lambda row: _cell(float(freq[row])),
            table,
            faults,
            "Give the frequency in Hz, or leave the row out (a DC line holds no motion)",
        )
    return usable


def check_values(table: Table, columns: Columns, faults: list[Fault]) -> None:
    """Add the faults of values, phases, standard deviations, averages, coherences and levels."""
    numbers = table.numbers

    def check(bad: NDArray[np.bool_], name: str, expected: str, step: str = "Correct the cell") -> None:
        if np.any(bad):
            values = numbers[name]
            each(bad, name, expected, lambda row: _cell(float(values[row])), table, faults, step)

    for name in (columns.first, columns.second):
        step = "Leave the cell empty where the value is missing"
        large = np.abs(numbers[name]) > LARGEST
        if np.any(large):
            check(large & np.isinf(numbers[name]), name, "finite", step)
            check(large & ~np.isinf(numbers[name]), name, f"below {LARGEST:g}", step)
    if columns.polar:
        below = numbers[columns.first] < 0.0
        decibels = np.sum(below) > 0.5 * len(below)
        step = "They look like decibels: give amplitudes, 10^(dB/20) times the reference"
        check(below, columns.first, "positive or zero", step if decibels else "Correct the cell")
    if columns.sd:
        sd = numbers[columns.sd]
        check((sd < 0.0) | np.isinf(sd), columns.sd, "positive and finite")
        check((sd > LARGEST) & ~np.isinf(sd), columns.sd, f"below {LARGEST:g}")
        if (
            len(sd)
            and np.isnan(sd[0])
            and np.all(np.isnan(sd))
            and not np.any(table.invalid_rows(columns.sd))
        ):
            step = "Leave the column out to have the noise estimated from the residuals"
            got = "NaN or empty cells throughout"
            where = f"{table.file}, lines {table.lines[0]} to {table.lines[-1]}, {columns.sd}"
            faults.append(Fault(columns.sd, "a number in at least one row", got, where, step))
    if "n_avg" in columns.extra:
        values = numbers["n_avg"]
        check((values < 1.0) | np.isinf(values), "n_avg", "1 or more")
    if "coherence" in columns.extra:
        values = numbers["coherence"]
        check((values < 0.0) | (values > 1.0), "coherence", "within 0 and 1")
    if columns.level:
        level = numbers[columns.level]
        if columns.decibels:
            check(np.isinf(level), columns.level, "finite")
        else:
            step = "Give an amplitude, or decibels in a column level_db"
            check((level <= 0.0) | np.isinf(level), columns.level, "positive and finite", step)


def check_takes(table: Table, columns: Columns, faults: list[Fault]) -> None:
    """Add the faults of runs, repeats and levels that some rows name and others do not."""
    empty = {name: table.texts[name].codes < 0 for name in ("run", "repeat") if name in table.texts}
    if columns.level:
        reported = table.invalid_rows(columns.level)
        empty[columns.level] = np.isnan(table.numbers[columns.level]) & ~reported
    for name, rows in empty.items():
        if np.any(rows) and not np.all(rows):
            expected = "given in every row, or in none"
            each(rows, name, expected, lambda _row: "an empty cell", table, faults, "Fill it in")


def check_directions(table: Table, columns: Columns, faults: list[Fault]) -> tuple[Array, Index]:
    """Return the unit direction (rows, 3) of every row and a number (rows,) for each different one."""
    if columns.direction == ("dir",):
        column = table.texts["dir"]
        vectors = np.full((len(column.names) + 1, 3), np.nan)
        for place, name in enumerate(column.names):
            axis = axis_vector(name)
            vectors[place] = np.nan if axis is None else axis
        rows = vectors[column.codes]
        names = (*column.names, "an empty cell")
        unknown = np.isnan(rows[:, 0])
        each(unknown, "dir", "x, y, z, -x, -y or -z", lambda r: names[column.codes[r]], table, faults)
        code = np.where(unknown, 0, np.argmax(np.abs(rows), axis=1) * 2 + (rows.sum(axis=1) < 0.0))
        return rows, code
    parts = np.column_stack([table.numbers[name] for name in DIRECTION])
    with np.errstate(over="ignore"):
        x, y, z = (numbered(part)[0] for part in np.round(parts * 1e7).T)
    # Numbers of at most the rows each: their products are exact, which a sum of the components is not.
    beside, _ = numbered(x * (int(y.max(initial=0)) + 1) + y)
    code, first = numbered(beside * (int(z.max(initial=0)) + 1) + z)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(parts[first], axis=1)
        bad = ~(np.abs(length - 1.0) <= 1e-3)
    if np.any(bad):
        reported = np.zeros(len(table), dtype=bool)
        for name in DIRECTION:
            reported |= table.invalid_rows(name)
        each(
            bad[code] & ~reported,
            "dir_x, dir_y, dir_z",
            "a unit vector (within 1e-3)",
            lambda r: _vector(parts[r]),
            table,
            faults,
            "Divide the direction by its length",
        )
        length[bad & np.isfinite(length)] = 1.0
    with np.errstate(invalid="ignore"):
        return (parts[first] / length[:, None])[code], code


def numbered(keys: Array | Index) -> tuple[Index, Index]:
    """Number equal keys in the order of first appearance; return the numbers and each one's first row."""
    import pandas as pd

    codes, unique = pd.factorize(keys, use_na_sentinel=False)
    first = np.full(len(unique), len(codes), dtype=np.intp)
    first[codes[::-1]] = np.arange(len(codes))[::-1]
    return np.asarray(codes, dtype=np.intp), first


def _cell(value: float) -> str:
    return "an empty or NaN cell" if np.isnan(value) else f"{value:g}"


def _vector(parts: Array) -> str:
    """Return a direction for a message."""
    listed = ", ".join(f"{value:g}" for value in parts)
    with np.errstate(over="ignore"):
        return f"({listed})" + ("" if np.any(np.isnan(parts)) else f" of length {np.linalg.norm(parts):g}")

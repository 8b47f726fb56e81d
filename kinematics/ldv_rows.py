"""Check every row of a vibrometer table and give it its place: run, channel, line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.csv_table import Table, TextColumn
from kinematics.errors import KinematicsError, raise_all, sentence
from kinematics.ldv_columns import DIRECTION, POSITION, Columns
from kinematics.points_csv import Points

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_SHORT = {
    sign + axis: (-1.0 if sign == "-" else 1.0, "xyz".index(axis))
    for sign in ("", "+", "-")
    for axis in "xyz"
}
_SAME_LINE = 1e-6
_MOST = 2000


@dataclass(frozen=True)
class Rows:
    """Rows by their place: run, body, point, channel and line of every row."""

    run: Index
    body: Index
    point: Index
    channel: Index
    line: Index
    freq_hz: Array
    directions: Array
    positions_mm: Array
    position_sd_mm: Array
    runs: tuple[str, ...]


def rows_of(table: Table, columns: Columns, listed: Points | None) -> Rows:
    """Check every row and number its channel and line; all faults are raised together."""
    faults = list(table.faults)
    body, point = table.texts["body"], table.texts["point"]
    for name, column in (("body", body), ("point", point)):
        _each(column.codes < 0, name, "a name", lambda _row: "an empty cell", table, faults)
    run = (
        table.texts["run"]
        if "run" in table.texts
        else TextColumn(np.zeros(len(table), dtype=np.intp), ("1",))
    )
    freq = table.numbers["freq_hz"]
    usable = (freq > 0.0) & ~np.isinf(freq)
    _each(
        ~usable & ~(_told(table) & np.isnan(freq)),
        "freq_hz",
        "positive and finite",
        lambda row: _cell(float(freq[row])),
        table,
        faults,
        "Give the frequency in Hz, or leave the row out (a DC line holds no motion)",
    )
    directions, which = _directions(table, columns, faults)
    _check_values(table, columns, faults)
    place, place_first = _numbered(body.codes * len(point.names) + point.codes)
    positions, spread = _positions(table, columns, listed, place, place_first, faults)
    usable &= (body.codes >= 0) & (point.codes >= 0) & np.isfinite(directions[:, 0])
    rows = np.flatnonzero(usable)
    if rows.size:
        lines, line = _lines(freq[rows])
        channel, first = _numbered((place * (which.max() + 1) + which)[rows])
        whole = (run.codes[rows] * (channel.max() + 1) + channel) * len(lines) + line
        _duplicates(whole, rows, table, faults)
    elif not faults:
        step = "Export it again"
        faults.append(sentence(table.file, "a table with rows below its header", "empty rows", "", step))
    raise_all(KinematicsError, faults)
    return Rows(
        run.codes,
        body.codes[first],
        point.codes[first],
        channel,
        line,
        lines,
        directions[first],
        positions[place[first]],
        spread[place[first]],
        run.names,
    )


def _each(
    bad: NDArray[np.bool_],
    column: str,
    expected: str,
    got: object,
    table: Table,
    faults: list[str],
    step: str = "Correct the cell",
) -> None:
    for row in np.flatnonzero(bad)[:_MOST]:
        value = got(int(row)) if callable(got) else got
        faults.append(sentence(column, expected, value, table.where(int(row), column), step))


def _told(table: Table) -> NDArray[np.bool_]:
    """Return which rows (rows,) hold a cell that was told to be no number already."""
    told = table.told
    if not told:
        return np.zeros(len(table), dtype=bool)
    return np.array([table.where(row) in told for row in range(len(table))], dtype=bool)


def _cell(value: float) -> str:
    return "an empty or NaN cell" if np.isnan(value) else f"{value:g}"


def _directions(table: Table, columns: Columns, faults: list[str]) -> tuple[Array, Index]:
    """Return the unit direction of every row, and a number for each different one."""
    if columns.direction == ("dir",):
        column = table.texts["dir"]
        vectors = np.full((len(column.names) + 1, 3), np.nan)
        for place, name in enumerate(column.names):
            if name.lower() in _SHORT:
                sign, axis = _SHORT[name.lower()]
                vectors[place] = np.eye(3)[axis] * sign
        rows = vectors[column.codes]
        names = (*column.names, "an empty cell")
        _each(
            np.isnan(rows[:, 0]),
            "dir",
            "x, y, z, -x, -y or -z",
            lambda r: names[column.codes[r]],
            table,
            faults,
        )
        code = np.where(
            np.isnan(rows[:, 0]), 0, np.argmax(np.abs(rows), axis=1) * 2 + (rows.sum(axis=1) < 0.0)
        )
        return rows, code
    parts = np.column_stack([table.numbers[name] for name in DIRECTION])
    rounded = np.round(parts * 1e7)
    mixed = rounded @ np.array([1.0, 33554467.0, 1125900906842597.0])
    code, first = _numbered(mixed)
    length = np.linalg.norm(parts[first], axis=1)
    bad = ~(np.abs(length - 1.0) <= 1e-3)
    if np.any(bad):
        _each(
            bad[code] & ~(_told(table) & np.isnan(length[code])),
            "dir_x, dir_y, dir_z",
            "a unit vector (within 1e-3)",
            lambda r: _vector(parts[r]),
            table,
            faults,
            "Divide the direction by its length",
        )
        length[bad & np.isfinite(length)] = 1.0
    return (parts[first] / length[:, None])[code], code


def _vector(parts: Array) -> str:
    """Return a direction for a message."""
    listed = ", ".join(f"{value:g}" for value in parts)
    return f"({listed})" + ("" if np.any(np.isnan(parts)) else f" of length {np.linalg.norm(parts):g}")


def _numbered(keys: Array | Index) -> tuple[Index, Index]:
    """Number equal keys in the order of first appearance; return the numbers and each one's first row."""
    import pandas as pd

    codes, unique = pd.factorize(keys, use_na_sentinel=False)
    first = np.full(len(unique), len(codes), dtype=np.intp)
    np.minimum.at(first, codes, np.arange(len(codes))) if len(unique) < 64 else _first(codes, first)
    return np.asarray(codes, dtype=np.intp), first


def _first(codes: Index, first: Index) -> None:
    first[codes[::-1]] = np.arange(len(codes))[::-1]


def _check_values(table: Table, columns: Columns, faults: list[str]) -> None:
    numbers = table.numbers
    for name in (columns.first, columns.second):
        values = numbers[name]
        step = "Leave the cell empty where the value is missing"
        _each(np.isinf(values), name, "finite", lambda r, v=values: f"{v[r]:g}", table, faults, step)
    if columns.polar:
        values = numbers[columns.first]
        _each(values < 0.0, columns.first, "positive or zero", lambda r: f"{values[r]:g}", table, faults)
    if columns.sd:
        sd = numbers[columns.sd]
        _each(
            (sd < 0.0) | np.isinf(sd),
            columns.sd,
            "positive and finite",
            lambda r: f"{sd[r]:g}",
            table,
            faults,
        )
        if len(sd) and np.all(np.isnan(sd)):
            faults.append(
                sentence(
                    columns.sd,
                    "a number in some row at least",
                    "NaN or empty cells throughout",
                    table.file,
                    "Leave the column out to have the noise estimated from the residuals",
                )
            )
    for name, low, high, words in (
        ("n_avg", 1.0, np.inf, "1 or more"),
        ("coherence", 0.0, 1.0, "within 0 and 1"),
    ):
        if name in columns.extra:
            values = numbers[name]
            bad = (values < low) | (values > high) | np.isinf(values)
            _each(bad, name, words, lambda r, v=values: f"{v[r]:g}", table, faults)


def _positions(
    table: Table, columns: Columns, listed: Points | None, place: Index, first: Index, faults: list[str]
) -> tuple[Array, Array]:
    """Return the position of every point and its sd, mm; ``place`` numbers the points of the rows."""
    body, point = table.texts["body"], table.texts["point"]
    positions, spread = np.full((len(first), 3), np.nan), np.full(len(first), np.nan)

    def key_of(row: int) -> tuple[str, str]:
        return body.names[body.codes[row]], point.names[point.codes[row]]

    if columns.positions:
        rows = np.column_stack([table.numbers[name] for name in POSITION])
        bad = ~np.all(np.isfinite(rows), axis=1)
        new = bad & ~_told(table)
        _each(new, ", ".join(POSITION), "finite numbers", lambda r: str(rows[r].tolist()), table, faults)
        positions = rows[first]
        moved = np.any(rows != positions[place], axis=1) & ~bad
        for number in np.unique(place[moved]):
            row = int(np.flatnonzero(moved & (place == number))[0])
            old = f"{positions[number].tolist()} in line {table.lines[first[number]]}"
            faults.append(_two_positions(key_of(row), old, rows[row], table.where(row, ", ".join(POSITION))))
    if listed is not None:
        for number, row in enumerate(first.tolist()):
            if body.codes[row] < 0 or point.codes[row] < 0:
                continue
            key = key_of(row)
            known = listed.positions.get(key)
            if known is None:
                what = sentence(
                    f"point {key[1]} of body {key[0]}",
                    f"listed in {listed.file}",
                    "no row of that name there",
                    table.where(row, "point"),
                    f"Add it to {listed.file}, or leave its rows out",
                )
                faults.append(what)
            elif columns.positions and np.max(np.abs(positions[number] - known)) > 1e-6:
                old = f"{known.tolist()} in {listed.file}"
                faults.append(_two_positions(key, old, positions[number], table.where(row)))
            else:
                positions[number], spread[number] = known, listed.sd_mm[key]
    return positions, spread


def _two_positions(key: tuple[str, str], old: str, new: Array, where: str) -> str:
    return sentence(
        f"the position of point {key[1]} of body {key[0]}",
        "one",
        f"{old} and {new.tolist()}",
        where,
        "Name the points apart, or correct the position",
    )


def _lines(freq: Array) -> tuple[Array, Index]:
    """Return the frequency lines, ascending, equal ones within 1e-6 joined, and the line of every row."""
    import pandas as pd

    codes, unique = pd.factorize(freq)
    order = np.argsort(unique)
    ascending = unique[order]
    new = np.concatenate([[True], np.diff(ascending) > _SAME_LINE * ascending[1:]])
    rank = np.empty(len(unique), dtype=np.intp)
    rank[order] = np.cumsum(new) - 1
    return ascending[new], rank[codes]


def _duplicates(whole: Index, rows: Index, table: Table, faults: list[str]) -> None:
    """Note the rows whose place, numbered by ``whole``, another one has already."""
    import pandas as pd

    twice = pd.Series(whole).duplicated().to_numpy()
    for number in np.flatnonzero(twice)[:_MOST]:
        row, first = rows[number], int(rows[np.flatnonzero(whole == whole[number])[0]])
        faults.append(
            sentence(
                "a row",
                "the only one of its run, body, point, direction and frequency",
                f"the same as in line {table.lines[first]}",
                table.where(int(row)),
                "Give repeats different names in the column run",
            )
        )

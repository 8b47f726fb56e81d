"""Read the tidy vibrometer table: one row per body, point, beam and frequency (docs/commands.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import Row, from_parts, from_polar, recording_of
from kinematics.readers.lines import SAME_LINE, check_filled
from kinematics.readers.points import POSITION, position_faults
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.tidy_columns import DIRECTION, EXTRA, TEXTS, Columns, columns_of, with_meant
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from stapeskit.tables import Table

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

_SAME_PLACE_MM = 1e-6  # rounding of written coordinates


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a tidy table.

    Raises
    ------
    StapeskitError
        A column is missing or has an unknown unit; or rows are faulty: text where a number belongs, an
        infinite value, a frequency that is not positive, a direction that is no unit vector, a duplicate row,
        a point with two positions, an sd that is negative or empty throughout. All faults are listed with
        line and column.
    """
    from stapeskit.tables import read_table

    found: list[Columns] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        found.append(columns_of(header, file))
        return found[0].numbers, found[0].texts

    table = read_table(Path(path), choose)
    columns, faults = found[0], list(table.faults)
    usable = _check_numbers(table, columns, faults)
    names = {name: _names(table, name, faults) for name in TEXTS[:4] if name in columns.names}
    directions, beam = _directions(table, columns, faults)
    usable &= (names["body"][0] >= 0) & (names["point"][0] >= 0) & (beam >= 0)
    if POSITION[0] in columns.names:
        _check_positions(table, _numbered([names["body"][0], names["point"][0]])[0], faults)
    rows = np.flatnonzero(usable)
    if not len(rows):
        step = "Export it again"
        raise_all(faults or [Fault(table.file, "a table with rows of values", "none", "", step)])
    sweep, first = _numbered([*(codes[rows] for codes, _ in names.values()), beam[rows]])
    first, freq = rows[first], table.numbers["freq_hz"][rows]
    check_filled(len(first), len(np.unique(freq)), len(rows), table.file)
    if np.any((np.diff(sweep) < 0) | ((np.diff(sweep) == 0) & (np.diff(freq) <= 0.0))):
        order = np.lexsort((freq, sweep))
        rows, sweep, freq = rows[order], sweep[order], freq[order]
    again = np.flatnonzero((np.diff(freq) <= SAME_LINE * freq[1:]) & (np.diff(sweep) == 0))
    earlier = dict(zip(rows[again + 1].tolist(), table.lines[rows[again]].tolist(), strict=True))
    want = "the only one of its run, body, point, direction and frequency"
    step = "Number repeats in a column repeat, or remove the row"
    faults += [
        Fault("a row", want, f"that of line {earlier[row]}", table.where(row), step)
        for row in sorted(earlier)
    ]
    raise_all(faults)
    value, extra = _values(table, columns, rows)
    edges = [0, *(np.flatnonzero(np.diff(sweep)) + 1).tolist(), len(sweep)]
    recording = recording_of(
        table.file,
        [
            Row(
                _channel(table, columns, names, directions[beam[row]], row),
                freq[a:b],
                value[a:b],
                **{name: part[a:b] for name, part in extra.items()},
            )
            for row, (a, b) in zip(first.tolist(), pairwise(edges), strict=True)
        ],
        statement="as its columns say",
        amplitude_stated=True,
    )
    return replace(recording, notices=(*recording.notices, *_notices(table, columns, recording)))


def _row_faults(
    table: Table,
    bad: Mask,
    column: str,
    want: str,
    got: Callable[[int], str],
    step: str = "Correct the cell",
) -> list[Fault]:
    """Return one fault for each bad row."""
    rows = np.flatnonzero(bad).tolist()
    return [Fault(column, want, got(row), table.where(row, column), step) for row in rows]


def _names(table: Table, name: str, faults: list[Fault]) -> tuple[Index, tuple[str, ...]]:
    """Return codes (rows,), -1 where a cell is empty, and the names that they stand for.

    Names that a spreadsheet made of one are one. A run or repeat is named in every row or in none.
    """
    column = table.texts[name]
    plain = [plain_name(text) if name == "point" else text for text in column.names]
    place = {text: number for number, text in enumerate(dict.fromkeys(plain))}
    codes = np.array([*(place[text] for text in plain), -1], dtype=np.intp)[column.codes]
    must = name in ("body", "point")
    if must or np.any(codes >= 0):
        want = "a name" if must else "given in every row, or in none"
        faults += _row_faults(table, codes < 0, name, want, lambda _: "an empty cell")
    return codes, tuple(place)


def _check_numbers(table: Table, columns: Columns, faults: list[Fault]) -> Mask:
    """Report numbers that no row may hold; return which rows have a frequency."""
    empty = "Leave the cell empty where the value is missing"
    linear = "Give linear amplitudes: decibels are 10^(dB/20) times the reference"
    dc = "Give the frequency in Hz, or leave the row out (a DC line holds no motion)"
    limits = {
        "freq_hz": (LOWEST_HZ, HIGHEST_HZ, dc),
        columns.first: (0.0 if columns.polar else -LARGEST, LARGEST, linear if columns.polar else empty),
        columns.second: (-LARGEST, LARGEST, empty),
        columns.sd: (0.0, LARGEST, empty),
        "n_avg": (1.0, LARGEST, empty),
        "coherence": (0.0, 1.0, empty),
    }
    for name, (low, high, step) in limits.items():
        if name not in table.numbers:
            continue
        cells = table.numbers[name]
        bad = (cells < low) | (cells > high)
        if name == "freq_hz":
            bad |= np.isnan(cells) & ~table.invalid_rows(name)
        got = [f"{cell:g}" if cell == cell else "an empty or NaN cell" for cell in cells[bad].tolist()]
        texts = dict(zip(np.flatnonzero(bad).tolist(), got, strict=True))
        faults += _row_faults(table, bad, name, f"from {low:g} to {high:g}", texts.__getitem__, step)
    if columns.sd and len(table) and np.all(np.isnan(table.numbers[columns.sd])):
        step = "Leave the column out to have the noise estimated from the residuals"
        want, where = "a number in at least one row", Place(table.file, detail=columns.sd)
        faults.append(Fault(columns.sd, want, "NaN or empty cells throughout", where, step))
    freq = table.numbers["freq_hz"]
    return np.asarray((freq >= LOWEST_HZ) & (freq <= HIGHEST_HZ))


def _directions(table: Table, columns: Columns, faults: list[Fault]) -> tuple[Array, Index]:
    """Return the different unit directions (n, 3) and which of them each row (rows,) has, -1 for none."""
    if "dir" in columns.names:
        column = table.texts["dir"]
        axes = [axis_vector(name) for name in column.names]
        vectors = np.array([*(unknown_vector() if axis is None else axis for axis in axes), unknown_vector()])
        code, invalid = column.codes, np.zeros(len(column.codes), dtype=bool)
        thing, want, step = "dir", "x, y, z, -x, -y or -z", "Correct the cell"
        got = [*map(shown, column.names), "an empty cell"]
    else:
        parts = [table.numbers[name] for name in DIRECTION]
        code, first = _numbered(parts)
        vectors = np.column_stack(parts)[first]
        invalid = np.any([table.invalid_rows(name) for name in DIRECTION], axis=0)
        thing, want = ", ".join(DIRECTION), "a unit vector (within 1e-3)"
        step = "Divide the direction by its length"
        got = [f"({', '.join(f'{part:g}' for part in vector)})" for vector in vectors]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        length = np.linalg.norm(vectors, axis=1)
        units = vectors / length[:, None]
    good = (np.abs(length - 1.0) <= 1e-3)[code]
    faults += _row_faults(table, ~good & ~invalid, thing, want, lambda row: got[code[row]], step)
    return units, np.where(good, code, -1)


def _check_positions(table: Table, place: Index, faults: list[Fault]) -> None:
    """Report positions that are empty or far away, and points with two; ``place`` numbers the points."""
    faults += position_faults(table, POSITION)
    xyz = np.column_stack([table.numbers[name] for name in POSITION])
    good = np.flatnonzero(np.all(np.isfinite(xyz), axis=1))
    first = np.zeros(int(place.max(initial=0)) + 1, dtype=np.intp)
    first[place[good][::-1]] = good[::-1]
    other = first[place]
    moved = np.any(np.abs(xyz - xyz[other]) > _SAME_PLACE_MM, axis=1)  # not so for NaN

    def got(row: int) -> str:
        return f"{xyz[other[row]].tolist()} in line {table.lines[other[row]]} and {xyz[row].tolist()}"

    step = "Name the points differently, or correct the position"
    faults += _row_faults(table, moved, "the position of a point", "one", got, step)


def _channel(
    table: Table,
    columns: Columns,
    names: dict[str, tuple[Index, tuple[str, ...]]],
    direction: Array,
    row: int,
) -> Channel:
    """Return the channel that a row is of."""
    texts = {name: (*known, "")[codes[row]] for name, (codes, known) in names.items()}
    position = unknown_vector()
    if POSITION[0] in columns.names:
        position = 1e-3 * np.array([table.numbers[name][row] for name in POSITION])
    given = {"order": columns.unit.order, "position_m": position, "direction": direction}
    return Channel(**texts, **given, where=table.where(row))


def _values(table: Table, columns: Columns, rows: Index) -> tuple[ComplexArray, dict[str, Any]]:
    """Return the complex values of rows in SI, and their noise, averages and coherence."""
    first, second = table.numbers[columns.first][rows], table.numbers[columns.second][rows]
    extra: dict[str, Any] = {name: table.numbers[name][rows] for name in EXTRA if name in columns.names}
    if columns.sd:
        extra["sd"] = table.numbers[columns.sd][rows] * columns.sd_scale
    if columns.polar:
        return from_polar(columns.unit.scale * first, second, np.pi / 180.0), extra
    return from_parts(first, second, columns.unit.scale), extra


def _notices(table: Table, columns: Columns, recording: Recording) -> list[Notice]:
    """Report what is missing and what was not used."""
    notices, file = [], table.file
    missing = np.isnan(recording.value)
    sweeps = [(channel.body, channel.run, channel.repeat) for channel in recording.channels]
    for key in dict.fromkeys(sweeps):  # lines that a whole sweep lacks are no gaps in it
        mine = [number for number, other in enumerate(sweeps) if other == key]
        missing[mine] &= ~np.all(missing[mine], axis=0)
    if np.any(missing):
        gaps = [recording.channels[k].name for k in np.flatnonzero(np.any(missing, axis=1)).tolist()]
        text = (
            f"{int(np.sum(missing))} readings of {len(gaps)} channels ({list_some(gaps, 6)}) have no row or "
            f"no value in {file} at lines that other channels of the body have: they count as missing."
        )
        notices.append(Notice("file_read", text))
    exact = 0 if recording.sd is None else int(np.sum(recording.sd == 0.0))
    if exact:
        text = f"{exact} values of {file} have a noise of 0: they are exact to 1e-12 of the largest."
        notices.append(Notice("noise_free", text))
    bodies = dict.fromkeys(channel.body for channel in recording.channels)
    if len({body.lower() for body in bodies}) < len(bodies):
        text = f"bodies of {file} differ in case only and were taken as different: {', '.join(bodies)}."
        notices.append(Notice("file_read", text))
    if columns.ignored:
        listed = list_some(map(with_meant, columns.ignored), 6)
        notices.append(Notice("file_read", f"columns of {file} that are not used: {listed}."))
    return notices


def _numbered(keys: Sequence[Array | Index]) -> tuple[Index, Index]:
    """Number equal rows of several columns in the order of appearance; return also their first rows."""
    codes = np.zeros(len(keys[0]), dtype=np.int64)
    for key in keys:
        own = np.unique(key, return_inverse=True)[1]
        codes = np.unique(codes * (int(own.max(initial=0)) + 1) + own, return_inverse=True)[1]
    _, first, codes = np.unique(codes, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return np.asarray(place[codes], dtype=np.intp), np.asarray(first[order], dtype=np.intp)

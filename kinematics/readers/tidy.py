"""Read the tidy vibrometer table: one row per body, point, beam and frequency (docs/commands.md)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import Row, from_parts, from_polar, recording_of
from kinematics.readers.lines import SAME_LINE, check_filled
from kinematics.readers.points import POSITION, cell_faults, position_faults, text_of
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name, shown
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ, SUFFIXES, Unit, unit_of
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from stapeskit.tables import Table

Index = NDArray[np.intp]

DIRECTION = ("dir_x", "dir_y", "dir_z")
TEXTS = ("body", "point", "run", "repeat", "dir")
EXTRA = ("n_avg", "coherence")

_WITH_UNIT = re.compile(r"(?:re|im|amp|sd)(?:_.*)?|(freq|phase).*")
_UNITS = {"freq": "freq_hz", "phase": "phase_deg", None: f"one of {SUFFIXES}"}
_SAME_PLACE_MM = 1e-6  # rounding of written coordinates


@dataclass(frozen=True)
class Columns:
    """The columns of one table: ``first`` and ``second`` are real and imaginary part, or polar.

    ``sd`` is empty without one; ``ignored`` are not read.
    """

    first: str
    second: str
    unit: Unit
    sd: str
    names: frozenset[str]
    ignored: tuple[str, ...]


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
        found.append(_columns_of(header, file))
        return set(found[0].names) - set(TEXTS), set(found[0].names) & set(TEXTS)

    table = read_table(Path(path), choose)
    columns, faults = found[0], list(table.faults)
    usable = _check_numbers(table, columns, faults)
    names = {name: _codes(table, name, faults) for name in TEXTS[:4] if name in columns.names}
    directions, beam = _directions(table, columns, faults)
    usable &= (names["body"] >= 0) & (names["point"] >= 0) & (beam >= 0)
    if POSITION[0] in columns.names:
        _check_positions(table, _numbered([names["body"], names["point"]])[0], faults)
    rows = np.flatnonzero(usable)
    if not len(rows):
        step = "Export it again"
        raise_all(faults or [Fault(table.file, "a table with rows of values", "none", "", step)])
    sweep, first = _numbered([*(codes[rows] for codes in names.values()), beam[rows]])
    first, freq = rows[first], table.numbers["freq_hz"][rows]
    check_filled(len(first), len(np.unique(freq)), len(rows), table.file)
    if np.any((np.diff(sweep) < 0) | ((np.diff(sweep) == 0) & (np.diff(freq) <= 0.0))):
        order = np.lexsort((freq, sweep))
        rows, sweep, freq = rows[order], sweep[order], freq[order]
    again = np.flatnonzero((np.diff(freq) <= SAME_LINE * freq[1:]) & (np.diff(sweep) == 0))
    want = "the only one of its run, body, point, direction and frequency"
    step = "Number repeats in a column repeat, or remove the row"
    for row, earlier in sorted(zip(rows[again + 1].tolist(), rows[again].tolist(), strict=True)):
        got = f"that of line {table.lines[earlier]}"
        faults.append(Fault("a row", want, got, table.where(row), step))
    raise_all(faults)
    channels = [_channel(table, columns, directions[beam[row]], row) for row in first.tolist()]
    one, other = table.numbers[columns.first][rows], table.numbers[columns.second][rows]
    polar, scale = columns.unit.part == "amp", columns.unit.scale
    value = from_polar(scale * one, other, np.pi / 180.0) if polar else from_parts(one, other, scale)
    extra: dict[str, Any] = {name: table.numbers[name][rows] for name in EXTRA if name in columns.names}
    if columns.sd and (unit := unit_of(columns.sd)):
        extra["sd"] = table.numbers[columns.sd][rows] * unit.scale
    edges = [0, *(np.flatnonzero(np.diff(sweep)) + 1).tolist(), len(sweep)]
    swept = [
        Row(channel, freq[a:b], value[a:b], **{name: part[a:b] for name, part in extra.items()})
        for channel, (a, b) in zip(channels, pairwise(edges), strict=True)
    ]
    recording = recording_of(table.file, swept, statement="as its columns say", amplitude_stated=True)
    return replace(recording, notices=(*recording.notices, *_notices(columns, recording)))


def _columns_of(header: Sequence[str], file: str) -> Columns:
    """Find the columns of a table by their names in lower case.

    Raises
    ------
    StapeskitError
        A column is missing, has an unknown unit, or contradicts another one.
    """
    place, faults = Place(file, "line", (1,)), list[Fault]()
    units = {name: unit for name in header if (unit := unit_of(name)) is not None}
    for name in header:
        match = _WITH_UNIT.fullmatch(name)
        if match and name not in units and name != _UNITS[match[1]]:
            thing, step = (
                f"the unit of column {name}",
                "Convert the values, and name their unit in the header",
            )
            faults.append(Fault(thing, _UNITS[match[1]], "an unknown one", place, step))
    direction = ("dir",) if "dir" in header or set(DIRECTION).isdisjoint(header) else DIRECTION
    positions = POSITION if any(name in header for name in POSITION) else ()
    wanted = ("body", "point", "freq_hz", *direction, *positions)
    if missing := [name for name in wanted if name not in header]:
        near = [f"{one[0]} for {name}" for name in header if (one := get_close_matches(name, missing, 1))]
        step = "Add the column, or correct its name in the header (points2dof --help lists the layouts)"
        step = f"Did you mean {', '.join(near)}?" if near else step
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    if "dir" in header and not set(DIRECTION).isdisjoint(header):
        faults.append(Fault("the direction", "given once", "dir and dir_x ...", place, "Remove one"))
    values = sorted((unit.part, name) for name, unit in units.items() if unit.part != "sd")
    parts, found = [part for part, _ in values], [name for _, name in values]
    if parts == ["amp"] and "phase_deg" in header:
        first, second = found[0], "phase_deg"
    elif parts == ["im", "re"]:
        second, first = found
    else:
        want = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit), once"
        step = "Add the missing column, or remove the others"
        faults.append(Fault("the value", want, ", ".join(found) or "none of them", place, step))
        raise_all(faults)
    unit = units[first]
    if second in units and replace(units[second], part=unit.part) != unit:
        thing, got = "real and imaginary part", f"{first} and {second}"
        faults.append(Fault(thing, "in one unit", got, place, "Convert one of them"))
    spreads = [name for name, one in units.items() if one.part == "sd"]
    kinds = {(units[name].order, units[name].rms) for name in spreads} - {(unit.order, unit.rms)}
    if len(spreads) > 1 or kinds:
        want, step = f"one column sd_{first.split('_', 1)[1]}", "Convert it, or remove the others"
        faults.append(Fault("the standard deviation", want, ", ".join(spreads), place, step))
    raise_all(faults)
    used = frozenset([*wanted, first, second, *spreads, *({"run", "repeat", *EXTRA} & set(header))])
    ignored = tuple(name for name in header if name and name not in used)
    return Columns(first, second, unit, "".join(spreads), used, ignored)


def _codes(table: Table, name: str, faults: list[Fault]) -> Index:
    """Number the names of a text column, (rows,), -1 where a cell is empty.

    Names that a spreadsheet made of one are one. A run or repeat is named in every row or in none.
    """
    column = table.texts[name]
    plain = [plain_name(text) if name == "point" else text for text in column.names]
    first = {text: number for number, text in reversed([*enumerate(plain)])}
    codes = np.array([*(first[text] for text in plain), -1], dtype=np.intp)[column.codes]
    must = name in ("body", "point")
    if must or np.any(codes >= 0):
        want = "a name" if must else "given in every row, or in none"
        for row in np.flatnonzero(codes < 0).tolist():
            where = table.where(row, name)
            faults.append(Fault(name, want, "an empty cell", where, "Correct the cell"))
    return codes


def _check_numbers(table: Table, columns: Columns, faults: list[Fault]) -> NDArray[np.bool_]:
    """Report numbers that no row may hold; return which rows have a frequency."""
    empty = "Leave the cell empty where the value is missing"
    linear = "Give linear amplitudes: decibels are 10^(dB/20) times the reference"
    dc = "Give the frequency in Hz, or leave the row out (a DC line holds no motion)"
    polar = columns.unit.part == "amp"
    limits = {
        "freq_hz": (LOWEST_HZ, HIGHEST_HZ, dc),
        columns.first: (0.0 if polar else -LARGEST, LARGEST, linear if polar else empty),
        columns.second: (-LARGEST, LARGEST, empty),
        columns.sd: (0.0, LARGEST, empty),
        "n_avg": (1.0, LARGEST, empty),
        "coherence": (0.0, 1.0, empty),
    }
    for name, limit in limits.items():
        if name in table.numbers:
            faults += cell_faults(table, name, *limit, must=name == "freq_hz")
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
    for row in np.flatnonzero(~good & ~invalid).tolist():
        faults.append(Fault(thing, want, got[code[row]], table.where(row, thing), step))
    return units, np.where(good, code, -1)


def _check_positions(table: Table, place: Index, faults: list[Fault]) -> None:
    """Report positions that are empty or far away, and points with two; ``place`` numbers the points."""
    faults += position_faults(table, POSITION)
    xyz = np.column_stack([table.numbers[name] for name in POSITION])
    good = np.flatnonzero(np.all(np.isfinite(xyz), axis=1))
    first = np.zeros(int(place.max(initial=0)) + 1, dtype=np.intp)
    first[place[good][::-1]] = good[::-1]
    other = first[place]
    thing, step = "the position of a point", "Name the points differently, or correct the position"
    moved = np.any(np.abs(xyz - xyz[other]) > _SAME_PLACE_MM, axis=1)  # not so for NaN
    for row in np.flatnonzero(moved).tolist():
        got = f"{xyz[other[row]].tolist()} in line {table.lines[other[row]]} and {xyz[row].tolist()}"
        faults.append(Fault(thing, "one", got, table.where(row, thing), step))


def _channel(table: Table, columns: Columns, direction: Array, row: int) -> Channel:
    """Return the channel that a row is of."""
    position = unknown_vector()
    if POSITION[0] in columns.names:
        position = 1e-3 * np.array([table.numbers[name][row] for name in POSITION])
    body, point, run, repeat = (text_of(table, name, row) for name in TEXTS[:4])
    where, order = table.where(row), columns.unit.order
    return Channel(plain_name(point), body, run, repeat, order, "", position, direction, where)


def _notices(columns: Columns, recording: Recording) -> list[Notice]:
    """Report what is missing and what was not used."""
    notices, file = [], recording.file
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
        known = (*TEXTS, *POSITION, *DIRECTION, "freq_hz", *EXTRA)
        near = {name: get_close_matches(name, known, 1, 0.75) for name in columns.ignored}
        meant = (f"{name} (did you mean {one[0]}?)" if one else name for name, one in near.items())
        text = f"columns of {file} that are not used: {list_some(meant, 6)}."
        notices.append(Notice("file_read", text))
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

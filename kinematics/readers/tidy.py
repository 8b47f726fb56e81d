"""Read the tidy vibrometer table: one row per body, point, beam and frequency (docs/commands.md)."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import DECIBELS, from_parts, from_polar, recording_of
from kinematics.readers.lines import SAME_LINE, check_filled
from kinematics.readers.points import POSITION, cell_faults, position_faults, text_of
from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.units import MotionUnit
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ, SUFFIXES, Unit, unit_of
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from stapeskit.tables import Table

DIRECTION = ("dir_x", "dir_y", "dir_z")
NAMES = ("body", "point", "run", "repeat")
TEXTS = (*NAMES, "dir")
EXTRA = ("n_avg", "coherence")

_WITH_UNIT = re.compile(r"(?:re|im|amp|sd|(freq|phase))(?:_.*)?")
_UNITS = {"freq": "freq_hz", "phase": "phase_deg", None: f"one of {SUFFIXES}"}


@dataclass(frozen=True)
class Columns:
    """The columns of one table: ``pair`` are real and imaginary part, or amplitude and phase, in ``unit``.

    ``sd`` is empty without one; ``ignored`` are not read.
    """

    pair: Sequence[str]
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
        an sd that is negative or empty throughout. All faults are listed with line and column.
    """
    from stapeskit.tables import read_table

    found: list[Columns] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        found.append(_columns_of(header, file))
        return set(found[0].names) - set(TEXTS), set(found[0].names) & set(TEXTS)

    table = read_table(Path(path), choose)
    faults = [*table.faults, *_number_faults(table, found[0])]
    rows = _rows_of(table, found[0], faults) if len(table) else []
    raise_all(faults)
    recording = recording_of(table.file, rows, statement="as its columns say")
    notices = [*recording.notices, *_notices(found[0], recording)]
    if table.left_out:
        rows_out = Place(table.file, "line", table.left_out)
        notices.append(Notice("file_read", f"rows that begin with # were left out: {rows_out}."))
    return replace(recording, notices=tuple(notices))


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
            step = "Convert the values, and name their unit in the header"
            faults.append(
                Fault(f"the unit of column {name}", _UNITS[match[1]], "an unknown one", place, step)
            )
    direction = ("dir",) if "dir" in header or set(DIRECTION).isdisjoint(header) else DIRECTION
    positions = POSITION if any(name in header for name in POSITION) else ()
    wanted = ("body", "point", "freq_hz", *direction, *positions)
    if missing := [name for name in wanted if name not in header]:
        near = [f"{one[0]} for {name}" for name in header if (one := get_close_matches(name, missing, 1))]
        step = "Add the column, or correct its name in the header (points2dof --help lists the layouts)"
        step = f"Did you mean {', '.join(near)}?" if near else step
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    spreads = [name for name, unit in units.items() if unit.part == "sd"]
    values = sorted(set(units) - set(spreads), key=lambda name: units[name].part, reverse=True)
    pair = [*values, "phase_deg"] if [units[name].part for name in values] == ["amp"] else values
    if [units[name].part for name in values] not in (["re", "im"], ["amp"]) or not set(pair) <= set(header):
        want = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit), once"
        step = "Add the missing column, or remove the others"
        faults.append(Fault("the value", want, ", ".join(values) or "none of them", place, step))
    raise_all(faults)
    first = units[pair[0]]
    if len({replace(units[name], part="") for name in values}) > 1:
        got = " and ".join(pair)
        faults.append(Fault("real and imaginary part", "in one unit", got, place, "Convert one of them"))
    kinds = {(units[name].order, units[name].rms) for name in (pair[0], *spreads)}
    if len(spreads) > 1 or len(kinds) > 1:
        want, step = f"one column sd_{pair[0].split('_', 1)[1]}", "Convert it, or remove the others"
        faults.append(Fault("the standard deviation", want, ", ".join(spreads), place, step))
    raise_all(faults)
    used = frozenset([*wanted, *pair, *spreads, *({"run", "repeat", *EXTRA} & set(header))])
    ignored = tuple(name for name in header if name and name not in used)
    return Columns(pair, first, "".join(spreads), used, ignored)


def _number_faults(table: Table, columns: Columns) -> list[Fault]:
    """List the numbers that no row may hold."""
    empty = "Leave the cell empty where the value is missing"
    dc = "Give the frequency in Hz, or leave the row out (a DC line holds no motion)"
    polar = columns.unit.part == "amp"
    limits = {
        "freq_hz": (LOWEST_HZ, HIGHEST_HZ, dc),
        columns.pair[0]: (0.0 if polar else -LARGEST, LARGEST, DECIBELS if polar else empty),
        columns.pair[1]: (-LARGEST, LARGEST, empty),
        columns.sd: (0.0, LARGEST, empty),
        "n_avg": (1.0, LARGEST, empty),
        "coherence": (0.0, 1.0, empty),
        **dict.fromkeys(DIRECTION, (-LARGEST, LARGEST, "Divide the direction by its length")),
    }
    faults = position_faults(table, POSITION) if POSITION[0] in table.numbers else []
    for name, limit in limits.items():
        if name in table.numbers:
            faults += cell_faults(table, name, *limit, must=name in ("freq_hz", *DIRECTION))
    if columns.sd and len(table) and np.all(np.isnan(table.numbers[columns.sd])):
        step = "Leave the column out to have the noise estimated from the residuals"
        want, where = "a number in at least one row", Place(table.file, detail=columns.sd)
        faults.append(Fault(columns.sd, want, "NaN or empty cells throughout", where, step))
    return faults


def _rows_of(table: Table, columns: Columns, faults: list[Fault]) -> list[Row]:
    """Return a row for every body, point, run, repeat, direction and position; each has its own lines."""
    numbers = table.numbers
    keys: list[NDArray[Any]] = [column.codes for column in table.texts.values()]
    keys += [numbers[name] for name in DIRECTION if name in numbers]
    keys += [np.round(numbers[name], 6) for name in POSITION if name in numbers]  # digits of spreadsheets
    group, first = _numbered(keys)
    check_filled(len(first), len(np.unique(numbers["freq_hz"])), len(table), table.file)
    order = np.lexsort((numbers["freq_hz"], group))
    freq, sorted_group = numbers["freq_hz"][order], group[order]
    again = np.flatnonzero((np.diff(freq) <= SAME_LINE * freq[1:]) & (np.diff(sorted_group) == 0))
    want = "the only one of its run, body, point, direction and frequency"
    step = "Number repeats in a column repeat, or remove the row"
    for line, earlier in zip(order[again + 1].tolist(), order[again].tolist(), strict=True):
        got = f"that of line {table.lines[earlier]}"
        faults.append(Fault("a row", want, got, table.where(line), step))
    order = np.argsort(group, kind="stable")  # the lines of a row stay in the order of the file
    freq, group = numbers["freq_hz"][order], group[order]
    one, other = (numbers[name][order] for name in columns.pair)
    value = from_polar(one, other, np.pi / 180.0) if columns.unit.part == "amp" else from_parts(one, other)
    noise = {"sd": columns.sd, **{name: name for name in EXTRA}}
    known = {name: numbers[column][order] for name, column in noise.items() if column in numbers}
    if columns.sd and (stated := unit_of(columns.sd)):
        known["sd"] = known["sd"] * (stated.scale / columns.unit.scale)
    unit = MotionUnit(columns.unit.order, columns.unit.scale, amplitude="peak")
    named = [name for name in ("run", "repeat") if name in table.texts and table.texts[name].names]
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)]
    rows = []
    for line, (a, b) in zip(first.tolist(), pairwise(edges), strict=True):
        given: dict[str, Any] = {name: text_of(table, name, line) for name in NAMES}
        places = table.lines[order[a:b]].tolist()
        for name in ("body", "point", *named):
            if not given[name]:
                want = "a name" if name in ("body", "point") else "given in every row, or in none"
                where = Place(table.file, "line", tuple(places), name)
                faults.append(Fault(name, want, "an empty cell", where, "Correct the cell"))
        given |= {name: part[a:b] for name, part in known.items()} | {"point": plain_name(given["point"])}
        given["direction"] = _direction(table, line, places, faults)
        if POSITION[0] in numbers:
            given["position_m"] = 1e-3 * np.array([numbers[name][line] for name in POSITION])
        where = table.where(line)
        rows.append(Row(freq_hz=freq[a:b], value=value[a:b], unit=unit, where=where, **given))
    return rows


def _direction(table: Table, line: int, places: Sequence[int], faults: list[Fault]) -> Array:
    """Return the direction (3,) of the rows like one row, whose lines are given; NaN where it is at fault."""
    if "dir" in table.texts:
        text = text_of(table, "dir", line)
        axis, got = axis_vector(text), shown(text) or "an empty cell"
        thing, want, step = "dir", "x, y, z, -x, -y or -z", "Correct the cell"
    else:
        axis = np.array([table.numbers[name][line] for name in DIRECTION])
        if not np.all(np.abs(axis) < LARGEST):
            return unknown_vector()  # a fault of these cells
        length, got = float(np.linalg.norm(axis)), f"({', '.join(f'{part:g}' for part in axis)})"
        axis = axis / length if abs(length - 1.0) <= 1e-3 else None
        thing, want = ", ".join(DIRECTION), "a unit vector (within 1e-3)"
        step = "Divide the direction by its length"
    if axis is None:
        faults.append(Fault(thing, want, got, Place(table.file, "line", tuple(places), thing), step))
    return unknown_vector() if axis is None else axis


def _notices(columns: Columns, recording: Recording) -> list[Notice]:
    """Report what is missing and what was not used."""
    notices, file, rows = [], recording.file, recording.rows
    sweeps = defaultdict[object, list[Row]](list)
    for row in rows:
        sweeps[row.body, row.run, row.repeat].append(row)
    gaps, count = list[str](), 0
    for together in sweeps.values():  # lines that a whole sweep lacks are no gaps in it
        missing = np.isnan([row.value for row in together])
        missing &= ~np.all(missing, axis=0)
        count += int(np.sum(missing))
        gaps += [row.name for row, own in zip(together, missing, strict=True) if np.any(own)]
    if gaps:
        text = (
            f"{count} readings of {len(gaps)} channels ({list_some(gaps, 6)}) have no row or no value in "
            f"{file} at lines that other channels of the body have: they count as missing."
        )
        notices.append(Notice("file_read", text))
    exact = sum(int(np.sum(np.asarray(row.sd) == 0.0)) for row in rows if row.sd is not None)
    if exact:
        text = f"{exact} values of {file} have a noise of 0: they are exact to 1e-12 of the largest."
        notices.append(Notice("noise_level", text))
    bodies = dict.fromkeys(row.body for row in rows)
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


def _numbered(keys: Sequence[NDArray[Any]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Number equal rows of several columns in the order of appearance; return also their first rows.

    Rows that follow each other are mostly alike: one of each such block is looked at.
    """
    changed = np.any([np.diff(key) != 0 for key in keys], axis=0)
    starts = np.concatenate([[0], np.flatnonzero(changed) + 1])
    numbers: dict[tuple[float, ...], int] = {}
    blocks = zip(*(key[starts].tolist() for key in keys), strict=True)
    of_block = np.array([numbers.setdefault(block, len(numbers)) for block in blocks])
    first = starts[np.unique(of_block, return_index=True)[1]]
    return np.repeat(of_block, np.diff([*starts, len(keys[0])])), first

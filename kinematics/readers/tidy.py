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

from kinematics.readers.in_si import DECIBELS
from kinematics.readers.points import POSITION, cell_faults, text_of
from kinematics.readers.recording import Recording, Row, from_parts, from_polar, unknown_vector
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.text import plain_name, shown
from kinematics.readers.units import MotionUnit
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ, SUFFIXES, Unit, unit_of
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
        A column is missing or has an unknown unit. What is wrong with rows is with the recording: text where
        a number belongs, a frequency that is not positive, no name or direction, an sd that is empty
        throughout.
    """
    from stapeskit.tables import read_table

    found: list[Columns] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        found.append(_columns_of(header, file))
        return set(found[0].names) - set(TEXTS), set(found[0].names) & set(TEXTS)

    table = read_table(Path(path), choose)
    faults = [*table.faults, *_number_faults(table, found[0])]
    rows = _rows_of(table, found[0], faults)
    notices = _notices(table, found[0].ignored)
    return Recording(table.file, tuple(rows), notices, "as its columns say", faults=tuple(faults))


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
            step, thing = (
                "Convert the values, and name their unit in the header",
                f"the unit of column {name}",
            )
            faults.append(Fault(thing, _UNITS[match[1]], "an unknown one", place, step))
    direction = ("dir",) if "dir" in header or set(DIRECTION).isdisjoint(header) else DIRECTION
    positions = POSITION if any(name in header for name in POSITION) else ()
    wanted = ("body", "point", "freq_hz", *direction, *positions)
    if missing := [name for name in wanted if name not in header]:
        near = [f"{one[0]} for {name}" for name in header if (one := get_close_matches(name, missing, 1))]
        step = "Add the column, or correct its name in the header (points2dof --help lists the layouts)"
        step = f"Did you mean {', '.join(near)}?" if near else step
        step = step if len(header) > 1 else "Separate the columns by commas, semicolons or tabs"
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    spreads = [name for name, unit in units.items() if unit.part == "sd"]
    values = sorted(set(units) - set(spreads), key=lambda name: units[name].part, reverse=True)
    pair = [*values, "phase_deg"] if [units[name].part for name in values] == ["amp"] else values
    if [units[name].part for name in values] not in (["re", "im"], ["amp"]) or not set(pair) <= set(header):
        want = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit), once"
        step = "Add the missing column, or remove the others"
        faults.append(Fault("the value", want, ", ".join(values) or "none of them", place, step))
    if "dir" in header and (both := [name for name in DIRECTION if name in header]):
        got = f"dir and {', '.join(both)}"
        faults.append(Fault("the direction", "in one way", got, place, "Remove dir, or the others"))
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
    return Columns(pair, first, "".join(spreads), used, tuple(one for one in header if one not in used))


def _number_faults(table: Table, columns: Columns) -> list[Fault]:
    """List what no row of this table may hold; what no format may hold is found later."""
    dc = "Give the frequency in Hz, or leave the row out (a DC line holds no motion)"
    faults = cell_faults(table, "freq_hz", LOWEST_HZ, HIGHEST_HZ, dc, must=True)
    for name in (name for name in POSITION if name in table.numbers):
        step = "Give the number in mm, or leave the row out"
        faults += cell_faults(table, name, -FARTHEST_MM, FARTHEST_MM, step, must=True)
    if columns.unit.part == "amp":
        faults += cell_faults(table, columns.pair[0], 0.0, LARGEST, DECIBELS)
    for name in (name for name in DIRECTION if name in table.numbers):
        faults += cell_faults(table, name, -LARGEST, LARGEST, "Divide the direction by its length", must=True)
    if columns.sd and len(table) and np.all(np.isnan(table.numbers[columns.sd])):
        step = "Leave the column out to have the noise estimated from the residuals"
        want, where = "a number in at least one row", Place(table.file, detail=columns.sd)
        faults.append(Fault(columns.sd, want, "NaN or empty cells throughout", where, step))
    return faults


def _rows_of(table: Table, columns: Columns, faults: list[Fault]) -> list[Row]:
    """Return a row for every body, point, run, repeat, direction and position; each has its own lines.

    Lines with faults in their cells are left out.
    """
    if not len(table):
        return []
    numbers = table.numbers
    keys: list[NDArray[Any]] = [column.codes for column in table.texts.values()]
    keys += [numbers[name] for name in DIRECTION if name in numbers]
    keys += [np.round(numbers[name], 6) for name in POSITION if name in numbers]  # digits of spreadsheets
    group, first = _numbered(keys)
    order = np.argsort(group, kind="stable")  # the lines of a row stay in the order of the file
    group, freq, places = group[order], numbers["freq_hz"][order], table.lines[order]
    one, other = (numbers[name][order] for name in columns.pair)
    value = from_polar(one, other, np.pi / 180.0) if columns.unit.part == "amp" else from_parts(one, other)
    noise = {"sd": columns.sd, **{name: name for name in EXTRA}}
    known = {name: numbers[column][order] for name, column in noise.items() if column in numbers}
    if columns.sd and (stated := unit_of(columns.sd)):
        known["sd"] = known["sd"] * (stated.scale / columns.unit.scale)
    unit = MotionUnit(columns.unit.order, columns.unit.scale, amplitude="peak")
    sound = (freq > 0.0) & ~table.invalid_rows()[order]
    named = [name for name in ("run", "repeat") if name in table.texts and table.texts[name].names]
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)]
    rows = []
    for line, (a, b) in zip(first.tolist(), pairwise(edges), strict=True):
        given: dict[str, Any] = {name: text_of(table, name, line) for name in NAMES}
        where = Place(table.file, "line", tuple(places[a:b].tolist()))
        for name in ("body", "point", *named):
            if not given[name]:
                want = "a name" if name in ("body", "point") else "given in every row, or in none"
                at = replace(where, detail=name)
                faults.append(Fault(name, want, "an empty cell", at, "Correct the cell"))
        given |= {"point": plain_name(given["point"]), "direction": _direction(table, line, where, faults)}
        if POSITION[0] in numbers:
            given["position_m"] = 1e-3 * np.array([numbers[name][line] for name in POSITION])
        lines = slice(a, b) if np.all(sound[a:b]) else a + np.flatnonzero(sound[a:b])
        given |= {name: part[lines] for name, part in known.items()} | {"lines": places[lines]}
        if np.any(sound[a:b]):
            given |= {"source": " or ".join(columns.pair), "where": table.where(line)}
            rows.append(Row(freq_hz=freq[lines], value=value[lines], unit=unit, **given))
    return rows


def _direction(table: Table, line: int, where: Place, faults: list[Fault]) -> Array:
    """Return the direction (3,) of the rows like one row; its length is checked later."""
    if "dir" not in table.texts:
        return np.array([table.numbers[name][line] for name in DIRECTION])
    text = text_of(table, "dir", line)
    axis = axis_vector(text)
    if axis is None:
        want, got = "x, y, z, -x, -y or -z", shown(text) or "an empty cell"
        faults.append(Fault("dir", want, got, replace(where, detail="dir"), "Correct the cell"))
    return unknown_vector() if axis is None else axis


def _notices(table: Table, ignored: Sequence[str]) -> tuple[Notice, ...]:
    """Report columns and rows that are not read."""
    known = (*TEXTS, *POSITION, *DIRECTION, "freq_hz", *EXTRA)
    near = {name: get_close_matches(name, known, 1, 0.75) for name in ignored if name}
    meant = [f"{name} (did you mean {one[0]}?)" if one else name for name, one in near.items()]
    texts = [f"columns of {table.file} that are not used: {list_some(meant, 6)}."] if meant else []
    if table.left_out:
        texts.append(f"rows that begin with # were left out: {Place(table.file, 'line', table.left_out)}.")
    return tuple(Notice("file_read", text) for text in texts)


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

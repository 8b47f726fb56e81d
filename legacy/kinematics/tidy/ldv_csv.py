"""Read the tidy vibrometer table: one row per body, point, beam and frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.tidy.few_averages import steady_noise
from legacy.kinematics.tidy.ldv_columns import Columns, columns_of, ignored_notice
from legacy.kinematics.tidy.ldv_rows import Rows, rows_of
from legacy.kinematics.tidy.noise_from_coherence import sd_from_coherence
from legacy.kinematics.tidy.points_csv import read_points
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, StapeskitError, list_some, raise_all
from legacy.stapeskit.tables.csv_table import Table, read_table
from legacy.stapeskit.warnings import Notice

Index = NDArray[np.intp]


def read_ldv(path: Path, points: Path | None = None, frame: str = "vibrometer") -> Measurement:
    """Read a vibrometer table.

    Parameters
    ----------
    path : Path
        CSV with a header; units by the suffix of the columns.
    points : Path, optional
        CSV with the positions: body, point, x_mm, y_mm, z_mm [, sd_mm].
    frame : str
        The frame in which positions and directions are given.

    Raises
    ------
    KinematicsError
        The file is missing or of another kind; a column is missing or has an unknown unit; or rows are
        faulty: text where a number belongs, an infinite value, a frequency that is not positive, a
        direction that is no unit vector, a duplicate row, a point with two positions or with none, an sd
        that is negative or empty throughout. All faults of the file are listed with line and column.
    """
    path = Path(path)
    _check_kind(path)
    column_sets: list[Columns] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        column_sets.append(columns_of(header, file, points is not None))
        return column_sets[0].numbers, column_sets[0].texts

    others: list[Fault] = []
    listed = None
    if points is not None:
        try:
            listed = read_points(points)
        except StapeskitError as fault:
            others = list(fault.faults)
    try:
        table = read_table(path, choose)
    except StapeskitError as fault:
        raise_all(KinematicsError, [*fault.faults, *others])
        raise
    columns = column_sets[0]
    rows = rows_of(table, columns, listed, others)
    measurement = _assemble(rows, columns, table, frame)
    notices = [*rows.notices, *ignored_notice(columns, table.file), *measurement.notices]
    if table.comments:
        text = f"{table.comments} lines of {table.file} begin with # and were passed over as comments."
        notices.append(Notice("comments_skipped", text))
    inputs = {"ldv": path} if points is None else {"ldv": path, "points": Path(points)}
    return replace(measurement, inputs=inputs, notices=tuple(notices))


def _check_kind(path: Path) -> None:
    if path.is_dir() or (path.exists() and path.suffix.lower() not in (".csv", ".txt", ".tsv")):
        step = "Export the spectra as a tidy CSV table (see points2dof --help)"
        raise KinematicsError.of(
            "the vibrometer file",
            "a CSV table (.csv, .tsv or .txt), which is what is read now",
            path.name,
            next_step=step,
        )


def _assemble(rows: Rows, columns: Columns, table: Table, frame: str) -> Measurement:
    lines = len(rows.freq_hz)
    shape = (len(rows.runs), len(rows.body), lines)
    at = (rows.take * shape[1] + rows.channel) * lines + rows.line
    value = np.full(np.prod(shape), np.nan + 1j * np.nan)
    value[at] = _complex(table, columns)
    rate = (2j * np.pi * rows.freq_hz) ** columns.unit.order
    value = value.reshape(shape) / rate
    sd, relative, counts = _noise(table, columns, at, value, np.abs(rate))
    notices = [
        *_missing_row_notices(rows, table, at, shape),
        *_empty_value_notices(rows, table, columns),
        *_in_text_order(rows, table),
    ]
    if columns.sd and sd is not None and np.any(np.isnan(sd) & ~np.isnan(value)):
        count = int(np.sum(np.isnan(sd) & ~np.isnan(value)))
        notices.append(Notice("sd_missing", f"{count} values have no {columns.sd} and were not used."))
    exact = 0 if sd is None else int(np.sum(sd == 0.0))
    if exact:
        text = (
            f"{exact} values have a noise of 0 and were taken to be exact to 1e-12 of the largest amplitude."
        )
        notices.append(Notice("sd_zero", text))
    bodies = []
    for number, name in enumerate(table.texts["body"].names):
        mine = np.flatnonzero(rows.body == number)
        if mine.size == 0:
            continue
        points = tuple(table.texts["point"].names[place] for place in rows.point[mine])
        own = None if sd is None else sd[:, mine]
        if own is not None and counts is not None:
            own, steady_notices = steady_noise(own, counts[:, mine], name, from_coherence=not columns.sd)
            notices += steady_notices
        bodies.append(
            BodyChannels(
                name,
                points,
                rows.positions_mm[mine],
                rows.directions[mine],
                value[:, mine],
                own,
                relative,
                rows.position_sd_mm[mine],
            )
        )
    return Measurement(
        frame,
        rows.runs,
        rows.freq_hz,
        tuple(bodies),
        columns.unit.order,
        notices=tuple(notices),
        takes=rows.takes,
    )


def _missing_row_notices(rows: Rows, table: Table, at: Index, shape: tuple[int, int, int]) -> list[Notice]:
    """Report channels without rows at lines that other channels of their body have in the same run."""
    if len(at) == np.prod(shape):
        return []
    present = np.zeros(shape, dtype=bool)
    present.ravel()[at] = True
    lost = np.zeros(shape, dtype=bool)
    for number in np.unique(rows.body):
        mine = rows.body == number
        known = np.any(present[:, mine], axis=1, keepdims=True)
        begun = np.any(present[:, mine], axis=2, keepdims=True)
        lost[:, mine] = known & begun & ~present[:, mine]
    count = int(np.count_nonzero(lost))
    if not count:
        return []
    channels = np.flatnonzero(np.any(lost, axis=(0, 2)))
    body, point = table.texts["body"].names, table.texts["point"].names
    names = list_some((f"{body[rows.body[c]]} {point[rows.point[c]]}" for c in channels), 6)
    of_last = lost[rows.take[-1], rows.channel[-1]]
    cut = bool(np.any(of_last[rows.line[-1] + 1 :]))
    text = (
        f"{count} readings of {len(channels)} channels ({names}) have no row in {table.file} at lines that "
        "other channels of the body have; they count as missing."
    )
    end = " The last row is in the middle of a sweep: was the file cut off?" if cut else ""
    return [Notice("rows_missing", text + end)]


def _empty_value_notices(rows: Rows, table: Table, columns: Columns) -> list[Notice]:
    """Report rows without a value, and rows with one of its two numbers."""
    first, second = (np.isnan(table.numbers[name]) for name in (columns.first, columns.second))
    body, point = table.texts["body"].names, table.texts["point"].names

    def rows_with(where: NDArray[np.bool_], what: str) -> str:
        channels = np.unique(rows.channel[where])
        names = list_some((f"{body[rows.body[c]]} {point[rows.point[c]]}" for c in channels), 6)
        return f"{int(np.sum(where))} rows of {table.file} ({names}) have {what}; they count as missing."

    notices = []
    if np.any(empty := first & second):
        notices.append(Notice("values_missing", rows_with(empty, "no value")))
    if np.any(half := first ^ second):
        only = f"one of {columns.first} and {columns.second} only"
        notices.append(Notice("values_incomplete", rows_with(half, only)))
    return notices


def _in_text_order(rows: Rows, table: Table) -> list[Notice]:
    """Report bodies whose rows are in the order of text ("1000, 200") where another's are in that of numbers.

    A column that was sorted alone looks so, and rows that were sorted whole.
    """
    sweep = rows.take * len(rows.body) + rows.channel
    falls = (np.diff(rows.line) < 0) & (np.diff(sweep) == 0)
    mixed = np.unique(rows.body[rows.channel[1:][falls]])
    if len(mixed) in (0, len(np.unique(rows.body))):
        return []
    body = rows.body[rows.channel]
    words = np.array([f"{value:.12g}" for value in rows.freq_hz])
    names, notices = table.texts["body"].names, []
    for number in mixed:
        first = sweep[np.argmax(body == number)]
        lines = words[rows.line[sweep == first]]
        if np.array_equal(lines, np.sort(lines)):
            text = (
                f"the rows of {names[number]} in {table.file} are in the order of text "
                f"({', '.join(lines[:3])}, ...), those of other bodies in that of numbers. If freq_hz was "
                "sorted without the other columns, the values belong to other frequencies; rows that were "
                "sorted whole are read correctly."
            )
            notices.append(Notice("text_order", text))
    return notices


def _complex(table: Table, columns: Columns) -> NDArray[np.complex128]:
    first, second = table.numbers[columns.first], table.numbers[columns.second]
    if columns.polar:
        value = first * np.exp(1j * np.deg2rad(second))
    else:
        value = np.empty(len(first), dtype=complex)
        value.real, value.imag = first, second
    value *= columns.unit.scale
    return np.asarray(value)


def _noise(
    table: Table, columns: Columns, at: Index, value: NDArray[np.complex128], rate: Array
) -> tuple[Array | None, bool, Array | None]:
    """Return the sd of each value as displacement (m), whether it is relative only, and its averages."""

    def spread(column: Array) -> Array:
        full = np.full(value.size, np.nan)
        full[at] = column
        return full.reshape(value.shape)

    counts = spread(table.numbers["n_avg"]) if "n_avg" in columns.extra else None
    if columns.sd:
        return spread(table.numbers[columns.sd] * columns.sd_scale) / rate, False, counts
    if "coherence" in columns.extra:
        coherence = spread(table.numbers["coherence"])
        return sd_from_coherence(value, coherence, 1.0 if counts is None else counts), counts is None, counts
    if counts is not None:
        return 1.0 / np.sqrt(counts) / rate, True, None
    return None, True, None

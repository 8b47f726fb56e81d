"""Read the tidy vibrometer table: one row per body, point, beam and frequency (docs/commands.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.lines import SAME_LINE, check_filled
from kinematics.readers.points import POSITION, position_faults
from kinematics.readers.recording import (
    Channel,
    Recording,
    Row,
    from_parts,
    from_polar,
    recording_of,
    unknown_vector,
)
from kinematics.readers.text import plain_name, shown
from kinematics.readers.tidy_columns import DIRECTION, EXTRA, TEXTS, Columns, columns_of, with_meant
from stapeskit.arrays import Array
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
    return _Rows(table, found[0], list(table.faults)).recording()


@dataclass
class _Rows:
    """The rows of a table while they are checked and given their places."""

    table: Table
    columns: Columns
    faults: list[Fault] = field(default_factory=list)

    def recording(self) -> Recording:
        """Check all rows and gather those of one body, point, beam, run and repeat to one channel."""
        file, numbers = self.table.file, self.table.numbers
        usable = self._check_numbers()
        texts = {name: self._named(name) for name in TEXTS[:4] if name in self.columns.names}
        for name, (codes, _) in texts.items():
            must = name in ("body", "point")
            if must or np.any(codes >= 0):
                want = "a name" if must else "given in every row, or in none"
                self._report(codes < 0, name, want, "an empty cell")
        usable &= (texts["body"][0] >= 0) & (texts["point"][0] >= 0)
        directions, beam = self._directions()
        usable &= beam >= 0
        self._check_positions(_numbered([texts["body"][0], texts["point"][0]])[0])
        rows = np.flatnonzero(usable)
        if not len(rows):
            want, step = "a table with rows of values", "Export it again"
            raise_all(self.faults or [Fault(file, want, "none", "", step)])
        sweep, first = _numbered([*(codes[rows] for codes, _ in texts.values()), beam[rows]])
        freq = numbers["freq_hz"][rows]
        check_filled(len(first), len(np.unique(freq)), len(rows), file)
        channels = [self._channel(row, texts, directions[beam[row]]) for row in rows[first].tolist()]
        if np.any((np.diff(sweep) < 0) | ((np.diff(sweep) == 0) & (np.diff(freq) <= 0.0))):
            order = np.lexsort((freq, sweep))
            rows, sweep, freq = rows[order], sweep[order], freq[order]
        again = np.flatnonzero((np.diff(freq) <= SAME_LINE * freq[1:]) & (np.diff(sweep) == 0))
        for place in again.tolist():
            want = "the only one of its run, body, point, direction and frequency"
            got, where = (
                f"that of line {self.table.lines[rows[place]]}",
                self.table.where(int(rows[place + 1])),
            )
            step = "Number repeats in a column repeat, or remove the row"
            self.faults.append(Fault("a row", want, got, where, step))
        raise_all(self.faults)
        columns = self.columns
        first_part, second = numbers[columns.first][rows], numbers[columns.second][rows]
        value = (
            from_polar(columns.unit.scale * first_part, second, np.pi / 180.0)
            if columns.polar
            else from_parts(first_part, second, columns.unit.scale)
        )
        extra = {name: numbers[name][rows] for name in EXTRA if name in columns.names}
        if columns.sd:
            extra["sd"] = numbers[columns.sd][rows] * columns.sd_scale
        edges = [0, *(np.flatnonzero(np.diff(sweep)) + 1).tolist(), len(sweep)]
        recording = recording_of(
            file,
            [
                Row(channel, freq[a:b], value[a:b], **{name: part[a:b] for name, part in extra.items()})
                for channel, (a, b) in zip(channels, pairwise(edges), strict=True)
            ],
            statement="as its columns say",
            amplitude_stated=True,
        )
        return replace(recording, notices=(*recording.notices, *self._notices(recording)))

    def _report(
        self,
        bad: Mask,
        column: str,
        want: str,
        got: str | Callable[[int], str],
        step: str = "Correct the cell",
    ) -> None:
        """Add one fault for each bad row."""
        for row in np.flatnonzero(bad).tolist():
            value = got if isinstance(got, str) else got(row)
            self.faults.append(Fault(column, want, value, self.table.where(row, column), step))

    def _named(self, name: str) -> tuple[Index, tuple[str, ...]]:
        """Return codes (rows,) and names of a text column; names that a spreadsheet made of one are one."""
        column = self.table.texts[name]
        plain = [plain_name(text) if name == "point" else text for text in column.names]
        place = {text: number for number, text in enumerate(dict.fromkeys(plain))}
        return np.array([*(place[text] for text in plain), -1], dtype=np.intp)[column.codes], tuple(place)

    def _check_numbers(self) -> Mask:
        """Report numbers that no row may hold; return which rows have a frequency."""
        numbers, columns = self.table.numbers, self.columns
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
            if name in numbers:
                cells = numbers[name]
                missing = np.isnan(cells) & ~self.table.invalid_rows(name)
                bad = (cells < low) | (cells > high) | (missing & (name == "freq_hz"))
                want = f"from {low:g} to {high:g}"
                self._report(bad, name, want, partial(_cell, cells), step)
        if columns.sd and len(self.table) and np.all(np.isnan(numbers[columns.sd])):
            step = "Leave the column out to have the noise estimated from the residuals"
            want, where = "a number in at least one row", Place(self.table.file, detail=columns.sd)
            self.faults.append(Fault(columns.sd, want, "NaN or empty cells throughout", where, step))
        freq = numbers["freq_hz"]
        return np.asarray((freq >= LOWEST_HZ) & (freq <= HIGHEST_HZ))

    def _directions(self) -> tuple[Array, Index]:
        """Return the different unit directions (n, 3) and which of them each row (rows,) has, -1 for none."""
        if "dir" in self.columns.names:
            column = self.table.texts["dir"]
            vectors = np.array([*map(_axis, column.names), unknown_vector()])
            code, invalid = column.codes, np.zeros(len(column.codes), dtype=bool)
            names, want, step = "dir", "x, y, z, -x, -y or -z", "Correct the cell"
            got = [*map(shown, column.names), "an empty cell"]
        else:
            parts = [self.table.numbers[name] for name in DIRECTION]
            code, first = _numbered(parts)
            vectors = np.column_stack(parts)[first]
            invalid = np.any([self.table.invalid_rows(name) for name in DIRECTION], axis=0)
            names, want = ", ".join(DIRECTION), "a unit vector (within 1e-3)"
            step = "Divide the direction by its length"
            got = [f"({', '.join(f'{part:g}' for part in vector)})" for vector in vectors]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            length = np.linalg.norm(vectors, axis=1)
            units = vectors / length[:, None]
        good = (np.abs(length - 1.0) <= 1e-3)[code]
        self._report(~good & ~invalid, names, want, lambda row: got[code[row]], step)
        return units, np.where(good, code, -1)

    def _check_positions(self, place: Index) -> None:
        """Report positions that are empty or far away, and points with two; ``place`` numbers the points."""
        if POSITION[0] not in self.columns.names:
            return
        self.faults += position_faults(self.table, POSITION)
        rows = np.column_stack([self.table.numbers[name] for name in POSITION])
        good = np.flatnonzero(np.all(np.isfinite(rows), axis=1))
        first = np.zeros(int(place.max(initial=0)) + 1, dtype=np.intp)
        first[place[good][::-1]] = good[::-1]
        moved = np.any(np.abs(rows[good] - rows[first[place[good]]]) > _SAME_PLACE_MM, axis=1)
        for row in good[moved].tolist():
            other = int(first[place[row]])
            got = f"{rows[other].tolist()} in line {self.table.lines[other]} and {rows[row].tolist()}"
            where = self.table.where(row, ", ".join(POSITION))
            step = "Name the points differently, or correct the position"
            self.faults.append(Fault("the position of a point", "one", got, where, step))

    def _channel(
        self, row: int, texts: dict[str, tuple[Index, tuple[str, ...]]], direction: Array
    ) -> Channel:
        names = {name: (*known, "")[codes[row]] for name, (codes, known) in texts.items()}
        position = unknown_vector()
        if POSITION[0] in self.columns.names:
            position = 1e-3 * np.array([self.table.numbers[name][row] for name in POSITION])
        where, order = self.table.where(row), self.columns.unit.order
        return Channel(**names, order=order, position_m=position, direction=direction, where=where)

    def _notices(self, recording: Recording) -> list[Notice]:
        """Report what is missing and what was not used."""
        notices, file = [], self.table.file
        missing = np.isnan(recording.value)
        sweeps = [(channel.body, channel.run, channel.repeat) for channel in recording.channels]
        for key in dict.fromkeys(sweeps):  # lines that a whole sweep lacks are no gaps in it
            mine = [number for number, other in enumerate(sweeps) if other == key]
            missing[mine] &= ~np.all(missing[mine], axis=0)
        if np.any(missing):
            gaps = [recording.channels[k].name for k in np.flatnonzero(np.any(missing, axis=1)).tolist()]
            text = (
                f"{int(np.sum(missing))} readings of {len(gaps)} channels ({list_some(gaps, 6)}) have no row "
                f"or no value in {file} at lines that other channels of the body have: they count as missing."
            )
            notices.append(Notice("values_missing", text))
        exact = 0 if recording.sd is None else int(np.sum(recording.sd == 0.0))
        if exact:
            text = f"{exact} values of {file} have a noise of 0: they are exact to 1e-12 of the largest."
            notices.append(Notice("sd_zero", text))
        bodies = dict.fromkeys(channel.body for channel in recording.channels)
        if len({body.lower() for body in bodies}) < len(bodies):
            text = f"bodies of {file} differ in case only and were taken as different: {', '.join(bodies)}."
            notices.append(Notice("names_alike", text))
        if self.columns.ignored:
            listed = list_some(map(with_meant, self.columns.ignored), 6)
            notices.append(Notice("content_ignored", f"columns of {file} that are not used: {listed}."))
        if self.table.comments:
            text = f"{self.table.comments} lines of {file} begin with # and were skipped."
            notices.append(Notice("content_ignored", text))
        return notices


def _cell(cells: Array, row: int) -> str:
    return "an empty or NaN cell" if np.isnan(cells[row]) else f"{cells[row]:g}"


def _axis(name: str) -> Array:
    axis = axis_vector(name)
    return unknown_vector() if axis is None else axis


def _numbered(keys: Sequence[Array | Index]) -> tuple[Index, Index]:
    """Number equal rows of several columns in the order of appearance; return also their first rows."""
    import pandas as pd

    codes = np.zeros(len(keys[0]), dtype=np.int64)
    for key in keys:
        own = pd.factorize(key, use_na_sentinel=False)[0]
        codes = pd.factorize(codes * (int(own.max(initial=0)) + 1) + own)[0]
    first = np.full(int(codes.max(initial=-1)) + 1, len(codes), dtype=np.intp)
    first[codes[::-1]] = np.arange(len(codes))[::-1]
    return np.asarray(codes, dtype=np.intp), first

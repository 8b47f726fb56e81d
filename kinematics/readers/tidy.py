"""Read the tidy vibrometer table: one row per body, point, beam and frequency (docs/commands.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.lines import check_filled, common_grid
from kinematics.readers.points import POSITION, position_faults
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.tidy_columns import DIRECTION, EXTRA, Columns, columns_of, with_meant
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
    columns = found[0]
    return _Rows(table, columns).recording()


@dataclass
class _Rows:
    """The rows of a table while they are checked and given their places."""

    table: Table
    columns: Columns
    faults: list[Fault] = field(default_factory=list)

    def recording(self) -> Recording:
        """Check all rows and gather those of one body, point, beam, run and repeat to one channel."""
        self.faults += self.table.faults
        if not len(self.table):
            raise_all(
                self.faults or [Fault(self.table.file, "a table with rows", "none", "", "Export it again")]
            )
        numbers = self.table.numbers
        usable = self._check_numbers()
        texts: dict[str, tuple[Index, tuple[str, ...]]] = {
            name: self._named(name)
            for name in ("body", "point", "run", "repeat")
            if name in self.columns.names
        }
        for name in ("body", "point"):
            self._report(texts[name][0] < 0, name, "a name", "an empty cell")
            usable &= texts[name][0] >= 0
        for name in ("run", "repeat"):
            empty = texts[name][0] < 0 if name in texts else np.zeros(1, dtype=bool)
            if np.any(empty) and not np.all(empty):
                self._report(empty, name, "given in every row, or in none", "an empty cell")
        directions, beam = self._directions()
        usable &= beam >= 0
        parts = [texts[name][0] for name in texts]
        self._check_positions(_numbered(parts[:2])[0])
        rows = np.flatnonzero(usable)
        if not len(rows):
            step = "Export it again"
            raise_all(self.faults or [Fault(self.table.file, "a table with values", "empty rows", "", step)])
        sweep, first = _numbered([part[rows] for part in (*parts, beam)])
        freq = numbers["freq_hz"][rows]
        check_filled(len(first), len(np.unique(freq)), len(rows), self.table.file)
        if not np.all((np.diff(sweep) > 0) | ((np.diff(sweep) == 0) & (np.diff(freq) > 0.0))):
            order = np.lexsort((freq, sweep))
            rows, sweep, freq = rows[order], sweep[order], freq[order]
        grid, line, notices = self._lines(sweep, freq, rows)
        raise_all(self.faults)
        shape = (len(first), len(grid))
        at = sweep * len(grid) + line
        channels = tuple(
            self._channel(row, texts, directions[beam[row]]) for row in np.flatnonzero(usable)[first]
        )
        own = self._values()[rows]
        value = np.empty(shape, dtype=complex)
        value.real, value.imag = _spread(own.real, at, shape), _spread(own.imag, at, shape)
        matrices: dict[str, Array] = {
            name: _spread(numbers[name][rows], at, shape) for name in EXTRA if name in self.columns.names
        }
        if self.columns.sd:
            matrices["sd"] = _spread(numbers[self.columns.sd][rows] * self.columns.sd_scale, at, shape)
        notices += self._notices(value, matrices.get("sd"), shape, at, channels)
        return Recording(
            self.table.file,
            grid,
            value,
            channels,
            notices=tuple(notices),
            statement="as its columns say",
            amplitude_stated=True,
            sd=matrices.get("sd"),
            coherence=matrices.get("coherence"),
            n_avg=matrices.get("n_avg"),
        )

    def _report(
        self,
        bad: Mask,
        column: str,
        expected: str,
        got: str | Callable[[int], str],
        step: str = "Correct the cell",
    ) -> None:
        """Add one fault for each bad row."""
        for row in np.flatnonzero(bad).tolist():
            value = got if isinstance(got, str) else got(row)
            self.faults.append(Fault(column, expected, value, self.table.where(row, column), step))

    def _named(self, name: str) -> tuple[Index, tuple[str, ...]]:
        """Return codes (rows,) and names of a text column; names that a spreadsheet made of one are one."""
        column = self.table.texts[name]
        plain = [plain_name(text) for text in column.names] if name == "point" else list(column.names)
        names = list(dict.fromkeys(plain))
        code = np.array([names.index(text) for text in plain] + [-1], dtype=np.intp)
        return code[column.codes], tuple(names)

    def _check_numbers(self) -> Mask:
        """Report numbers that no row may hold; return which rows have a frequency."""
        numbers, columns = self.table.numbers, self.columns

        def check(name: str, bad: Mask, expected: str, step: str = "Correct the cell") -> None:
            if np.any(bad):
                bad = bad & ~(np.isnan(numbers[name]) & self.table.invalid_rows(name))
                self._report(bad, name, expected, lambda row: _cell(numbers[name][row]), step)

        freq = numbers["freq_hz"]
        usable = (freq >= LOWEST_HZ) & (freq <= HIGHEST_HZ)
        step = "Give the frequency in Hz, or leave the row out (a DC line holds no motion)"
        check("freq_hz", ~usable, f"from {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz", step)
        step = "Leave the cell empty where the value is missing"
        for name in (columns.first, columns.second):
            check(name, np.abs(numbers[name]) > LARGEST, f"finite and below {LARGEST:g}", step)
        if columns.polar:
            below = numbers[columns.first] < 0.0
            decibels = 2 * np.sum(below) > len(below)
            step = "They look like decibels: give amplitudes, 10^(dB/20) times the reference"
            check(columns.first, below, "positive or zero", step if decibels else "Correct the cell")
        if columns.sd:
            sd = numbers[columns.sd]
            check(columns.sd, (sd < 0.0) | (sd > LARGEST), f"positive and below {LARGEST:g}")
            if np.all(np.isnan(sd)) and not np.any(self.table.invalid_rows(columns.sd)):
                where = Place(self.table.file, detail=columns.sd)
                step = "Leave the column out to have the noise estimated from the residuals"
                want, got = "a number in at least one row", "NaN or empty cells throughout"
                self.faults.append(Fault(columns.sd, want, got, where, step))
        if "n_avg" in columns.names:
            check("n_avg", (numbers["n_avg"] < 1.0) | np.isinf(numbers["n_avg"]), "1 or more")
        if "coherence" in columns.names:
            check("coherence", (numbers["coherence"] < 0.0) | (numbers["coherence"] > 1.0), "within 0 and 1")
        return usable

    def _directions(self) -> tuple[Array, Index]:
        """Return the different unit directions (n, 3) and which of them each row (rows,) has, -1 for none."""
        if "dir" in self.columns.names:
            column = self.table.texts["dir"]
            axes = [axis_vector(name) for name in column.names]
            good = np.array([axis is not None for axis in axes] + [False])
            self._report(
                ~good[column.codes], "dir", "x, y, z, -x, -y or -z",
                lambda row: shown((*column.names, "an empty cell")[column.codes[row]]),
            )  # fmt: skip
            known = np.array([unknown_vector() if axis is None else axis for axis in axes]).reshape(-1, 3)
            return known, np.where(good[column.codes], column.codes, -1)
        parts = np.column_stack([self.table.numbers[name] for name in DIRECTION])
        code, first = _numbered(list(parts.T))
        vectors = parts[first]
        with np.errstate(over="ignore"):
            length = np.linalg.norm(vectors, axis=1)
        good = np.abs(length - 1.0) <= 1e-3
        invalid = np.any([self.table.invalid_rows(name) for name in DIRECTION], axis=0)
        self._report(
            ~good[code] & ~invalid, ", ".join(DIRECTION), "a unit vector (within 1e-3)",
            lambda row: f"({', '.join(f'{part:g}' for part in parts[row])})",
            "Divide the direction by its length",
        )  # fmt: skip
        with np.errstate(invalid="ignore", divide="ignore"):
            return vectors / length[:, None], np.where(good[code], code, -1)

    def _check_positions(self, place: Index) -> None:
        """Report positions that are empty or far away, and points with two; ``place`` numbers the points."""
        if POSITION[0] not in self.columns.names:
            return
        self.faults += position_faults(self.table, POSITION)
        rows = np.column_stack([self.table.numbers[name] for name in POSITION])
        good = np.flatnonzero(np.all(np.isfinite(rows), axis=1))
        first = np.zeros(int(place.max()) + 1, dtype=np.intp)
        first[place[good][::-1]] = good[::-1]
        with np.errstate(invalid="ignore"):
            moved = np.any(np.abs(rows - rows[first[place]]) > _SAME_PLACE_MM, axis=1)
        for row in np.flatnonzero(moved & np.all(np.isfinite(rows), axis=1)).tolist():
            other = int(first[place[row]])
            got = f"{rows[other].tolist()} in line {self.table.lines[other]} and {rows[row].tolist()}"
            where = self.table.where(row, ", ".join(POSITION))
            step = "Name the points differently, or correct the position"
            self.faults.append(Fault("the position of a point", "one", got, where, step))

    def _lines(self, sweep: Index, freq: Array, rows: Index) -> tuple[Array, Index, list[Notice]]:
        """Return grid and line of each row (sorted by channel and frequency); report repeated rows."""
        edges = np.concatenate([[0], np.flatnonzero(np.diff(sweep)) + 1, [len(sweep)]])
        sweeps = [freq[start:stop] for start, stop in pairwise(edges.tolist())]
        grid, places, notices = common_grid(
            [np.unique(one) if np.any(np.diff(one) <= 0.0) else one for one in sweeps]
        )
        line = np.concatenate(
            [place if len(place) == len(one) else place[np.searchsorted(np.unique(one), one)]
             for place, one in zip(places, sweeps, strict=True)]
        )  # fmt: skip
        again = np.flatnonzero((np.diff(line) == 0) & (np.diff(sweep) == 0))
        for place in again.tolist():
            want = "the only one of its run, body, point, direction and frequency"
            got = f"the same as in line {self.table.lines[rows[place]]}"
            where = self.table.where(int(rows[place + 1]))
            step = "Number repeats in a column repeat, or remove the row"
            self.faults.append(Fault("a row", want, got, where, step))
        return grid, line, notices

    def _values(self) -> ComplexArray:
        first, second = (self.table.numbers[name] for name in (self.columns.first, self.columns.second))
        if self.columns.polar:
            return np.asarray(self.columns.unit.scale * first * np.exp(1j * np.deg2rad(second)))
        value = np.empty(len(first), dtype=complex)
        value.real, value.imag = first, second
        value *= self.columns.unit.scale
        return value

    def _channel(
        self, row: int, texts: dict[str, tuple[Index, tuple[str, ...]]], direction: Array
    ) -> Channel:
        names = {
            name: column[codes[row]] if codes[row] >= 0 else "" for name, (codes, column) in texts.items()
        }
        position = unknown_vector()
        if POSITION[0] in self.columns.names:
            position = 1e-3 * np.array([self.table.numbers[name][row] for name in POSITION])
        where = self.table.where(int(row))
        return Channel(
            **names, order=self.columns.unit.order, position_m=position, direction=direction, where=where
        )

    def _notices(
        self,
        value: ComplexArray,
        sd: Array | None,
        shape: tuple[int, int],
        at: Index,
        channels: Sequence[Channel],
    ) -> list[Notice]:
        """Report what is missing and what was not used."""
        notices, file = [], self.table.file
        missing = np.ones(shape, dtype=bool)
        missing.ravel()[at] = False
        bodies = [channel.body for channel in channels]
        runs = [(channel.body, channel.run, channel.repeat) for channel in channels]
        for key in dict.fromkeys(runs):
            mine = [number for number, other in enumerate(runs) if other == key]
            missing[mine] &= ~np.all(missing[mine], axis=0)
        if np.any(missing):
            lacking = [channels[k].name for k in np.flatnonzero(np.any(missing, axis=1)).tolist()]
            end = (
                " The last row is in the middle of a sweep: was the file cut off?" if missing[-1, -1] else ""
            )
            text = (
                f"{int(np.sum(missing))} readings of {len(lacking)} channels ({list_some(lacking, 6)}) have "
                f"no row in {file} at lines that other channels of the body have; they count as missing.{end}"
            )
            notices.append(Notice("values_missing", text))
        empty = int(np.sum(np.isnan(value.ravel()[at])))
        if empty:
            text = f"{empty} rows of {file} have no value, or one of its two numbers; they count as missing."
            notices.append(Notice("values_missing", text))
        exact = 0 if sd is None else int(np.sum(sd == 0.0))
        if exact:
            text = f"{exact} values of {file} have a noise of 0: they are exact to 1e-12 of the largest."
            notices.append(Notice("sd_zero", text))
        alike = [
            name
            for name in dict.fromkeys(bodies)
            if any(name != b and name.lower() == b.lower() for b in bodies)
        ]
        if alike:
            text = f"{' and '.join(alike)} differ in case only and were taken as different bodies."
            notices.append(Notice("names_alike", text))
        if self.columns.ignored:
            listed = list_some((with_meant(name) for name in self.columns.ignored), 6)
            notices.append(Notice("content_ignored", f"columns of {file} that are not used: {listed}."))
        if self.table.comments:
            text = f"{self.table.comments} lines of {file} begin with # and were skipped."
            notices.append(Notice("content_ignored", text))
        return notices


def _spread(values: Array, at: Index, shape: tuple[int, int]) -> Array:
    """Return the values of rows in the shape of channels and lines, NaN where there is no row."""
    full = np.full(shape[0] * shape[1], np.nan)
    full[at] = values
    return full.reshape(shape)


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


def _cell(value: float) -> str:
    return "an empty or NaN cell" if np.isnan(value) else f"{value:g}"

"""Read tables over frequency: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

Wide tables of spreadsheets hold all points, text exports of scanning vibrometers a point each (see
`kinematics.readers.psv`). The names of the columns give part, axis and point; else a mapping does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.columns import is_frequency, meaning, signals_of, words_of
from kinematics.readers.facts import FileFacts, direction_of
from kinematics.readers.gather import Row, recording_of
from kinematics.readers.mapping import Mapping, Signal, mapping_beside, read_mapping
from kinematics.readers.psv import (
    APART,
    PointTable,
    is_fastscan,
    is_of_point,
    point_table,
    treatments,
    turned_over,
)
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.sheets import Sheet, first_header, name_and_unit, refuse, sheets_of
from kinematics.readers.text import export_files, plain_name, shown
from kinematics.readers.units import HERTZ
from stapeskit.arrays import Array
from stapeskit.faults import Fault, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice

LOWEST_AUDIBLE_TOP_HZ = 100.0
"""A sweep that ends below is in kHz, where no unit is stated: hearing ends at 20 kHz."""

_TIDY = {"body", "dir", "dir_x", "freq_hz"}


def kind_of(text: str) -> str:
    """Return the layout by the first lines: ``fastscan``, ``points``, ``wide``, ``time`` or empty."""
    sheet = first_header(text)
    if sheet is None:
        return ""
    if is_of_point(sheet):
        return "points"
    if is_fastscan(sheet):
        return "fastscan"
    low = {name.strip('"').lower() for name in sheet.names}
    if "time_s" in low or not _TIDY.isdisjoint(low):
        return "time" if "time_s" in low else ""
    parts = {meant[0] for name in sheet.names if (meant := meaning(name))}
    complete = {"re", "im"} <= parts or {"amp", "phase"} <= parts
    return "wide" if complete and any(map(is_frequency, sheet.names)) else ""


def read(path: Path, facts: FileFacts) -> Recording:
    """Read a file, or a folder (with its folders) of exports; the first table says what they are.

    Raises
    ------
    StapeskitError
        Cells that are no numbers, missing columns, a magnitude without phase, units that are not stated where
        values are ambiguous, tables of several scans; as `recording_of`.
    """
    path = Path(path)
    faults: list[Fault] = []
    files = export_files(path) if path.is_dir() else [path]
    sheets = [sheet for file in files for sheet in sheets_of(file, faults)]
    raise_all(faults)
    fastscan, of_points = is_fastscan(sheets[0]), is_of_point(sheets[0])
    mapping_file = None if fastscan or of_points else mapping_beside(path, facts.mapping)
    mapping = Mapping() if mapping_file is None else read_mapping(mapping_file)
    tables: list[PointTable] = []
    if fastscan:
        tables = turned_over(sheets)
    for sheet in [] if fastscan else sheets:
        with collect_faults(faults):
            tables.append(point_table(sheet) if of_points else PointTable(sheet))
    notices = treatments(sheets, path.name)
    rows: list[tuple[Row, str]] = []
    unused: list[str] = []
    for table in tables:
        with collect_faults(faults):
            signals, unknown = signals_of(table.sheet.names)
            unused += [] if mapping.signal or fastscan else unknown
            found = _rows(table, mapping.signal or signals, mapping, path.stem)
            rows += [(row, table.source) for row in found]
    raise_all(faults)
    unused = [name for name in dict.fromkeys(unused) if name and not is_frequency(name)]
    if unused:
        text = f"{path.name}: columns that name no part of a signal were left out: {list_some(unused, 12)}."
        notices.append(Notice("file_read", text))
    stated = all(table.length_stated for table in tables)
    statement = "columns by their names"
    if fastscan or of_points:
        units = "positions in stated units" if stated else "positions without unit, as metres"
        statement = f"coordinates of the scan, {units}"
        notices += _beam_notices([row for row, _ in rows], path.name)
    return recording_of(
        path.name,
        _with_runs(rows),
        mapping.amplitude,
        twice=APART,
        notices=tuple(notices),
        statement=statement,
        length_stated=stated,
    )


def _rows(table: PointTable, signals: Sequence[Signal], mapping: Mapping, stem: str) -> list[Row]:
    """Return one row for each signal of a table; all faults of their columns together."""
    sheet = table.sheet
    freq = _frequencies(sheet, mapping)
    faults = _phase_faults(sheet, signals)
    rows: list[Row] = []
    if not signals:
        want, got = "real and imaginary part, or magnitude and phase", shown(", ".join(sheet.names))
        raise refuse(sheet, "the columns", want, got, "Export Real & Imag., or Magnitude & Phase")
    for signal in signals:
        with collect_faults(faults):
            rows.append(_row(table, signal, freq, mapping, stem))
    raise_all(faults)
    return rows


def _row(table: PointTable, signal: Signal, freq: Array, mapping: Mapping, stem: str) -> Row:
    """Return one beam at one point."""
    sheet = table.sheet

    def numbers(name: str) -> Array:
        return np.asarray(sheet.numbers[:, sheet.column_of(name)])

    def unit_of(name: str) -> str:
        return sheet.units[sheet.column_of(name)] if name else ""

    value = signal.values(numbers, signal.phase_unit or unit_of(signal.phase) or "deg", sheet.where)
    if signal.value_re and unit_of(signal.value_re) != unit_of(signal.value_im):
        got = " and ".join(shown(unit_of(name)) or "none" for name in signal.parts)
        raise refuse(sheet, "real and imaginary part", "in one unit", got)
    if isinstance(signal.n_avg, str) and signal.n_avg:
        raise refuse(sheet, "n_avg of a mapping", "a number of averages", signal.n_avg)
    stated = signal.direction or table.axis
    stated = ",".join(map(str, stated)) if isinstance(stated, list) else stated
    direction = direction_of(stated, sheet.where, "the direction of a signal") if stated else unknown_vector()
    channel = Channel(
        table.point or plain_name(signal.point) or stem,
        signal.body or mapping.body,
        signal.run or mapping.run,
        position_m=table.position_m,
        direction=direction,
        where=sheet.where,
    )
    return Row(
        channel,
        freq,
        value.conj() if mapping.convention == "-" else value,
        sd=numbers(signal.sd) if signal.sd else None,
        coherence=numbers(signal.coherence) if signal.coherence else None,
        n_avg=None if signal.n_avg == "" else float(signal.n_avg),
        unit=signal.unit or unit_of(signal.name),
        source=signal.name,
    )


def _frequencies(sheet: Sheet, mapping: Mapping) -> Array:
    """Return the column of frequencies, Hz."""
    named = name_and_unit(mapping.frequency)[0]
    columns = [k for k, name in enumerate(sheet.names) if (name == named if named else is_frequency(name))]
    if len(columns) != 1:
        got = " and ".join(sheet.names[k] for k in columns) or f"none of {shown(', '.join(sheet.names))}"
        step = f'Export spectra, or name it in a mapping: frequency = "{sheet.names[0]}"'
        raise refuse(sheet, "the column of frequencies", "one", got, step)
    name, freq = sheet.names[columns[0]], sheet.numbers[:, columns[0]]
    in_name = [word for word in words_of(name) if word in HERTZ]
    unit = mapping.frequency_unit or sheet.units[columns[0]] or "".join(in_name[:1])
    if unit and unit.lower() not in HERTZ:
        raise refuse(sheet, "the unit of the frequencies", "Hz, kHz or MHz", shown(unit))
    if not unit and len(freq) and np.max(freq) <= LOWEST_AUDIBLE_TOP_HZ:
        got = f"none, with frequencies from {np.min(freq):g} to {np.max(freq):g}"
        step = f'Write "{name} [kHz]" or "[Hz]" in the header'
        raise refuse(sheet, "the unit of the frequencies", "stated", got, step)
    return np.asarray(freq * HERTZ[(unit or "Hz").lower()])


def _phase_faults(sheet: Sheet, signals: Sequence[Signal]) -> list[Fault]:
    """Refuse phases without a unit that may be radians as well as degrees."""
    columns = [sheet.column_of(one.phase) for one in signals if one.phase and not one.phase_unit]
    silent = [column for column in columns if not sheet.units[column]]
    largest = float(np.max(np.nan_to_num(np.abs(sheet.numbers[:, silent])), initial=0.0))
    if not 0.0 < largest <= np.pi + 1e-3:
        return []
    got = f"none, with all phases within {largest:.4g}: degrees or radians"
    step = f'Write "{sheet.names[silent[0]]} [rad]" or "[deg]" in the header'
    return [Fault("the unit of the phases", "stated", got, sheet.where, step)]


def _with_runs(rows: Sequence[tuple[Row, str]]) -> list[Row]:
    """Name runs after the sources of the tables where these repeat points of each other."""
    sources = list(dict.fromkeys(source for _, source in rows if source))
    keys = [(row.channel.key, row.unit) for row, _ in rows]
    if len(sources) > 1 and len(set(keys)) < len(keys):
        return [
            replace(row, channel=replace(row.channel, run=Path(source.replace("\\", "/")).stem))
            for row, source in rows
        ]
    return [row for row, _ in rows]


def _beam_notices(rows: Sequence[Row], file: str) -> list[Notice]:
    """Report x, y, z at a point, which scanning vibrometers compute from several beams."""
    beams = {(row.channel.point, row.channel.beam_key) for row in rows}
    if len(beams) == len({point for point, _ in beams}):
        return []
    text = (
        f"{file} holds x, y, z computed from several beams: their noise is correlated, and larger across the "
        "beams than along them; sd and verdicts, which take channels as independent, are approximate. Export "
        "the single heads with their directions where possible."
    )
    return [Notice("axes_from_beams", text)]

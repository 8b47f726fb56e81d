"""Read tables over frequency: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

The names of the columns give part, axis, point and unit (`kinematics.readers.columns`). A mapping, a TOML
file, gives them such names: ``"A7" = "P7 z Mag [mm/s]"``.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

from kinematics.readers.columns import frequencies_of, is_frequency, meaning, signals_of
from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import recording_of
from kinematics.readers.psv import is_fastscan, is_of_point
from kinematics.readers.recording import Channel, Recording
from kinematics.readers.sheets import Sheet, name_and_unit, refuse, sheets_of
from kinematics.readers.text import decoded, plain_name, shown
from stapeskit.faults import Fault, StapeskitError, list_some, raise_all
from stapeskit.warnings import Notice

_TIDY = {"body", "dir", "dir_x", "freq_hz"}


def kind_of(text: str) -> str:
    """Return the format by the first lines of a text: ``psv``, ``wide``, ``series`` or empty."""
    sheets = sheets_of(text, "", [])
    if not sheets:
        return ""
    sheet = sheets[0]
    if is_of_point(sheet) or is_fastscan(sheet):
        return "psv"
    low = {name.strip('"').lower() for name in sheet.names}
    if "time_s" in low or not _TIDY.isdisjoint(low):
        return "series" if "time_s" in low else ""
    parts = {meant[0] for name in sheet.names if (meant := meaning(name))}
    complete = {"re", "im"} <= parts or {"amp", "phase"} <= parts
    return "wide" if complete and any(map(is_frequency, sheet.names)) else ""


def read(path: Path, facts: FileFacts) -> Recording:
    """Read a wide table.

    Raises
    ------
    StapeskitError
        Cells that are no numbers, missing columns, a magnitude without phase, units that are not stated where
        values are ambiguous; a mapping of columns that are not there; as `recording_of`.
    """
    path = Path(path)
    faults: list[Fault] = []
    sheets = sheets_of(decoded(path.read_bytes()), path.name, faults)
    raise_all(faults)
    sheet = sheets[0] if facts.mapping is None else _renamed(sheets[0], facts.mapping)
    if len(sheets) > 1:
        raise refuse(sheet, "the file", "of one table", f"{len(sheets)}", "Give a file for each")
    freq = frequencies_of(sheet)
    signals, unused = signals_of(sheet)
    unused = [name for name in unused if name and not is_frequency(name)]
    text = f"{path.name}: columns that name no part of a signal were left out: {list_some(unused, 12)}."
    rows = [
        signal.row(freq, Channel(plain_name(signal.point) or path.stem, where=sheet.where))
        for signal in signals
    ]
    notices = (Notice("file_read", text),) if unused else ()
    return recording_of(path.name, rows, notices=notices, statement="columns by their names")


def _renamed(sheet: Sheet, path: Path) -> Sheet:
    """Return the table with the names and units that a mapping gives its columns.

    Raises
    ------
    StapeskitError
        No TOML, something else than texts, or a name that no column or several have.
    """
    try:
        mapping = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (OSError, ValueError) as fault:
        got = getattr(fault, "strerror", None) or fault
        raise StapeskitError.of("--mapping", "a TOML file", got, path.name) from fault
    names, units = list(sheet.names), list(sheet.units)
    faults = []
    for old, new in mapping.items():
        column = name_and_unit(old)[0]
        if not isinstance(new, str) or sheet.names.count(column) != 1:
            want = f'a column once, "..." = "P7 z Mag [mm/s]"; the table has {list_some(sheet.names, 12)}'
            faults.append(Fault(f"{old} of the mapping", want, shown(str(new)), path.name))
            continue
        place = sheet.names.index(column)
        names[place], unit = name_and_unit(new)
        units[place] = unit or units[place]
    raise_all(faults)
    return replace(sheet, names=tuple(names), units=tuple(units))

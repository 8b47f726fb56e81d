"""Read tables over frequency: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

The names of the columns give part, axis, point and unit. A mapping, a TOML file, gives them such names:
``"A7" = "P7 z Mag [mm/s]"``.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import Row, from_parts, from_polar, recording_of
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.sheets import Sheet, name_and_unit, refuse, sheets_of
from kinematics.readers.text import decoded, plain_name, shown
from kinematics.readers.units import HERTZ, PHASES
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

PARTS = {
    "re": ("re", "real", "realteil", "réel", "réelle"),
    "im": ("im", "imag", "imaginary", "imaginär", "imaginärteil", "imaginaire"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag", "module"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
FREQUENCIES = ("frequency", "freq", "frequenz", "fréquence", "f")
LOWEST_AUDIBLE_TOP_HZ = 100.0
"""A sweep that ends below is in kHz, where no unit is stated: hearing ends at 20 kHz."""

_WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?[^\W_]+")
_FILLERS = (
    "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc", "acceleration",
    "point", "pt", "punkt", "node", "axis", "channel", "of", "part", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")


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
    rows, unused = rows_of(sheet, frequencies_of(sheet))
    rows = [replace(row, channel=replace(row.channel, point=row.channel.point or path.stem)) for row in rows]
    unused = [name for name in unused if name and not is_frequency(name)]
    text = f"{path.name}: columns that name no part of a signal were left out: {list_some(unused, 12)}."
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


def is_frequency(name: str) -> bool:
    """Return whether a column is named as that of the frequencies."""
    words = [word.lower() for word in _WORD.findall(name)]
    return bool(words) and words[0] in FREQUENCIES and set(words[1:]) <= {*HERTZ, "axis"}


def meaning(name: str) -> tuple[str, str, str] | None:
    """Return part, point and axis of a column's name; None where the part is missing or ambiguous."""
    part, axis, rest = "", "", []
    for word in _WORD.findall(name):
        low = word.lower()
        known = next((key for key, words in PARTS.items() if low in words), "")
        turned = _AXIS.fullmatch(low)
        if (known and part) or (turned and axis):
            return None
        if known:
            part = known
        elif turned:
            axis = turned[1].replace("+", "") + turned[2]
        elif low not in _FILLERS:
            numbered = _POINT.fullmatch(low)
            rest.append(numbered[1] if numbered else word.lstrip("+-"))
    return (part, " ".join(rest), axis) if part else None


def is_wide(sheet: Sheet) -> bool:
    """Return whether a table has frequencies and both parts of values by the names of its columns."""
    parts = {meant[0] for name in sheet.names if (meant := meaning(name))}
    return any(map(is_frequency, sheet.names)) and ({"re", "im"} <= parts or {"amp", "phase"} <= parts)


def rows_of(sheet: Sheet, freq_hz: Array) -> tuple[list[Row], list[str]]:
    """Return the beams that the names of columns describe, and the names that describe none.

    The last axis of the numbers of the table are its columns; the others are those of the values.

    Raises
    ------
    StapeskitError
        No pair of real and imaginary part or magnitude and phase; one part alone; parts in two units; phases
        without a unit that may be radians as well as degrees.
    """
    by_beam: dict[tuple[str, str], dict[str, int]] = {}
    unknown = []
    for column, name in enumerate(sheet.names):
        meant = meaning(name)
        if meant is None or meant[0] in by_beam.get(meant[1:], {}):
            unknown.append(name)
        else:
            by_beam.setdefault(meant[1:], {})[meant[0]] = column
    if not by_beam:
        want, got = "real and imaginary part, or magnitude and phase", shown(", ".join(sheet.names))
        raise refuse(sheet, "the columns", want, got, "Export Real & Imag., or Magnitude & Phase")
    faults = _phase_faults(sheet, [parts["phase"] for parts in by_beam.values() if "phase" in parts])
    rows = []
    for (point, axis), parts in by_beam.items():
        direction = axis_vector(axis) if axis else None
        channel = Channel(
            plain_name(point),
            direction=unknown_vector() if direction is None else direction,
            where=sheet.where,
        )
        with collect_faults(faults):
            rows.append(_row(sheet, channel, freq_hz, parts))
    raise_all(faults)
    return rows, unknown


def _row(sheet: Sheet, channel: Channel, freq_hz: Array, parts: dict[str, int]) -> Row:
    """Return one beam from the columns of its parts."""
    pair = [name for name in ("re", "im", "amp", "phase") if name in parts]
    if pair not in (["re", "im"], ["amp", "phase"]):
        thing = f"the column {sheet.names[next(iter(parts.values()))]}"
        want = "with its phase, or a real part with its imaginary part"
        raise refuse(sheet, thing, want, "alone", "Export both, with points and axes named alike")
    one, other = (parts[name] for name in pair)
    numbers, units = sheet.numbers, sheet.units
    if pair[0] == "re" and units[one] != units[other]:
        got = " and ".join(shown(units[column]) or "none" for column in (one, other))
        raise refuse(sheet, "real and imaginary part", "in one unit", got)
    if pair[0] == "re":
        value = from_parts(numbers[..., one], numbers[..., other])
    elif (turn := PHASES.get((units[other] or "deg").lower())) is None:
        raise refuse(sheet, "the unit of the phases", "deg or rad", shown(units[other]))
    else:
        value = from_polar(numbers[..., one], numbers[..., other], turn)
    coherence = numbers[..., parts["coherence"]] if "coherence" in parts else None
    return Row(channel, freq_hz, value, coherence=coherence, unit=units[one], source=sheet.names[one])


def _phase_faults(sheet: Sheet, phases: list[int]) -> list[Fault]:
    """Refuse phases without a unit that may be radians as well as degrees."""
    silent = [column for column in phases if not sheet.units[column]]
    largest = float(np.max(np.nan_to_num(np.abs(sheet.numbers[..., silent])), initial=0.0))
    if not 0.0 < largest <= np.pi + 1e-3:
        return []
    got = f"none, with all phases within {largest:.4g}: degrees or radians"
    step = f'Write "{sheet.names[silent[0]]} [rad]" or "[deg]" in the header'
    return [Fault("the unit of the phases", "stated", got, sheet.where, step)]


def frequencies_of(sheet: Sheet) -> Array:
    """Return the column of frequencies, Hz.

    Raises
    ------
    StapeskitError
        There is none, there are several, or their unit is unknown or not clear.
    """
    columns = [column for column, name in enumerate(sheet.names) if is_frequency(name)]
    if len(columns) != 1:
        got = " and ".join(sheet.names[k] for k in columns) or f"none of {shown(', '.join(sheet.names))}"
        step = f'Export spectra, or name it: "{sheet.names[0]}" = "Frequency [Hz]" in a mapping'
        raise refuse(sheet, "the column of frequencies", "one", got, step)
    name, freq = sheet.names[columns[0]], sheet.numbers[:, columns[0]]
    unit = sheet.units[columns[0]] or next((one for one in _WORD.findall(name) if one.lower() in HERTZ), "")
    if unit and unit.lower() not in HERTZ:
        raise refuse(sheet, "the unit of the frequencies", "Hz, kHz or MHz", shown(unit))
    if not unit and len(freq) and np.max(freq) <= LOWEST_AUDIBLE_TOP_HZ:
        got = f"none, with frequencies from {np.min(freq):g} to {np.max(freq):g}"
        step = f'Write "{name} [kHz]" or "[Hz]" in the header'
        raise refuse(sheet, "the unit of the frequencies", "stated", got, step)
    return np.asarray(freq * HERTZ[(unit or "Hz").lower()])

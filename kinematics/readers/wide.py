"""Read wide tables of spreadsheets: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

The names give part, axis and point; where they do not, a mapping does (kinematics.readers.mapping).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kinematics.readers.facts import FileFacts, direction_of
from kinematics.readers.mapping import Mapping, mapping_beside, read_mapping
from kinematics.readers.recording import (
    Channel,
    Recording,
    Row,
    from_polar,
    recording_of,
    scaled,
    unknown_vector,
)
from kinematics.readers.text import cells_of, is_row, number_of, plain_name, read_rows, read_text, shown
from kinematics.readers.units import HERTZ, PHASES, MotionUnit, motion_unit, split_amplitude, unit_fault
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

PARTS = {
    "re": ("re", "real", "realteil"),
    "im": ("im", "imag", "imaginary", "imaginärteil"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
LOWEST_AUDIBLE_TOP_HZ = 100.0
"""A sweep that ends below is in kHz, where no unit is stated: hearing ends at 20 kHz."""

_FREQUENCY = ("frequency", "freq", "frequenz", "fréquence", "f")
_FILLERS = (
    "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc", "acceleration",
    "point", "pt", "punkt", "node", "axis", "channel", "of", "part", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
_TIDY = {"body", "dir", "dir_x", "freq_hz"}
_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
_UNIT_ALONE = re.compile(r"[\[(].*[\])]|k?Hz|°|deg|rad|[munp]?m(/s[2²]?)?|µm(/s)?|g|")
_WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?[^\W_]+")
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")
_MOST_ABOVE = 100  # lines above the names: a measuring program writes some ten


@dataclass(frozen=True)
class Sheet:
    """A table of numbers below a line of names; ``line`` is its number, units are empty where unknown."""

    file: str
    line: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array

    @property
    def where(self) -> Place:
        """Place of the names, for messages."""
        return Place(self.file, "line", (self.line,))


@dataclass(frozen=True)
class Beam:
    """The columns of one beam at one point: parts of `PARTS` and ``sd``; texts are empty where unknown."""

    columns: dict[str, int] = field(default_factory=dict)
    point: str = ""
    direction: Any = ""
    unit: str = ""
    phase_unit: str = ""
    body: str = ""
    run: str = ""
    n_avg: float | None = None


def is_wide(text: str) -> bool:
    """Return whether a text begins as a wide table with telling names of columns."""
    header = header_of(text)
    if header is None or not _TIDY.isdisjoint(name.lower() for name in header[1]):
        return False
    parts = {meant[0] for name in header[1] if (meant := meaning(name))}
    return any(map(is_frequency, header[1])) and ({"re", "im"} <= parts or {"amp", "phase"} <= parts)


def header_of(text: str) -> tuple[int, list[str], list[str], str] | None:
    """Return line (from 0), names, units and separator of the header in the first lines of a text.

    None where no line of names is followed by a row of at least two numbers.
    """
    lines = text.split("\n", _MOST_ABOVE)[:_MOST_ABOVE]
    for separator in ("\t", ";", ","):
        first = next((n for n, line in enumerate(lines) if is_row(cells_of(line, separator))), None)
        above = [n for n in range(first or 0) if lines[n].strip()]
        if not above or separator not in lines[above[-1]]:
            continue
        at, units = above[-1], [""]
        names = cells_of(lines[at], separator)
        if len(above) > 1 and all(map(_UNIT_ALONE.fullmatch, names)):
            units = [cell.strip("[]() ") for cell in names]
            at = above[-2]
            names = cells_of(lines[at], separator)
        while names and not names[-1]:
            names.pop()
        units += [""] * (len(names) - len(units))
        stated = [
            match[1].strip() if (match := _UNIT.search(n)) else u for n, u in zip(names, units, strict=False)
        ]
        return at, [_UNIT.sub("", name).strip() for name in names], stated, separator
    return None


def read(path: Path, facts: FileFacts) -> Recording:
    """Read a wide table; rows may lead from high to low frequencies.

    Raises
    ------
    StapeskitError
        Cells that are no numbers, missing columns, a magnitude without phase, a unit that is no motion or is
        not stated where its values are ambiguous.
    """
    path = Path(path)
    sheet = read_sheet(path)
    mapping_file = mapping_beside(path, facts.mapping)
    mapping = Mapping() if mapping_file is None else read_mapping(mapping_file)
    beams, unused = beams_of(sheet.names)
    if mapping.signal:
        beams, unused = _mapped_beams(mapping, sheet), []
    freq = _frequencies(sheet, mapping)
    order = np.argsort(freq, kind="stable")
    numbers, freq = sheet.numbers[order], freq[order]
    faults = _phase_faults(sheet, beams)
    rows, without_unit, amplitudes = [], dict[str, list[str]](), set[str]()
    for beam in beams:
        with collect_faults(faults):
            value, first = _complex(sheet, beam, numbers)
            label, amplitude = split_amplitude(beam.unit or sheet.units[first])
            amplitudes.add(mapping.amplitude or amplitude)
            unit = motion_unit(label)
            if unit is None:
                without_unit.setdefault(beam.unit or sheet.units[first], []).append(sheet.names[first])
            else:
                rms = (mapping.amplitude or amplitude) == "rms" and not unit.per
                value = value.conj() if mapping.convention == "-" else value
                rows.append(
                    _row(sheet, beam, unit, 2.0**0.5 if rms else 1.0, (freq, value, numbers), path.stem)
                )
    for label, names in without_unit.items():
        step = f'Write it behind the name, "{names[0]} [mm/s]", or as unit in {path.name}.toml'
        faults.append(unit_fault(label, names, sheet.where, step))
    if len(amplitudes) > 1:
        got = " and ".join(sorted(name or "neither" for name in amplitudes))
        step = "Write peak or rms into all units, or into none"
        faults.append(Fault("the units of the amplitudes", "all peak or all rms", got, sheet.where, step))
    raise_all(faults)
    notices: tuple[Notice, ...] = ()
    if unused:
        text = f"{path.name}: columns that name no part of a signal were left out: {', '.join(unused[:12])}."
        notices = (Notice("content_ignored", text),)
    statement, stated = "columns by their names", "" not in amplitudes
    return recording_of(path.name, rows, notices=notices, statement=statement, amplitude_stated=stated)


def read_sheet(path: Path) -> Sheet:
    """Read the numbers of a wide table.

    Raises
    ------
    StapeskitError
        No line of names above rows of numbers, rows of another length, or cells that are no numbers.
    """
    text = read_text(path)
    header = header_of(text)
    if header is None:
        want, step = "one line of names above rows of numbers", "Put one line of names above the rows"
        raise StapeskitError.of("the table", want, "none", path.name, step)
    at, names, units, separator = header
    lines = text.split("\n")[at + 1 :]
    skip = next((n for n, line in enumerate(lines) if is_row(cells_of(line, separator))), 0)
    faults: list[Fault] = []
    numbers = read_rows(lines[skip:], at + 2 + skip, separator, names, path.name, faults)
    raise_all(faults)
    return Sheet(path.name, at + 1, tuple(names), tuple(units), numbers)


def is_frequency(name: str) -> bool:
    """Return whether a column holds the frequencies."""
    words = [word.lower() for word in _WORD.findall(name)]
    return bool(words) and words[0] in _FREQUENCY and set(words[1:]) <= {*HERTZ, "axis"}


def meaning(name: str) -> tuple[str, str, str] | None:
    """Return the part, point and axis that a name says; None where it says no part, or two of a kind."""
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


def beams_of(names: Sequence[str]) -> tuple[list[Beam], list[str]]:
    """Return the beams that the column names describe, and the names that describe none."""
    by_beam: dict[tuple[str, str], dict[str, int]] = {}
    unknown = []
    for column, name in enumerate(names):
        parts = meaning(name)
        if parts is None or parts[0] in by_beam.get(parts[1:], {}):
            if not is_frequency(name) and name:
                unknown.append(name)
            continue
        by_beam.setdefault(parts[1:], {})[parts[0]] = column
    return [Beam(columns, point, axis) for (point, axis), columns in by_beam.items()], unknown


def _mapped_beams(mapping: Mapping, sheet: Sheet) -> list[Beam]:
    """Return the beams that a mapping names."""
    keys = {"value_re": "re", "value_im": "im", "magnitude": "amp", "phase": "phase"}
    keys |= {"coherence": "coherence", "sd": "sd"}
    beams, faults = [], []
    for signal in mapping.signal:
        columns = {}
        for key, part in keys.items():
            name = _UNIT.sub("", getattr(signal, key)).strip()
            if not name:
                continue
            if sheet.names.count(name) == 1:
                columns[part] = sheet.names.index(name)
            else:
                step = f"It has {', '.join(sheet.names[:12])}"
                got = f"{sheet.names.count(name)} of that name"
                faults.append(Fault(f"the column {name}", "in the table once", got, sheet.file, step))
        if isinstance(signal.n_avg, bool) or not (
            signal.n_avg == "" or isinstance(signal.n_avg, int | float)
        ):
            faults.append(Fault("n_avg", "a number of averages", signal.n_avg, f"{sheet.file}.toml"))
            continue
        count = None if signal.n_avg == "" else float(signal.n_avg)
        beams.append(
            Beam(columns, signal.point, signal.direction, signal.unit, signal.phase_unit,
                 signal.body or mapping.body, signal.run or mapping.run, count)
        )  # fmt: skip
    raise_all(dict.fromkeys(faults))
    return beams


def _frequencies(sheet: Sheet, mapping: Mapping) -> Array:
    """Return the column of frequencies, Hz."""
    named = _UNIT.sub("", mapping.frequency).strip()
    columns = [k for k, name in enumerate(sheet.names) if (name == named if named else is_frequency(name))]
    if len(columns) != 1:
        got = "none" if not columns else " and ".join(sheet.names[k] for k in columns)
        step = f'Name it in {sheet.file}.toml: frequency = "{sheet.names[0]}"'
        raise StapeskitError.of("the column of frequencies", "one", got, sheet.where, step)
    in_name = [word for word in _WORD.findall(sheet.names[columns[0]]) if word.lower() in HERTZ]
    unit = mapping.frequency_unit or sheet.units[columns[0]] or "".join(in_name[:1])
    if unit and unit.lower() not in HERTZ:
        raise StapeskitError.of("the unit of the frequencies", "Hz, kHz or MHz", shown(unit), sheet.where)
    freq = sheet.numbers[:, columns[0]] * HERTZ[(unit or "Hz").lower()]
    bad = ~(freq >= 0.0) | np.isinf(freq)
    if not len(freq) or np.any(bad) or len(np.unique(freq)) < len(freq):
        got = "none" if not len(freq) else f"{freq[bad][0]:g}" if np.any(bad) else "one of them twice"
        step = "Write one row a frequency"
        raise StapeskitError.of("the frequencies", "different and not negative", got, sheet.where, step)
    if not unit and freq.max() <= LOWEST_AUDIBLE_TOP_HZ:
        got = f"none, with frequencies from {freq.min():g} to {freq.max():g}"
        step = f'Write "{sheet.names[columns[0]]} [kHz]" or "[Hz]" in the header'
        raise StapeskitError.of("the unit of the frequencies", "stated", got, sheet.where, step)
    return np.asarray(freq)


def _phase_faults(sheet: Sheet, beams: Sequence[Beam]) -> list[Fault]:
    """Refuse phases without a unit that may be radians as well as degrees."""
    silent = [
        beam.columns["phase"]
        for beam in beams
        if "phase" in beam.columns and not beam.phase_unit and not sheet.units[beam.columns["phase"]]
    ]
    phases = np.abs(sheet.numbers[:, silent])
    if not np.any(np.isfinite(phases)) or np.nanmax(phases) > np.pi + 1e-3 or np.nanmax(phases) == 0.0:
        return []
    got = f"none, with all phases within {np.nanmax(phases):.4g}: degrees or radians"
    step = f'Write "{sheet.names[silent[0]]} [rad]" or "[deg]" in the header'
    return [Fault("the unit of the phases", "stated", got, sheet.where, step)]


def _complex(sheet: Sheet, beam: Beam, numbers: Array) -> tuple[ComplexArray, int]:
    """Return the values of a beam in its unit, and the column that says the unit."""
    parts = beam.columns
    if {"re", "im"} <= set(parts):
        value = numbers[:, parts["re"]].astype(complex)
        value.imag = numbers[:, parts["im"]]
        return value, parts["re"]
    if {"amp", "phase"} <= set(parts):
        label = beam.phase_unit or sheet.units[parts["phase"]] or "deg"
        if label.lower() not in PHASES:
            raise StapeskitError.of("the unit of the phases", "deg or rad", shown(label), sheet.where)
        turn = PHASES[label.lower()]
        return from_polar(numbers[:, parts["amp"]], numbers[:, parts["phase"]], turn), parts["amp"]
    lone = sheet.names[next(iter(parts.values()))]
    want = "with its phase, or a real part with its imaginary part"
    step = f"Export both, or state in {sheet.file}.toml which column is what (docs/vibrometer_files.md)"
    raise StapeskitError.of(f"the column {lone}", want, "alone", sheet.where, step)


def _row(
    sheet: Sheet,
    beam: Beam,
    unit: MotionUnit,
    peak: float,
    data: tuple[Array, ComplexArray, Array],
    stem: str,
) -> Row:
    """Return one beam at one point; ``data`` are frequencies, values in the unit, and all columns."""
    freq, value, numbers = data
    stated = beam.direction
    direction = unknown_vector()
    if (
        isinstance(stated, list)
        and len(stated) == 3
        and all(number_of(str(part)) is not None for part in stated)
    ):
        direction = direction_of(",".join(map(str, stated)), sheet.file)
    elif stated != "":
        axis = axis_vector(str(stated))
        if axis is None:
            step = 'Write direction = "z", or three numbers'
            raise StapeskitError.of(
                "the direction of a signal", "x, -y ... or three numbers", stated, sheet.file, step
            )
        direction = axis
    sd, coherence = (
        numbers[:, beam.columns[part]] if part in beam.columns else None for part in ("sd", "coherence")
    )
    scale = unit.scale * peak
    channel = Channel(
        plain_name(beam.point) or stem, beam.body, beam.run, order=unit.order, per=unit.per,
        direction=direction, where=sheet.where,
    )  # fmt: skip
    return Row(channel, freq, scaled(value, scale), None if sd is None else sd * scale, coherence, beam.n_avg)

"""Read wide tables of spreadsheets: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

The names give part, axis and point; where they do not, a mapping does (kinematics.readers.mapping).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.readers.columns import (
    WORD,
    Beam,
    BeamValues,
    Sheet,
    beams_of,
    meaning,
    name_and_unit,
    values_of,
)
from kinematics.readers.facts import FileFacts, direction_of
from kinematics.readers.mapping import Mapping, mapping_beside, read_mapping
from kinematics.readers.recording import Channel, Recording, Row, recording_of, unknown_vector
from kinematics.readers.text import cells_of, is_row, plain_name, read_rows, read_text, shown
from kinematics.readers.units import HERTZ
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, raise_all
from stapeskit.warnings import Notice

LOWEST_AUDIBLE_TOP_HZ = 100.0
"""A sweep that ends below is in kHz, where no unit is stated: hearing ends at 20 kHz."""

_FREQUENCY = ("frequency", "freq", "frequenz", "fréquence", "f")
_TIDY = {"body", "dir", "dir_x", "freq_hz"}
_UNIT_ALONE = re.compile(r"[\[(].*[\])]|k?Hz|°|deg|rad|[munp]?m(/s[2²]?)?|µm(/s)?|g|")
_MOST_ABOVE = 100  # lines above the names: a measuring program writes some ten
_MAPPED = {
    "value_re": "re", "value_im": "im", "magnitude": "amp", "phase": "phase",
    "coherence": "coherence", "sd": "sd",
}  # fmt: skip


def is_wide(text: str) -> bool:
    """Return whether a text begins as a wide table with telling names of columns."""
    header = _header_of(text)
    if header is None or not _TIDY.isdisjoint(name.lower() for name in header[1]):
        return False
    parts = {meant[0] for name in header[1] if (meant := meaning(name))}
    return any(map(_is_frequency, header[1])) and ({"re", "im"} <= parts or {"amp", "phase"} <= parts)


def _header_of(text: str) -> tuple[int, list[str], list[str], str] | None:
    """Return line (from 0), names, units and separator of the header in the first lines of a text.

    None where no line of names is followed by a row of at least two numbers.
    """
    lines = text.split("\n", _MOST_ABOVE)[:_MOST_ABOVE]
    for separator in "\t;,":
        first = next((n for n, line in enumerate(lines) if is_row(cells_of(line, separator))), 0)
        above = [n for n in range(first) if lines[n].strip()]
        if not above or separator not in lines[above[-1]]:
            continue
        cells, below = cells_of(lines[above[-1]], separator), [""]
        if len(above) > 1 and all(map(_UNIT_ALONE.fullmatch, cells)):
            below = [cell.strip("[]() ") for cell in cells]
            above.pop()
            cells = cells_of(lines[above[-1]], separator)
        while cells and not cells[-1]:
            cells.pop()
        named = [name_and_unit(cell) for cell in cells]
        below += [""] * (len(cells) - len(below))
        units = [unit or other for (_, unit), other in zip(named, below, strict=False)]
        return above[-1], [name for name, _ in named], units, separator
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
    sheet = _read_sheet(path)
    mapping_file = mapping_beside(path, facts.mapping)
    mapping = Mapping() if mapping_file is None else read_mapping(mapping_file)
    beams, unknown = beams_of(sheet.names)
    unused = [sheet.names[k] for k in unknown if sheet.names[k] and not _is_frequency(sheet.names[k])]
    if mapping.signal:
        beams, unused = _mapped_beams(mapping, sheet), []
    freq = _frequencies(sheet, mapping)
    order = np.argsort(freq, kind="stable")
    sheet = replace(sheet, numbers=sheet.numbers[order])
    found = values_of(sheet, beams, mapping.amplitude)
    notices: tuple[Notice, ...] = ()
    if unused:
        text = f"{path.name}: columns that name no part of a signal were left out: {', '.join(unused[:12])}."
        notices = (Notice("content_ignored", text),)
    return recording_of(
        path.name,
        [_row(sheet, one, freq[order], mapping, path.stem) for one in found],
        notices=notices,
        statement="columns by their names",
        amplitude_stated=all(one.amplitude for one in found),
    )


def _read_sheet(path: Path) -> Sheet:
    """Read the numbers of a wide table; faulty rows and cells are refused together."""
    text = read_text(path)
    header = _header_of(text)
    if header is None:
        want, step = "one line of names above rows of numbers", "Put one line of names above the rows"
        raise StapeskitError.of("the table", want, "none", path.name, step)
    at, names, units, separator = header
    lines = text.split("\n")
    first = next((n for n in range(at + 1, len(lines)) if is_row(cells_of(lines[n], separator))), at + 1)
    faults: list[Fault] = []
    numbers = read_rows(lines[first:], first + 1, separator, names, path.name, faults)
    raise_all(faults)
    return Sheet(Place(path.name, "line", (at + 1,)), tuple(names), tuple(units), numbers)


def _is_frequency(name: str) -> bool:
    words = [word.lower() for word in WORD.findall(name)]
    return bool(words) and words[0] in _FREQUENCY and set(words[1:]) <= {*HERTZ, "axis"}


def _mapped_beams(mapping: Mapping, sheet: Sheet) -> list[Beam]:
    """Return the beams that a mapping names."""
    beams, faults = [], []
    for signal in mapping.signal:
        columns = {}
        for key, part in _MAPPED.items():
            name = name_and_unit(getattr(signal, key))[0]
            if name and sheet.names.count(name) != 1:
                step, got = f"It has {', '.join(sheet.names[:12])}", f"{sheet.names.count(name)} of that name"
                faults.append(Fault(f"the column {name}", "in the table once", got, sheet.where.file, step))
            elif name:
                columns[part] = sheet.names.index(name)
        if isinstance(signal.n_avg, str) and signal.n_avg:
            faults.append(Fault("n_avg", "a number of averages", signal.n_avg, f"{sheet.where.file}.toml"))
            continue
        stated = signal.direction
        beams.append(
            Beam(
                columns,
                signal.point,
                ",".join(map(str, stated)) if isinstance(stated, list) else stated,
                signal.unit,
                signal.phase_unit,
                signal.body or mapping.body,
                signal.run or mapping.run,
                None if signal.n_avg == "" else float(signal.n_avg),
            )
        )
    raise_all(dict.fromkeys(faults))
    return beams


def _frequencies(sheet: Sheet, mapping: Mapping) -> Array:
    """Return the column of frequencies, Hz."""
    named = name_and_unit(mapping.frequency)[0]
    columns = [k for k, name in enumerate(sheet.names) if (name == named if named else _is_frequency(name))]
    if len(columns) != 1:
        got = " and ".join(sheet.names[k] for k in columns) or "none"
        step = f'Name it in {sheet.where.file}.toml: frequency = "{sheet.names[0]}"'
        raise StapeskitError.of("the column of frequencies", "one", got, sheet.where, step)
    name = sheet.names[columns[0]]
    in_name = [word for word in WORD.findall(name) if word.lower() in HERTZ]
    unit = mapping.frequency_unit or sheet.units[columns[0]] or "".join(in_name[:1])
    if unit and unit.lower() not in HERTZ:
        raise StapeskitError.of("the unit of the frequencies", "Hz, kHz or MHz", shown(unit), sheet.where)
    freq = sheet.numbers[:, columns[0]] * HERTZ[(unit or "Hz").lower()]
    if not len(freq) or not np.all((freq >= 0.0) & (freq < np.inf)) or len(np.unique(freq)) < len(freq):
        want, step = "different, finite and not negative", "Write one row a frequency"
        raise StapeskitError.of("the frequencies", want, "others", sheet.where, step)
    if not unit and freq.max() <= LOWEST_AUDIBLE_TOP_HZ:
        got = f"none, with frequencies from {freq.min():g} to {freq.max():g}"
        step = f'Write "{name} [kHz]" or "[Hz]" in the header'
        raise StapeskitError.of("the unit of the frequencies", "stated", got, sheet.where, step)
    return np.asarray(freq)


def _row(sheet: Sheet, one: BeamValues, freq: Array, mapping: Mapping, stem: str) -> Row:
    """Return one beam at one point."""
    beam, unit = one.beam, one.unit
    vector = unknown_vector()
    if beam.direction:
        vector = direction_of(beam.direction, sheet.where.file, "the direction of a signal")
    sd, coherence = (
        sheet.numbers[:, beam.columns[part]] if part in beam.columns else None for part in ("sd", "coherence")
    )
    channel = Channel(
        plain_name(beam.point) or stem, beam.body, beam.run, order=unit.order, per=unit.per,
        direction=vector, where=sheet.where,
    )  # fmt: skip
    value = one.value.conj() if mapping.convention == "-" else one.value
    return Row(channel, freq, value, None if sd is None else sd * one.scale, coherence, beam.n_avg)

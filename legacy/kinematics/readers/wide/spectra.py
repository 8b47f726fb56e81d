"""Read wide tables, as spreadsheets and scripts write them: ``Frequency [Hz], Vx Mag [m/s], ...``.

The names give part, axis and point; where they do not, a mapping does (kinematics.readers.wide.mapping).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.mapping_file import mapping_of
from legacy.kinematics.readers.recording import (
    Recording,
    Recordings,
    from_parts,
    from_polar,
    scaled,
    unknown_vector,
)
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.unit_labels import MOTIONS, MotionUnit, motion_unit, phase_scale
from legacy.kinematics.readers.value_checks import check_frequencies
from legacy.kinematics.readers.wide.columns import (
    HERTZ,
    Beam,
    beams_of,
    frequency_unit,
    is_frequency,
    looks_wide,
)
from legacy.kinematics.readers.wide.mapping import mapped_beams, plain_name, read_mapping
from legacy.kinematics.readers.wide.sheet import Sheet, header_of, read_sheet
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.frames import axis_vector
from legacy.stapeskit.warnings import Notice


def is_wide(text: str) -> bool:
    """Return whether a text begins as a wide table with telling names of columns."""
    header = header_of(text)
    return header is not None and looks_wide(header[1])


def read(path: Path, mapping: Path | None = None) -> Recordings:
    """Read a wide table.

    Parameters
    ----------
    mapping : Path, optional
        Which column is what; ``<path>.toml`` is taken by itself when it exists.

    Raises
    ------
    KinematicsError
        Cells that are no numbers, missing columns, a magnitude without phase, a unit that is no motion.
    """
    path = Path(path)
    sheet = read_sheet(path)
    mapping = mapping_of(path, mapping)
    document: dict[str, Any] = {} if mapping is None else read_mapping(mapping)
    beams, unused = beams_of(sheet.names)
    if document:
        beams, unused = mapped_beams(document["signal"], sheet.names, sheet.file), []
    freq = _frequencies(sheet, document)
    if np.all(np.diff(freq) < 0.0):  # measured from high to low
        sheet, freq = replace(sheet, numbers=sheet.numbers[::-1]), freq[::-1]
    check_frequencies(freq, sheet.place(), step="Sort the rows, one a frequency")
    faults: list[Fault] = []
    recordings = []
    stated = {document.get("amplitude", "")} if document else set()
    for beam in beams:
        with collect_faults(faults):
            recording, amplitude = _recording(sheet, beam, freq, document, path.stem)
            recordings.append(recording)
            stated.add(document.get("amplitude", "") or amplitude)
    raise_all(KinematicsError, list(dict.fromkeys(faults)))
    notices: tuple[Notice, ...] = ()
    if unused:
        text = f"{path.name}: columns that say no part of a signal were left out: {', '.join(unused[:12])}."
        notices = (Notice("columns_ignored", text),)
    return Recordings(tuple(recordings), notices, "columns by their names", amplitude_stated="" not in stated)


def _frequencies(sheet: Sheet, document: dict[str, Any]) -> Array:
    """Return the column of frequencies, Hz."""
    named = plain_name(document.get("frequency", ""))
    columns = [k for k, name in enumerate(sheet.names) if (name == named if named else is_frequency(name))]
    if len(columns) != 1:
        got = "none" if not columns else " and ".join(sheet.names[k] for k in columns)
        step = f'Name it in {sheet.file}.toml: frequency = "{sheet.names[0]}"'
        raise KinematicsError.of("the column of frequencies", "one", got, sheet.place(), step)
    in_header = sheet.units[columns[0]] or frequency_unit(sheet.names[columns[0]])
    unit = document.get("frequency_unit", "") or in_header or "Hz"
    if unit.lower() not in HERTZ:
        raise KinematicsError.of(
            "the unit of the frequencies", "Hz, kHz or MHz", shown(unit), sheet.place(columns[0])
        )
    return np.asarray(sheet.numbers[:, columns[0]] * HERTZ[unit.lower()])


def _recording(
    sheet: Sheet, beam: Beam, freq: Array, document: dict[str, Any], stem: str
) -> tuple[Recording, str]:
    """Return one beam at one point, and whether its unit says ``peak`` or ``rms``."""
    value, first = _complex(sheet, beam)
    unit, amplitude = _unit(sheet, beam, first)
    amplitude = document.get("amplitude", "") or amplitude
    if document.get("convention", "+") == "-":
        value = value.conj()
    scale = unit.scale * (np.sqrt(2.0) if amplitude == "rms" and not unit.per else 1.0)

    def column(part: str) -> Array | None:
        return sheet.numbers[:, beam.columns[part]] if part in beam.columns else None

    sd = column("sd")
    return Recording(
        beam.point or stem, freq, scaled(value, scale), unit.order, sheet.place(first), beam.run, beam.body,
        direction=_direction(beam, sheet), sd=None if sd is None else sd * scale,
        coherence=column("coherence"), n_avg=None if beam.n_avg is None else float(beam.n_avg), per=unit.per,
    ), amplitude  # fmt: skip


def _complex(sheet: Sheet, beam: Beam) -> tuple[NDArray[np.complex128], int]:
    """Return the values of a beam in its unit, and the column that says the unit."""
    parts = beam.columns
    if {"re", "im"} <= set(parts):
        return from_parts(sheet.numbers[:, parts["re"]], sheet.numbers[:, parts["im"]]), parts["re"]
    if {"amp", "phase"} <= set(parts):
        label = beam.phase_unit or sheet.units[parts["phase"]] or "deg"
        turn = phase_scale(label)
        if turn is None:
            raise KinematicsError.of(
                "the unit of the phase", "deg or rad", shown(label), sheet.place(parts["phase"])
            )
        return from_polar(sheet.numbers[:, parts["amp"]], sheet.numbers[:, parts["phase"]], turn), parts[
            "amp"
        ]
    lone = next(iter(parts.values()))
    want = "with its phase, or a real part with its imaginary part"
    step = f"Export both, or say in {sheet.file}.toml which column is what (docs/vibrometer_files.md)"
    raise KinematicsError.of(f"the column {sheet.names[lone]}", want, "alone", sheet.place(lone), step)


def _unit(sheet: Sheet, beam: Beam, column: int) -> tuple[MotionUnit, str]:
    """Return the unit of a beam, and ``peak`` or ``rms`` where it says so."""
    label = beam.unit or sheet.units[column]
    words = label.replace("_", " ").split()
    kinds = {"pk": "peak", "peak": "peak", "rms": "rms"}
    amplitude = next((kinds[word.lower()] for word in words if word.lower() in kinds), "")
    unit = motion_unit(" ".join(word for word in words if word.lower() not in kinds))
    if unit is None:
        got = shown(label) if label else "none"
        step = f'Write it behind the name, "{sheet.names[column]} [mm/s]", or as unit in {sheet.file}.toml'
        raise KinematicsError.of(
            f"the unit of {sheet.names[column]}", "; ".join(MOTIONS), got, sheet.place(), step
        )
    return unit, amplitude


def _direction(beam: Beam, sheet: Sheet) -> Array:
    """Return the unit vector towards the laser head, NaN where nothing says it."""
    stated = beam.direction
    if stated == "":
        return unknown_vector()
    if isinstance(stated, str) and stated.lower().lstrip("+-") in ("x", "y", "z"):
        return np.asarray(axis_vector(stated.lower()))
    if isinstance(stated, list) and len(stated) == 3 and all(isinstance(v, int | float) for v in stated):
        return np.array(stated, dtype=float)
    step = 'Write direction = "z", or three numbers'
    raise KinematicsError.of(
        "the direction of a signal", "x, -y ... or three numbers", stated, sheet.file, step
    )

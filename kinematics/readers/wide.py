"""Read tables over frequency: ``Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...``.

The names of the columns give part, axis, point and unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from kinematics.readers.in_si import DECIBELS
from kinematics.readers.recording import Recording, Row, from_parts, from_polar
from kinematics.readers.sheets import Sheet, sheets_of
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.text import plain_name
from kinematics.readers.units import HERTZ, PHASES, motion_unit
from stapeskit.arrays import Array
from stapeskit.faults import Fault, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.tables import decoded
from stapeskit.warnings import Notice

PARTS = {
    "re": ("re", "real", "realteil", "réel", "réelle"),
    "im": ("im", "imag", "imaginary", "imaginär", "imaginärteil", "imaginaire"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag", "module"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
FREQUENCIES = ("frequency", "freq", "frequenz", "fréquence", "f")

_MOST_RADIANS = 100.0  # 16 turns: phases that were unwrapped reach no further, degrees nearly always do
_WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?(?:\d+\.0+(?!\w)|[^\W_]+)")
_OF_POINT = ("point", "pt", "punkt", "node")
_AMPLITUDES = ("rms", "eff")
_FILLERS = (
    *_OF_POINT, *_AMPLITUDES, "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc",
    "acceleration", "axis", "channel", "of", "part", "partie", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a wide table.

    Raises
    ------
    StapeskitError
        Missing columns, a magnitude without phase, units of phases that are not stated where they are
        ambiguous; as `rows_of`.
    """
    path, faults = Path(path), list[Fault]()
    sheets = sheets_of(decoded(path.read_bytes()), path.name, faults)
    raise_all(faults)
    if len(sheets) > 1:
        raise sheets[0].refuse("the file", "of one table", f"{len(sheets)}", "Give a file for each")
    rows, unused = rows_of(sheets[0], *frequencies_of(sheets[0]))
    rows = [replace(row, point=row.point or path.stem, lines=sheets[0].lines) for row in rows]
    notices, unused = left_out_notices(sheets), [one for one in unused if one and not is_frequency(one)]
    if unused:
        text = f"{path.name}: columns that name no part of a signal were left out: {list_some(unused, 12)}."
        notices.append(Notice("file_read", text))
    return Recording(path.name, tuple(rows), tuple(notices), "columns by their names")


def left_out_notices(sheets: Iterable[Sheet]) -> list[Notice]:
    """Report the rows that begin with # and were not read."""
    places = [str(replace(sheet.where, numbers=sheet.left_out)) for sheet in sheets if sheet.left_out]
    text = f"rows that begin with # were left out: {list_some(places)}."
    return [Notice("file_read", text)] if places else []


def is_frequency(name: str) -> bool:
    """Return whether a column is named as that of the frequencies."""
    words = [word.lower() for word in _WORD.findall(name)]
    return bool(words) and words[0] in FREQUENCIES and set(words[1:]) <= {*HERTZ, "axis"}


def meaning(name: str) -> tuple[str, str, str] | None:
    """Return part, point and axis of a column's name; None where the part is missing or ambiguous."""
    part, axis, rest = "", "", []
    for before, word in pairwise(["", *_WORD.findall(name)]):
        low = word.lower()
        known = next((key for key, words in PARTS.items() if low in words), "")
        turned = _AXIS.fullmatch(low)
        if (known and part) or (turned and axis):
            return None
        if known:
            part = known
        elif turned:
            axis = turned[1].replace("+", "") + turned[2]
        elif low not in _FILLERS or (len(low) == 1 and before.lower() in _OF_POINT):
            numbered = _POINT.fullmatch(low)
            rest.append(numbered[1] if numbered else word.lstrip("+-"))
    return (part, " ".join(rest), axis) if part else None


def rows_of(sheet: Sheet, freq: Array, freq_unit: str = "Hz") -> tuple[list[Row], list[str]]:
    """Return the beams that the names of columns describe, and the names that describe none.

    The last axis of the numbers of the table are its columns; the others are those of the values.

    Raises
    ------
    StapeskitError
        No pair of real and imaginary part or magnitude and phase; one part alone or twice; parts in two
        units; negative magnitudes; phases without a unit that may be radians as well as degrees.
    """
    by_beam: dict[tuple[str, str], dict[str, int]] = {}
    unknown, twice = list[str](), list[str]()
    for column, name in enumerate(sheet.names):
        meant = meaning(name)
        if meant is None:
            unknown.append(name)
        elif meant[0] in by_beam.get(meant[1:], {}):
            twice.append(name)
        else:
            by_beam.setdefault(meant[1:], {})[meant[0]] = column
    if not by_beam:
        want, step = "real and imaginary part, or magnitude and phase", "Export them of every point"
        raise sheet.refuse("the columns", want, ", ".join(sheet.names), step)
    if twice:
        step = "Keep one signal of one excitation, or name points and axes apart"
        raise sheet.refuse("the parts of a beam", "there once", f"{list_some(twice, 6)} again", step)
    faults = _phase_faults(sheet, [parts["phase"] for parts in by_beam.values() if "phase" in parts])
    rows = []
    for (point, axis), parts in by_beam.items():
        with collect_faults(faults):
            row = replace(_row(sheet, parts), point=plain_name(point), freq_hz=freq, freq_unit=freq_unit)
            direction = axis_vector(axis)
            rows.append(row if direction is None else replace(row, direction=direction))
    raise_all(faults)
    return rows, unknown


def _row(sheet: Sheet, parts: dict[str, int]) -> Row:
    """Return the values of one beam from the columns of its parts."""
    pair = [name for name in ("re", "im", "amp", "phase") if name in parts]
    if pair not in (["re", "im"], ["amp", "phase"]):
        thing = f"the column {sheet.names[next(iter(parts.values()))]}"
        want = "with its phase, or a real part with its imaginary part"
        raise sheet.refuse(thing, want, "alone", "Export both, with points and axes named alike")
    (one, other), polar = (parts[name] for name in pair), pair[0] == "amp"
    first, second = sheet.numbers[..., one], sheet.numbers[..., other]
    unit, turn = sheet.units[one], PHASES.get((sheet.units[other] or "deg").lower())
    if polar and np.any(first < 0.0) and motion_unit(unit):
        raise sheet.refuse("the magnitudes", "linear, from 0 on", f"{np.nanmin(first):g}", DECIBELS)
    if not polar and unit != sheet.units[other]:
        raise sheet.refuse("real and imaginary part", "in one unit", f"{unit} and {sheet.units[other]}")
    if polar and turn is None:
        raise sheet.refuse("the unit of the phases", "deg or rad", sheet.units[other])
    gamma = parts.get("coherence")
    percent = gamma is not None and sheet.units[gamma] == "%"
    words = _WORD.findall(f"{sheet.field_of(('signal',))} {sheet.names[one]}".lower())
    return Row(
        "",
        np.empty(0),
        from_polar(first, second, turn or 1.0) if polar else from_parts(first, second),
        f"{unit} rms" if not set(words).isdisjoint(_AMPLITUDES) and unit else unit,
        coherence=None if gamma is None else sheet.numbers[..., gamma] * (0.01 if percent else 1.0),
        where=sheet.where,
        source=sheet.names[one],
    )


def _phase_faults(sheet: Sheet, phases: list[int]) -> list[Fault]:
    """Refuse phases without a unit that may be radians as well as degrees."""
    silent = [column for column in phases if not sheet.units[column]]
    largest = float(np.max(np.nan_to_num(np.abs(sheet.numbers[..., silent])), initial=0.0))
    if not 0.0 < largest <= _MOST_RADIANS:
        return []
    got = f"none, with all phases within {largest:.4g}: degrees or radians"
    step = f'Write "{sheet.names[silent[0]]} [rad]" or "[deg]" in the header'
    return [Fault("the unit of the phases", "stated", got, sheet.where, step)]


def frequencies_of(sheet: Sheet) -> tuple[Array, str]:
    """Return the column of frequencies and its unit, empty where none is stated.

    Raises
    ------
    StapeskitError
        There is none, or there are several.
    """
    columns = [column for column, name in enumerate(sheet.names) if is_frequency(name)]
    if len(columns) != 1:
        got = " and ".join(sheet.names[k] for k in columns) or f"none of {', '.join(sheet.names)}"
        step = 'Export spectra, and name their column "Frequency [Hz]"'
        raise sheet.refuse("the column of frequencies", "one", got, step)
    name, unit = sheet.names[columns[0]], sheet.units[columns[0]]
    return sheet.numbers[:, columns[0]], unit or next(
        (w for w in _WORD.findall(name) if w.lower() in HERTZ), ""
    )

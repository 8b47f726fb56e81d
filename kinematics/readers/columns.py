"""Columns of numbers with names like ``P1 Vx Mag [mm/s]`` or ``Real X``: which beams they hold, in SI."""

from __future__ import annotations

import re
from collections.abc import Mapping as Names
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kinematics.readers.recording import from_parts, from_polar, scaled
from kinematics.readers.text import shown
from kinematics.readers.units import PHASES, MotionUnit, motion_unit, split_amplitude, unit_fault
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, raise_all

PARTS = {
    "re": ("re", "real", "realteil", "réel", "réelle"),
    "im": ("im", "imag", "imaginary", "imaginär", "imaginärteil", "imaginaire"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag", "module"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?[^\W_]+")

_FILLERS = (
    "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc", "acceleration",
    "point", "pt", "punkt", "node", "axis", "channel", "of", "part", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
_UNIT = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*$")
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")


@dataclass(frozen=True)
class Sheet:
    """A table: place of its line of names, names and units of its columns, numbers, ``Name: value`` lines."""

    where: Place
    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: Array
    fields: Names[str, str] = field(default_factory=dict)

    def field_of(self, names: Sequence[str]) -> str:
        """Return the value of the first ``Name: value`` line that is there; empty without one."""
        return next((self.fields[name] for name in names if name in self.fields), "")


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


@dataclass(frozen=True)
class BeamValues:
    """A beam with its values (row,) in SI, their unit, the factor to SI, and ``peak``, ``rms`` or nothing."""

    beam: Beam
    value: ComplexArray
    unit: MotionUnit
    scale: float
    amplitude: str


def name_and_unit(cell: str) -> tuple[str, str]:
    """Split ``Real X [m/s]`` into the name and the unit, which is empty without one."""
    match = _UNIT.search(cell)
    return (
        (cell[: match.start()].strip(), (match[1] or match[2] or "").strip()) if match else (cell.strip(), "")
    )


def meaning(name: str) -> tuple[str, str, str] | None:
    """Return the part, point and axis that a name says; None where it says no part, or two of a kind."""
    part, axis, rest = "", "", []
    for word in WORD.findall(name):
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


def beams_of(names: Sequence[str]) -> tuple[list[Beam], list[int]]:
    """Return the beams that the column names describe, and which columns describe none."""
    by_beam: dict[tuple[str, str], dict[str, int]] = {}
    unknown = []
    for column, name in enumerate(names):
        parts = meaning(name)
        if parts is None or parts[0] in by_beam.get(parts[1:], {}):
            unknown.append(column)
        else:
            by_beam.setdefault(parts[1:], {})[parts[0]] = column
    return [Beam(columns, point, axis) for (point, axis), columns in by_beam.items()], unknown


def values_of(sheet: Sheet, beams: Sequence[Beam], amplitude: str = "") -> list[BeamValues]:
    """Return the complex values of beams in SI; ``amplitude`` says peak or rms for all of them.

    Raises
    ------
    StapeskitError
        A part without its other, a unit that is no motion, phases whose unit is not stated and may be degrees
        or radians, peak beside rms; all faults together.
    """
    faults = _phase_faults(sheet, beams)
    found: list[BeamValues] = []
    without_unit: dict[str, list[str]] = {}
    for beam in beams:
        with collect_faults(faults):
            value, first = _complex(sheet, beam)
            stated = beam.unit or sheet.units[first]
            label, kind = split_amplitude(stated)
            unit, kind = motion_unit(label), amplitude or kind
            if unit is None:
                without_unit.setdefault(stated, []).append(sheet.names[first])
                continue
            scale = unit.scale * (2.0**0.5 if kind == "rms" and not unit.per else 1.0)
            found.append(BeamValues(beam, scaled(value, scale), unit, scale, kind))
    for label, names in without_unit.items():
        step = f'Export velocity or displacement on a linear scale, with the unit: "{names[0]} [mm/s]"'
        faults.append(unit_fault(shown(label), names, sheet.where, step))
    kinds = sorted({one.amplitude for one in found})
    if len(kinds) > 1:
        got, step = " and ".join(kind or "neither" for kind in kinds), "Write peak or rms into all units"
        faults.append(Fault("the units of the amplitudes", "all peak or all rms", got, sheet.where, step))
    raise_all(faults)
    return found


def _phase_faults(sheet: Sheet, beams: Sequence[Beam]) -> list[Fault]:
    """Refuse phases without a unit that may be radians as well as degrees."""
    columns = [beam.columns["phase"] for beam in beams if "phase" in beam.columns and not beam.phase_unit]
    silent = [column for column in columns if not sheet.units[column]]
    largest = float(np.max(np.nan_to_num(np.abs(sheet.numbers[:, silent])), initial=0.0))
    if not 0.0 < largest <= np.pi + 1e-3:
        return []
    got = f"none, with all phases within {largest:.4g}: degrees or radians"
    step = f'Write "{sheet.names[silent[0]]} [rad]" or "[deg]" in the header'
    return [Fault("the unit of the phases", "stated", got, sheet.where, step)]


def _complex(sheet: Sheet, beam: Beam) -> tuple[ComplexArray, int]:
    """Return the values of a beam in its unit, and the column that says the unit."""
    parts, numbers = beam.columns, sheet.numbers
    if {"re", "im"} <= set(parts):
        if sheet.units[parts["re"]] != sheet.units[parts["im"]]:
            got = " and ".join(shown(sheet.units[parts[part]]) or "none" for part in ("re", "im"))
            raise StapeskitError.of("real and imaginary part", "in one unit", got, sheet.where)
        return from_parts(numbers[:, parts["re"]], numbers[:, parts["im"]]), parts["re"]
    if {"amp", "phase"} <= set(parts):
        label = beam.phase_unit or sheet.units[parts["phase"]] or "deg"
        if label.lower() not in PHASES:
            raise StapeskitError.of("the unit of the phases", "deg or rad", shown(label), sheet.where)
        value = from_polar(numbers[:, parts["amp"]], numbers[:, parts["phase"]], PHASES[label.lower()])
        return value, parts["amp"]
    lone = sheet.names[next(iter(parts.values()))]
    want = "with its phase, or a real part with its imaginary part"
    step = "Export both, or state in a mapping which column is what (docs/vibrometer_files.md)"
    raise StapeskitError.of(f"the column {lone}", want, "alone", sheet.where, step)

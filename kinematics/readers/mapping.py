"""The meaning of each column or variable of a file, from its mapping in TOML or from a reader.

``ldv.csv.toml`` beside ``ldv.csv``, or ``--mapping``; docs/vibrometer_files.md has the keys with examples.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable
from collections.abc import Mapping as Names
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from kinematics.readers.gather import from_parts, from_polar
from kinematics.readers.units import PHASES
from stapeskit.arrays import ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, raise_all

_CHOICES = {
    "frequency_unit": ("Hz", "kHz", "MHz"),
    "amplitude": ("peak", "rms"),
    "convention": ("+", "-"),
    "position_unit": ("m", "mm", "um"),
    "phase_unit": tuple(PHASES),
}
_NUMBERS = {"direction": (str, list), "n_avg": (str, int, float)}
_PAIRS = (("value",), ("value_re", "value_im"), ("magnitude", "phase"))


@dataclass(frozen=True)
class Signal:
    """One beam: names of columns or variables; empty where there is none.

    ``value`` is complex, or there are ``value_re`` and ``value_im``, or ``magnitude`` and ``phase``.
    """

    value: str = ""
    value_re: str = ""
    value_im: str = ""
    magnitude: str = ""
    phase: str = ""
    direction: Any = ""
    unit: str = ""
    phase_unit: str = ""
    point: str = ""
    coherence: str = ""
    sd: str = ""
    n_avg: Any = ""
    run: str = ""
    body: str = ""

    @property
    def parts(self) -> tuple[str, ...]:
        """Columns or variables of the value."""
        names = (self.value, self.value_re, self.value_im, self.magnitude, self.phase)
        return tuple(name for name in names if name)

    @property
    def name(self) -> str:
        """The first of its columns or variables, for messages."""
        return self.parts[0] if self.parts else self.coherence

    def values(
        self, numbers: Callable[[str], NDArray[Any]], phase_unit: str, where: Place | str
    ) -> ComplexArray:
        """Return the complex values in their unit.

        Parameters
        ----------
        numbers : callable
            Takes the name of a column or variable and returns its array.
        phase_unit : str
            One of `PHASES`.

        Raises
        ------
        StapeskitError
            A part without its other, or of another size; another unit of phases.
        """
        if self.value:
            return numbers(self.value).astype(complex)
        if len(self.parts) != 2 or self.parts not in (
            (self.value_re, self.value_im),
            (self.magnitude, self.phase),
        ):
            want = "with its phase, or a real part with its imaginary part"
            step = "Export both, or state in a mapping which column is what (docs/vibrometer_files.md)"
            raise StapeskitError.of(f"the column {self.name}", want, "alone", where, step)
        one, other = map(numbers, self.parts)
        if one.shape != other.shape:
            raise StapeskitError.of(f"{' and '.join(self.parts)}", "of one size", "others", where)
        if self.value_re:
            return from_parts(one, other)
        if phase_unit.lower() not in PHASES:
            raise StapeskitError.of("the unit of the phases", "deg or rad", phase_unit, where)
        return from_polar(one, other, PHASES[phase_unit.lower()])


@dataclass(frozen=True)
class Mapping:
    """Which column or variable is what; ``convention`` ``-`` is e^{-iwt}."""

    frequency: str = ""
    frequency_unit: str = ""
    position: str = ""
    position_unit: str = ""
    points: str = ""
    amplitude: str = ""
    convention: str = "+"
    body: str = ""
    run: str = ""
    signal: tuple[Signal, ...] = ()


def mapping_beside(path: Path, given: Path | None = None) -> Path | None:
    """Return the mapping of a file: the one given, or ``<path>.toml`` where it exists."""
    beside = path.with_name(path.name + ".toml")
    return beside if given is None and beside.is_file() else given


def read_mapping(path: Path) -> Mapping:
    """Read a mapping.

    Raises
    ------
    StapeskitError
        No TOML, an unknown key (the nearest is named), a value of the wrong kind, no frequency or no signal;
        all faults together.
    """
    try:
        document = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (OSError, ValueError) as fault:
        got = getattr(fault, "strerror", None) or fault
        raise StapeskitError.of("--mapping", "a TOML file", got, path.name) from fault
    signals = document.pop("signal", [])
    faults = _faults(document, Mapping, path.name)
    if not document.get("frequency"):
        faults.append(Fault("frequency", "the name of a column or variable", "none", path.name))
    if not isinstance(signals, list) or not signals or not all(isinstance(entry, dict) for entry in signals):
        faults.append(Fault("a mapping", "of at least one [[signal]]", "none", path.name))
        signals = []
    for number, entry in enumerate(signals, 1):
        where = f"{path.name}, signal {number}"
        faults += _faults(entry, Signal, where)
        if not any(all(entry.get(key) for key in pair) for pair in _PAIRS):
            wanted = "given as " + ", or as ".join(" and ".join(pair) for pair in _PAIRS)
            faults.append(Fault("the values of a signal", wanted, ", ".join(entry) or "none", where))
    raise_all(faults)
    return Mapping(**document, signal=tuple(Signal(**entry) for entry in signals))


def _faults(table: Names[str, Any], kind: type[Mapping | Signal], where: str) -> list[Fault]:
    """List keys that are not known, each with the nearest that is, and values of another kind."""
    names, faults = [entry.name for entry in fields(kind)], []
    for key, value in table.items():
        if key not in names:
            near = difflib.get_close_matches(key, names, 1)
            step = f"Did you mean {near[0]}?" if near else "Remove it"
            faults.append(Fault("a key", f"one of {', '.join(names)}", key, where, step))
        elif isinstance(value, bool) or not isinstance(value, _NUMBERS.get(key, (str,))):
            faults.append(Fault(key, "a text in quotes" if key not in _NUMBERS else "a number", value, where))
        elif value and value not in _CHOICES.get(key, (value,)):
            faults.append(Fault(key, f"one of {', '.join(_CHOICES[key])}", value, where))
    return faults

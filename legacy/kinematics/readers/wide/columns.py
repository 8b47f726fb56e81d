"""The meaning of the columns of a wide table by their names: ``P3 Vx Mag``, ``Point 3 - Vib Z - Real``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

PARTS = {
    "re": ("re", "real", "realteil"),
    "im": ("im", "imag", "imaginary", "imaginärteil"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6}
_FREQUENCY = ("frequency", "freq", "frequenz", "fréquence", "f")
# Words that name neither point nor axis nor part.
_FILLERS = (
    "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc", "acceleration",
    "point", "pt", "punkt", "node", "axis", "channel", "of", "part", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
# A table with one row a body, point, beam and frequency has one of these.
_TIDY = {"body", "dir", "dir_x", "freq_hz"}
_WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?[^\W_]+")
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")


@dataclass(frozen=True)
class Beam:
    """The columns of one beam at one point.

    Attributes
    ----------
    columns : dict of str to int
        Place of each part: ``re`` and ``im``, or ``amp`` and ``phase``; perhaps ``coherence`` and ``sd``.
    point : str
        Empty where the names do not say it.
    direction : Any
        ``x``, ``-y`` ... or three numbers; empty where the names do not say it.
    unit, phase_unit : str
        Empty: as in the header.
    """

    columns: dict[str, int] = field(default_factory=dict)
    point: str = ""
    direction: Any = ""
    unit: str = ""
    phase_unit: str = ""
    body: str = ""
    run: str = ""
    n_avg: float | None = None


def is_frequency(name: str) -> bool:
    """Return whether a column holds the frequencies."""
    words = [word.lower() for word in _WORD.findall(name)]
    return bool(words) and words[0] in _FREQUENCY and set(words[1:]) <= {*HERTZ, "axis"}


def frequency_unit(name: str) -> str:
    """Return the unit in the name of a column, such as khz of ``freq_khz``; empty without one."""
    return next((word for word in _WORD.findall(name) if word.lower() in HERTZ), "")


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


def looks_wide(names: Sequence[str]) -> bool:
    """Return whether names are those of a wide table: frequencies, and a pair of columns at least."""
    parts = {meant[0] for name in names if (meant := meaning(name))}
    if not _TIDY.isdisjoint(name.lower() for name in names):
        return False
    return any(map(is_frequency, names)) and ({"re", "im"} <= parts or {"amp", "phase"} <= parts)


def beams_of(names: Sequence[str]) -> tuple[list[Beam], list[str]]:
    """Return the beams that the column names describe, and the names that describe none."""
    by_beam: dict[tuple[str, str], dict[str, int]] = {}
    unknown = []
    for column, name in enumerate(names):
        parts = meaning(name)
        if parts is None or parts[0] in by_beam.get(parts[1:], {}):
            if not is_frequency(name):
                unknown.append(name)
            continue
        by_beam.setdefault(parts[1:], {})[parts[0]] = column
    return [Beam(columns, point, axis) for (point, axis), columns in by_beam.items()], unknown

"""Names of columns such as ``P1 Vx Mag`` or ``Real X``: which part of which beam they hold."""

from __future__ import annotations

import re
from collections.abc import Sequence

from kinematics.readers.mapping import Signal
from kinematics.readers.units import HERTZ

PARTS = {
    "re": ("re", "real", "realteil", "réel", "réelle"),
    "im": ("im", "imag", "imaginary", "imaginär", "imaginärteil", "imaginaire"),
    "amp": ("mag", "magnitude", "amp", "amplitude", "abs", "betrag", "module"),
    "phase": ("ph", "phase", "arg", "angle", "winkel"),
    "coherence": ("coh", "coherence", "gamma2", "kohärenz"),
}
FREQUENCIES = ("frequency", "freq", "frequenz", "fréquence", "f")

_FIELDS = {"re": "value_re", "im": "value_im", "amp": "magnitude"}
_WORD = re.compile(r"(?:(?<![^\s(\[])[+-])?[^\W_]+")
_FILLERS = (
    "v", "d", "a", "vib", "vel", "velocity", "disp", "displacement", "acc", "acceleration",
    "point", "pt", "punkt", "node", "axis", "channel", "of", "part", "frf", "fft", "h1", "spectrum",
)  # fmt: skip
_POINT = re.compile(r"(?:p|pt|point|punkt|node)(\d+)")
_AXIS = re.compile(r"([+-]?)[vdau]?([xyz])")


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters; a sign before a word belongs to it."""
    return [word.lower() for word in _WORD.findall(name)]


def is_frequency(name: str) -> bool:
    """Return whether a column is named as that of the frequencies."""
    words = words_of(name)
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


def signals_of(names: Sequence[str]) -> tuple[list[Signal], list[str]]:
    """Return the signals that the names of columns describe, and the names that describe none."""
    by_beam: dict[tuple[str, str], dict[str, str]] = {}
    unknown = []
    for name in names:
        parts = meaning(name)
        if parts is None or parts[0] in by_beam.get(parts[1:], {}):
            unknown.append(name)
        else:
            by_beam.setdefault(parts[1:], {})[parts[0]] = name
    signals = [
        Signal(point=point, direction=axis, **{_FIELDS.get(part, part): name for part, name in parts.items()})
        for (point, axis), parts in by_beam.items()
    ]
    return signals, unknown

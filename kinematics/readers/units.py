"""Units as measuring systems write them next to their numbers: ``m/s``, ``[ um/s / V ]``, ``(m/s^2)/N``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12, "in": 0.0254, "ft": 0.3048}
STANDARD_GRAVITY = 9.80665
"""m/s2, by definition (3rd CGPM, 1901)."""

HERTZ = {"hz": 1.0, "hertz": 1.0, "khz": 1e3, "mhz": 1e6}
PHASES = {
    **dict.fromkeys(("deg", "degree", "degrees", "grad", "°", "\ufffd"), math.pi / 180.0),  # grad: German
    **dict.fromkeys(("rad", "radian", "radians"), 1.0),
}
SI_UNITS = ("m", "m/s", "m/s2")
MOTIONS = "m, mm, um, nm; m/s, mm/s, um/s; m/s2, mm/s2, g [per N, V, Pa, A or unit of motion] [peak or rms]"

_RATES = {"s": 1, "sec": 1, "s2": 2, "sec2": 2}
_MARKS = (("µ", "u"), ("μ", "u"), ("²", "2"), ("¹", "1"), ("⁻", "-"), ("^", ""), ("**", ""), ("·", "*"))
_DENSITY = re.compile(r"/[(]?(?:√|sqrt|rt)?[(]?Hz[)]?(?:0?\.5|[(]?1/2[)]?)?[)]?$", re.IGNORECASE)
_PER_SECOND = re.compile(r"[*.]?s-([12])(?!\d)")  # as in m s-1
_AMPLITUDE = re.compile(  # alone or in brackets; peak to peak is none of them
    r"[\s_]*[\s_(\[]\s*((?:0-?)?(?:pk|peak)|0-p|(rms|eff))(?:\s*[)\]]|(?![\w-]))", re.IGNORECASE
)
_REFERENCE = re.compile(
    r"[pnumkM]?(?:N|V|Pa|A|W|bar|g|m(?:/s2?)?)|[Nn]ewtons?|[Vv]olts?|[Pp]ascals?|lbf|EU|(?:in|ft)(?:/s2?)?"
)


@dataclass(frozen=True)
class MotionUnit:
    """A unit of displacement, velocity or acceleration (``order`` 0, 1, 2); ``scale`` leads to m, m/s, m/s2.

    ``per`` is the unit of the reference as written, ``amplitude`` is ``peak`` or ``rms``; empty where the
    label does not say it.
    """

    order: int = 1
    scale: float = 1.0
    per: str = ""
    amplitude: str = ""

    @property
    def to_peak(self) -> float:
        """Factor to peak amplitudes; a response is a ratio, for which rms and peak are one."""
        return 2.0**0.5 if self.amplitude == "rms" and not self.per else 1.0


def is_none(label: str) -> bool:
    """Return whether a label says nothing."""
    return label.strip().strip("[]()").strip().lower() in ("", "none", "-", "1", "unknown")


def plain(label: str) -> str:
    """Write a label without brackets, spaces and the many ways to write micro, powers and per second."""
    text = label.strip().strip("[]").replace(" ", "")
    for old, new in _MARKS:
        text = text.replace(old, new)
    return _PER_SECOND.sub(lambda match: "/s2" if match[1] == "2" else "/s", text)


def motion_unit(label: str) -> MotionUnit | None:
    """Read a unit of motion; None when the label is no known one, or that of a density over frequency.

    What follows the unit of motion after a slash is the reference: ``m/s/V`` and ``(m/s)/V`` are responses
    in m/s per volt. The words peak and rms may be written behind it, also in brackets.
    """
    found = _AMPLITUDE.search(label)
    amplitude = "" if found is None else "rms" if found[2] else "peak"
    text = plain(_AMPLITUDE.sub("", label).replace("_", ""))
    if _DENSITY.search(text):
        return None
    if bracketed := re.fullmatch(r"\(([^()]+)\)(/.+)?", text):
        text = bracketed[1] + (bracketed[2] or "")
    first, *rest = text.split("/")
    order, scale = (2, STANDARD_GRAVITY) if first.lower() in ("g", "gn") else (0, LENGTHS.get(first, 0.0))
    while rest and rest[0].lower() in _RATES and order + _RATES[rest[0].lower()] <= 2:
        order += _RATES[rest.pop(0).lower()]
    per = re.sub(r"\((.*)\)", r"\1", "/".join(rest))
    known = scale > 0.0 and (not per or _REFERENCE.fullmatch(per))
    return MotionUnit(order, scale, per, amplitude) if known else None

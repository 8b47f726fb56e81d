"""Units as measuring systems write them next to their numbers: ``m/s``, ``[ um/s / V ]``, ``(m/s^2)/N``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

LENGTHS = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "nm": 1e-9,
    "pm": 1e-12,
    "in": 0.0254,
    "ft": 0.3048,
}
# m/s2, by definition (3rd CGPM, 1901).
STANDARD_GRAVITY = 9.80665
MOTIONS = ("m, mm, um, nm", "m/s, mm/s, um/s", "m/s2, mm/s2, g")
_DEGREES = ("deg", "degree", "degrees", "°", "\ufffd")
_PHASES = {
    **dict.fromkeys(_DEGREES, math.pi / 180.0),
    **dict.fromkeys(("rad", "radian", "radians"), 1.0),
}
_RATES = {"": 0, "s": 1, "s2": 2, "sec": 1, "sec2": 2}
_DENSITY = re.compile(r"/[(]?(?:√|sqrt|rt)?[(]?Hz[)]?(?:0?\.5|[(]?1/2[)]?)?[)]?$", re.IGNORECASE)
# As in m s-1 and m*s^-2.
_PER_SECOND = re.compile(r"[*.]?s-([12])(?!\d)")
_NONE = ("", "none", "-", "1", "unknown")


@dataclass(frozen=True)
class MotionUnit:
    """A unit of motion: time derivatives, factor to SI, and the unit of what it is a response to.

    Attributes
    ----------
    order : int
        0 displacement, 1 velocity, 2 acceleration.
    scale : float
        Factor to m, m/s, m/s2.
    per : str
        Unit of the reference as written; empty when there is no reference.
    """

    order: int
    scale: float
    per: str = ""


def is_none(label: str) -> bool:
    """Return whether a label says nothing."""
    return label.strip().strip("[]()").strip().lower() in _NONE


def plain(label: str) -> str:
    """Write a label without brackets, spaces and the many ways to write micro, powers and per second."""
    text = label.strip().strip("[]").replace(" ", "")
    marks = (("µ", "u"), ("μ", "u"), ("²", "2"), ("¹", "1"), ("⁻", "-"), ("^", ""), ("**", ""), ("·", "*"))
    for old, new in marks:
        text = text.replace(old, new)
    return _PER_SECOND.sub(lambda match: "/s2" if match[1] == "2" else "/s", text)


def motion_unit(label: str) -> MotionUnit | None:
    """Read a unit of motion; None when the label is no known one, or that of a density over frequency.

    Notes
    -----
    What follows the unit of motion after a slash is the reference: ``m/s/V`` and ``(m/s)/V`` are responses
    in m/s per volt.
    """
    text = plain(label)
    if _DENSITY.search(text):
        return None
    match = re.fullmatch(r"\((?P<motion>[^()]+)\)(?:/(?P<per>.+))?", text)
    if match is not None:
        inner = motion_unit(match["motion"])
        return (
            None
            if inner is None or inner.per
            else MotionUnit(inner.order, inner.scale, (match["per"] or "").strip("()"))
        )
    parts = text.split("/")
    if parts[0].lower() in ("g", "gn", "g_n"):
        return MotionUnit(2, STANDARD_GRAVITY, "/".join(parts[1:]))
    if parts[0] not in LENGTHS:
        return None
    scale = LENGTHS[parts[0]]
    if len(parts) > 1 and parts[1].lower() in _RATES and parts[1]:
        order, rest = _RATES[parts[1].lower()], parts[2:]
        if order == 1 and rest and rest[0].lower() in ("s", "sec"):
            order, rest = 2, rest[1:]
        return MotionUnit(order, scale, "/".join(rest).strip("()"))
    return MotionUnit(0, scale, "/".join(parts[1:]).strip("()"))


def phase_scale(label: str) -> float | None:
    """Return the factor of a unit of phase to radians; None when it is no known one."""
    return _PHASES.get(label.strip().lower())


def length_scale(label: str) -> float | None:
    """Return the factor of a length unit to metres; None when it is no known one."""
    return LENGTHS.get(plain(label).lower())

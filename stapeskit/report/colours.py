"""One colour for one thing: in figures, tables, pages and in three dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

PAGE_COLOURS: Mapping[str, str] = MappingProxyType(
    {"ink": "#1d2733", "soft": "#56636f", "line": "#d8dee5", "tint": "#f3f6f9", "accent": "#0a5f86"}
    | {"believe": "#2c8a57", "check": "#c98a12", "do-not-use": "#b3261e", "information": "#7d8fa1"}
)
"""Colours of the page and of verdicts on results."""

BODY_COLOURS: Mapping[str, str] = MappingProxyType(
    {"stapes": "#b06f12", "base": "#1b7581", "plate": "#1b7581", "other bone": "#6b4f96"}
)
"""Colours of bodies in curves, tables and surfaces; the plate is what moves as base."""

OTHER_COLOURS = ("#7a4fa3", "#3f7f4f", "#a33d6b", "#4d5d9c", "#8a6d1f", "#4d4d4d")

AXIS_COLOURS: Mapping[str, str] = MappingProxyType({"x": "#c0331c", "y": "#217a3c", "z": "#2450b4"})
"""Colours of the axes x, y, z and of what is along or about them."""

VERDICT_COLOURS: Mapping[str, str] = MappingProxyType(
    {
        "ok": "#2c8a57",
        "gain": "#c81e3a",
        "sign": "#d9480f",
        "direction": "#a3268a",
        "position": "#6d28d9",
        "noise": "#c98a12",
        "label_swap": "#0f6fb5",
        "drift": "#7c4a1e",
        "flexible": "#0b7285",
        "zeros": "#1d2733",
        "unused": "#8b96a3",
    }
)
"""Colours of the verdicts on channels and points."""

MEASURED, FITTED = "#1d2733", "#c81e3a"


def colour_of(body: str, bodies: Sequence[str] = ()) -> str:
    """Return the colour of a body by its name, else by its place among ``bodies``.

    >>> colour_of("stapes"), colour_of("malleus", ("stapes", "malleus", "incus"))
    ('#b06f12', '#7a4fa3')
    """
    if body in BODY_COLOURS:
        return BODY_COLOURS[body]
    others = [name for name in bodies if name not in BODY_COLOURS]
    return OTHER_COLOURS[(others.index(body) if body in others else 0) % len(OTHER_COLOURS)]


def lighten(colour: str, share: float = 0.45) -> str:
    """Return a colour mixed with a share of white: for areas beside lines of the colour itself.

    >>> lighten("#800000", 0.5)
    '#c08080'
    """
    parts = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return "#" + "".join(f"{round(part + share * (255 - part)):02x}" for part in parts)

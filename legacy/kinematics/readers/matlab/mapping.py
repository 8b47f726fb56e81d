"""The meaning of the variables of a MATLAB file: by a mapping (docs/vibrometer_files.md), or by their names.

Names with dots reach into structs: ``dat.N1.f``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.readers.mapping_file import read_mapping_file
from legacy.stapeskit.frames import axis_vector

FREQUENCIES = (
    "freq_hz",
    "freq",
    "frequency",
    "frequencies",
    "freqs",
    "f",
    "f_hz",
    "x",
    "freqp",
    "faxis",
    "fft_x",
)
_POSITIONS = (
    "xyz",
    "xyz_mm",
    "xyz_m",
    "xyz_um",
    "coord",
    "coords",
    "coordinates",
    "positions",
    "position",
    "position_mm",
)
_POINTS = (
    "points",
    "point",
    "names",
    "name",
    "label",
    "labels",
    "index",
    "indices",
    "indexes",
    "point_index",
    "pointindex",
)
_COHERENCES = ("coh", "coherence", "gamma2")
_COUNTS = ("n_avg", "navg", "averages", "n_averages")
_CHOICES = {"amplitude": ("peak", "rms"), "convention": ("+", "-"), "position_unit": ("m", "mm", "um")}
_BEAM = re.compile(r"^(?P<stem>.+?)_?(?P<axis>[xyzXYZ])$")


@dataclass(frozen=True)
class Signal:
    """One beam: names of variables, or values where they are no names."""

    value: str = ""
    value_re: str = ""
    value_im: str = ""
    direction: Any = ""
    unit: str = ""
    usd: str = ""
    coherence: str = ""
    sd: str = ""
    n_avg: Any = ""
    run: str = ""
    body: str = ""


@dataclass(frozen=True)
class Layout:
    """Which variable is what."""

    frequency: str = ""
    position: str = ""
    position_unit: str = ""
    points: str = ""
    amplitude: str = ""
    convention: str = "+"
    each: str = ""
    body: str = ""
    run: str = ""
    signal: tuple[Signal, ...] = field(default_factory=tuple)


def read_mapping(path: Path) -> Layout:
    """Read a mapping.

    Raises
    ------
    KinematicsError
        No TOML, an unknown key, a value of the wrong kind, or no frequency or signal.
    """
    keys = {entry.name: _CHOICES.get(entry.name, ()) for entry in fields(Layout) if entry.name != "signal"}
    texts = [entry.name for entry in fields(Signal) if entry.name not in ("direction", "n_avg")]
    pairs = (("value",), ("value_re", "value_im"))
    document = read_mapping_file(Path(path), keys, texts, pairs, ("frequency",))
    return Layout(**document | {"signal": tuple(Signal(**entry) for entry in document["signal"])})


def layout_of(space: Mapping[str, Any]) -> Layout | None:
    """Recognise variables by names and shapes; None when frequency or values are not found."""
    low = {name.lower(): name for name in reversed(list(space))}
    frequency = next((low[name] for name in FREQUENCIES if name in low and _is_axis(space[low[name]])), "")
    if not frequency:
        return None
    count = np.asarray(space[frequency]).size
    values = [name for name, value in space.items() if name != frequency and _is_value(name, value, count)]
    complex_ones = [name for name in values if np.iscomplexobj(stacked(space[name]))]
    named = [n for n in values if re.fullmatch(r"(y|amp|vib|fft|h1|h2|frf|data)?_?[xyz]?", n.lower())]
    chosen = complex_ones or [name for name in named if _beam_usd(name, space)]
    pairs = _pairs(space, count)
    if not chosen and not pairs:
        return None
    signals = [Signal(value=name) for name in chosen] or [Signal(value_re=a, value_im=b) for a, b in pairs]
    stems = [(_BEAM.match(signal.value or signal.value_re.rsplit("_", 1)[0])) for signal in signals]
    axes = [match["axis"].lower() if match else "" for match in stems]
    together = len(signals) > 1 and all(axes) and len(set(axes)) == len(axes)
    signal_list = []
    for entry, axis in zip(signals, axes, strict=True):
        end = axis if together else ""
        signal_list.append(
            Signal(
                entry.value,
                entry.value_re,
                entry.value_im,
                end,
                usd=_beam_usd(entry.value or entry.value_re, space),
                coherence=_coherence(end, space),
                n_avg=next((low[name] for name in _COUNTS if name in low), ""),
                unit=next(
                    (
                        f"={space[low[n]]}"
                        for n in ("unit", "yunit", "units")
                        if n in low and isinstance(space[low[n]], str)
                    ),
                    "",
                ),
                run="" if together or len(signals) == 1 else (entry.value or entry.value_re),
            )
        )
    return Layout(
        frequency,
        next((low[name] for name in _POSITIONS if name in low), ""),
        points=_point_names(space, low, signals[0], count),
        signal=tuple(signal_list),
    )


def _point_names(space: Mapping[str, Any], low: Mapping[str, str], signal: Signal, count: int) -> str:
    """Return the variable with one name or number for every row of the values."""
    shape = np.shape(stacked(space[signal.value or signal.value_re]))
    rows = shape[0] if shape[1] in (count, 2 * count) else shape[1]
    for name in _POINTS:
        names = space.get(low.get(name, ""), None)
        size = 1 if isinstance(names, str) else np.size(names) if isinstance(names, np.ndarray) else None
        if isinstance(names, list) and not any(isinstance(entry, (dict, list)) for entry in names):
            size = len(names)
        if size == rows:
            return low[name]
    return ""


def _is_axis(value: Any) -> bool:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or value.size < 2:
        return False
    flat = np.asarray(value, dtype=float).reshape(-1)
    return value.size == max(value.shape) and bool(np.all(np.diff(flat) > 0.0))


def stacked(value: Any) -> Any:
    """Return a cell array of rows as one array (point, F); other values as they are."""
    if not isinstance(value, list) or not value or not all(isinstance(entry, np.ndarray) for entry in value):
        return value
    sizes = {entry.size for entry in value if entry.size}
    if len(sizes) != 1:
        return value
    width = sizes.pop()
    kind = complex if any(np.iscomplexobj(entry) for entry in value) else float
    rows = [entry.reshape(-1).astype(kind) if entry.size else np.full(width, np.nan, kind) for entry in value]
    return np.array(rows)


def _is_value(name: str, value: Any, count: int) -> bool:
    value = stacked(value)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiuc" or value.ndim < 2:
        return False
    if name.lower().startswith((*_COHERENCES, "ref", "sd")) or name.lower() in _POSITIONS:
        return False
    return count in value.shape or 2 * count in value.shape


def _pairs(space: Mapping[str, Any], count: int) -> list[tuple[str, str]]:
    pairs = []
    for name in space:
        match = re.fullmatch(r"(.*?)_?(re|real)", name, re.IGNORECASE)
        if match is None:
            continue
        ends = {"re": "im", "real": "imag"}[match[2].lower()]
        other = name[: len(name) - len(match[2])] + (ends if match[2].islower() else ends.capitalize())
        if other in space and _is_value(name, space[name], count) and _is_value(other, space[other], count):
            pairs.append((name, other))
    return pairs


def _beam_usd(name: str, space: Mapping[str, Any]) -> str:
    """Return the name of the signal description that belongs to a value."""
    descriptions = [key for key, entry in space.items() if isinstance(entry, dict) and "YUnit" in entry]
    match = _BEAM.match(name)
    if match is not None:
        ends = [key for key in descriptions if key.lower().endswith(match["axis"].lower()) and len(key) > 1]
        if len(ends) == 1:
            return ends[0]
    return descriptions[0] if len(descriptions) == 1 else ""


def _coherence(axis: str, space: Mapping[str, Any]) -> str:
    for key in space:
        plain = key.lower()
        if any(plain in (name + (f"_{axis}" if axis else ""), name + axis) for name in _COHERENCES):
            return key
    return ""


def usd_direction(usd: Any) -> NDArray[np.float64] | None:
    """Return the direction of the first response DOF of a signal description: +-1, 2, 3 or its name."""
    dofs = usd.get("ResponseDOFs") if isinstance(usd, dict) else None
    first = dofs[0] if isinstance(dofs, list) and dofs else dofs
    code = first.get("Direction") if isinstance(first, dict) else None
    if isinstance(code, str):
        match = re.fullmatch(r"ptc(Plus|Minus)([XYZ])Translation", code)
        if match is None:
            return None
        return axis_vector(("+" if match[1] == "Plus" else "-") + match[2])
    number = np.asarray(code).reshape(-1) if code is not None else np.empty(0)
    if number.size == 1 and number.dtype.kind in "fiu" and abs(float(number[0])) in (1.0, 2.0, 3.0):
        return np.sign(float(number[0])) * np.eye(3)[int(abs(number[0])) - 1]
    return None

"""Recognise by names and shapes which variable of a MATLAB or HDF5 file is what, in structs too."""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Mapping as Names
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.mapping import Mapping, Signal
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some
from stapeskit.frames import axis_vector

FREQUENCIES = (
    "freq_hz", "freq", "frequency", "frequencies", "freqs", "f", "f_hz", "x", "freqp", "faxis", "fft_x",
)  # fmt: skip
POSITIONS = (
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
POINTS = ("points", "point", "names", "name", "label", "labels", "index", "indices", "indexes", "point_index")
COHERENCES = ("coh", "coherence", "gamma2")
COUNTS = ("n_avg", "navg", "averages", "n_averages")
UNITS = ("unit", "yunit", "units")
DIRECTIONS = ("direction", "directions", "dir")
_VALUE = re.compile(r"(y|amp|vib|fft|h1|h2|frf|data|value)?_?[xyz]?", re.IGNORECASE)
_BEAM = re.compile(r"(?P<stem>.+?)_?(?P<axis>[xyzXYZ])")
_PAIR = re.compile(r"(.*?)_?(re|real)", re.IGNORECASE)


@dataclass(frozen=True)
class Space:
    """Variables by name, of the file or of a struct before those around it; ``where`` is for messages."""

    names: Names[str, Any]
    where: str

    def within(self, fields: Names[str, Any], name: str) -> Space:
        """Return the fields of a struct, and for other names what is around it."""
        return Space(ChainMap(dict(fields), dict(self.names)), f"{self.where}, {name}")

    def first(self, wanted: tuple[str, ...]) -> str:
        """Return the first of some names that is there, in any case; empty without one."""
        low = {name.lower(): name for name in reversed(list(self.names))}
        return next((low[name] for name in wanted if name in low), "")

    def get(self, name: str) -> Any:
        """Return a variable; dots in its name reach into structs."""
        value: Any = self.names
        for part in name.split("."):
            if not isinstance(value, Names) or part not in value:
                step = f"It holds {describe(self.names)}"
                raise StapeskitError.of(
                    f"the variable {name}", "in the file", "no such one", self.where, step
                )
            value = value[part]
        return value

    def numbers(self, name: str, real: bool = False) -> NDArray[Any]:
        """Return an array of numbers."""
        value = np.asarray(self.get(name))
        if value.dtype.kind not in "fciub" or value.size == 0 or (real and np.iscomplexobj(value)):
            want = "an array of real numbers" if real else "an array of numbers"
            step = "State which variable is what in a mapping"
            raise StapeskitError.of(f"the variable {name}", want, "something else", self.where, step)
        return value

    def texts(self, name: str) -> list[str]:
        """Return the texts of a text, of a list of them, or of numbers."""
        value = self.get(name)
        if isinstance(value, str):
            return [part.strip() for part in value.split(";")]
        return [
            f"{one:g}" if isinstance(one, float) else str(one)
            for one in np.asarray(value).reshape(-1).tolist()
        ]


def describe(tree: Names[str, Any]) -> str:
    """List variables with their sizes, for messages."""
    kinds = (
        f"{name} ({' x '.join(map(str, np.shape(value)))})" if np.ndim(value) else name
        for name, value in tree.items()
    )
    return list_some(kinds, 12) or "none"


def layouts(space: Space, mapping: Mapping | None, depth: int = 0) -> list[tuple[Space, Mapping, str]]:
    """Return where spectra are (here, in structs, in elements of struct arrays), each with its layout."""
    layout = mapping or _recognise(space)
    if layout is not None:
        return [(space, layout, "")]
    found = []
    for name, value in space.names.items():
        if isinstance(value, Names):
            inner = layouts(space.within(value, name), None, depth + 1) if depth < 3 else []
            found += [(s, replace(one, run=name) if not depth else one, point) for s, one, point in inner]
        elif isinstance(value, list | np.ndarray) and all(isinstance(one, Names) for one in _some(value)):
            outer = Space({key: one for key, one in space.names.items() if key != name}, space.where)
            for number, one in enumerate(value, 1):
                part = outer.within(one, f"{name}({number})")
                if (layout := _recognise(part)) is not None:
                    found.append((part, layout, str(number)))
    runs = {layout.run for _, layout, _ in found}
    return (
        found
        if len(runs) > 1
        else [(space, replace(layout, run=""), point) for space, layout, point in found]
    )


def _some(value: Any) -> list[Any]:
    """Return the elements of a list or an object array; None for other arrays, which hold no structs."""
    return (
        list(value) or [None]
        if isinstance(value, list) or (value.dtype == object and value.ndim == 1)
        else [None]
    )


def _recognise(space: Space) -> Mapping | None:
    """Recognise variables by names and shapes; None when frequency or values are not found."""
    frequency = space.first(FREQUENCIES)
    axis = np.asarray(space.names.get(frequency))
    if not frequency or axis.dtype.kind not in "fiu" or axis.size < 2 or axis.size != max(axis.shape):
        return None
    skip = {frequency.lower(), *POSITIONS, *COHERENCES, *COUNTS, *DIRECTIONS}
    values = [
        name
        for name, value in space.names.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiuc" and axis.size in value.shape
        and name.lower() not in skip and not name.lower().startswith((*COHERENCES, "ref", "sd"))
    ]  # fmt: skip
    chosen = [Signal(value=name) for name in values if np.iscomplexobj(space.names[name])]
    if not chosen:
        chosen = [
            Signal(value_re=name, value_im=other) for name in values if (other := _imaginary(name, values))
        ]
    if not chosen:
        chosen = [Signal(value=name) for name in values if _VALUE.fullmatch(name) and usd_of(space, name)]
    if not chosen:
        return None
    beams = [_BEAM.fullmatch(re.sub(r"_?(re|real)$", "", one.name, flags=re.IGNORECASE)) for one in chosen]
    axes = [match["axis"].lower() if match else "" for match in beams]
    together = len(chosen) > 1 and all(axes) and len(set(axes)) == len(axes)
    unit, position = space.first(UNITS), space.first(POSITIONS)
    unit = unit if isinstance(space.names.get(unit), str) else ""
    signals = []
    for one, name in zip(chosen, axes, strict=True):
        end = name if together else ""
        coherence = (
            space.first(tuple(f"{word}{mark}{end}" for word in COHERENCES for mark in ("_", "")))
            if end
            else ""
        )
        signals.append(
            replace(
                one,
                direction=end or space.first(DIRECTIONS),
                unit=str(space.names[unit]) if unit else "",
                coherence=coherence or space.first(COHERENCES),
                sd=space.first(("sd",)),
                n_avg=space.first(COUNTS),
                run="" if together or len(chosen) == 1 else one.name,
            )
        )
    amplitude = space.names.get(space.first(("amplitude",)))
    rows = _rows_of(np.shape(space.names[chosen[0].name]), axis.size)
    names = space.first(POINTS)
    fits = bool(names) and len(space.texts(names)) == rows
    stated = str(amplitude) if amplitude in ("peak", "rms") else ""
    body = space.first(("body",))
    return Mapping(
        frequency,
        position=position,
        points=names if fits else "",
        amplitude=stated,
        signal=tuple(signals),
        body=body,
    )


def _rows_of(shape: tuple[int, ...], count: int) -> int:
    return 1 if len(shape) == 1 else shape[0] if shape[1] == count else shape[1]


def _imaginary(name: str, names: list[str]) -> str:
    """Return the name of the imaginary part that belongs to a real part; empty without one."""
    match = _PAIR.fullmatch(name)
    if match is None:
        return ""
    stem, end = name[: len(name) - len(match[2])], {"re": "im", "real": "imag"}[match[2].lower()]
    return next((other for other in names if other.lower() == f"{stem}{end}".lower()), "")


def usd_of(space: Space, name: str) -> Names[str, Any]:
    """Return the signal description of GetPointData that belongs to a value; empty without one."""
    known = {key: one for key, one in space.names.items() if isinstance(one, Names) and "YUnit" in one}
    match = _BEAM.fullmatch(name)
    ends = [
        key for key in known if match and len(key) > 1 and key.lower().endswith(f"_{match['axis'].lower()}")
    ]
    if len(ends) == 1:
        return known[ends[0]]
    return next(iter(known.values())) if len(known) == 1 else {}


def usd_direction(usd: Names[str, Any]) -> Array | None:
    """Return the direction of the first response that a signal description names; None without one."""
    dofs = usd.get("ResponseDOFs")
    dofs = dofs[0] if isinstance(dofs, list | np.ndarray) and len(dofs) else dofs
    code = dofs.get("Direction") if isinstance(dofs, Names) else None
    if isinstance(code, str):
        match = re.fullmatch(r"ptc(Plus|Minus)([XYZ])Translation", code)
        return axis_vector(("+" if match[1] == "Plus" else "-") + match[2]) if match else None
    number = np.asarray(code if code is not None else 0).reshape(-1)
    if number.size == 1 and number.dtype.kind in "fiu" and abs(float(number[0])) in (1.0, 2.0, 3.0):
        return np.asarray(np.sign(float(number[0])) * np.eye(3)[int(abs(number[0])) - 1])
    return None

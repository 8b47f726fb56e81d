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
    "xyz", "xyz_mm", "xyz_m", "xyz_um", "coord", "coords", "coordinates", "positions", "position",
    "position_mm",
)  # fmt: skip
POINTS = ("points", "point", "names", "name", "label", "labels", "index", "indices", "indexes", "point_index")
COHERENCES = ("coh", "coherence", "gamma2")
COUNTS = ("n_avg", "navg", "averages", "n_averages")
UNITS = ("unit", "yunit", "units")
DIRECTIONS = ("direction", "directions", "dir")

STEP = "State which variable is what in a mapping"

_VALUE = re.compile(r"(y|amp|vib|fft|h1|h2|frf|data|value)?_?[xyz]?", re.IGNORECASE)
_BEAM = re.compile(r".+?_?([xyz])(?:_?(?:re|real))?", re.IGNORECASE)
_REAL = re.compile(r"_?(re|real)$", re.IGNORECASE)
_DEEPEST = 3  # structs in structs


@dataclass(frozen=True)
class Space:
    """Variables by name, of the file or of a struct before those around it; ``where`` is for messages."""

    names: Names[str, Any]
    where: str

    def within(self, fields: Names[str, Any], name: str, element: str = "") -> Space:
        """Return the fields of a struct, and for other names the variables around it."""
        around = {key: one for key, one in self.names.items() if key != name}
        where = f"{self.where}, {name}({element})" if element else f"{self.where}, {name}"
        return Space(ChainMap(dict(fields), around), where)

    def first(self, wanted: tuple[str, ...]) -> str:
        """Return the first of some names that is there, in any case; empty without one."""
        low = {name.lower(): name for name in reversed(list(self.names))}
        return next((low[name] for name in wanted if name in low), "")

    def text(self, wanted: tuple[str, ...]) -> str:
        """Return the first of some variables where it is a text; empty without one."""
        value = self.names.get(self.first(wanted))
        return value if isinstance(value, str) else ""

    def get(self, name: str) -> Any:
        """Return a variable; dots in its name reach into structs."""
        value: Any = self.names
        for part in name.split("."):
            if not isinstance(value, Names) or part not in value:
                step = f"It holds {describe(self.names)}"
                raise StapeskitError.of(f"the variable {name}", "in the file", "none", self.where, step)
            value = value[part]
        return value

    def numbers(self, name: str, real: bool = True) -> NDArray[Any]:
        """Return an array of numbers."""
        value = np.asarray(self.get(name))
        if value.dtype.kind not in "fciub" or value.size == 0 or (real and np.iscomplexobj(value)):
            want = f"an array of {'real ' if real else ''}numbers"
            raise StapeskitError.of(f"the variable {name}", want, "something else", self.where, STEP)
        return value.astype(float) if real else value

    def shaped(self, name: str, lines: int, real: bool = True) -> NDArray[Any]:
        """Return an array of points x lines [x 3 beams], in either order, as (point, line, beam)."""
        value = np.atleast_2d(self.numbers(name, real))
        if value.ndim == 2:
            value = (value.T if value.shape[1] != lines else value)[:, :, None]
        if value.ndim != 3 or value.shape[1] != lines:
            want, got = f"points x {lines} frequencies", " x ".join(map(str, value.shape))
            raise StapeskitError.of(f"the variable {name}", want, got, self.where, STEP)
        return value

    def vectors(self, name: str, count: int) -> Array:
        """Return three numbers a point, (count, 3), of an array in either order or of one vector."""
        value = self.numbers(name)
        value = value.T if value.shape == (3, count) and count != 3 else np.atleast_2d(value)
        if value.shape not in ((count, 3), (1, 3)):
            got = " x ".join(map(str, value.shape))
            raise StapeskitError.of(name, f"points x 3, here {count} x 3", got, self.where, STEP)
        return np.broadcast_to(value, (count, 3)).copy()

    def texts(self, name: str) -> list[str]:
        """Return the texts of a text, of a list of them, or of numbers."""
        value = self.get(name)
        if isinstance(value, str):
            return [part.strip() for part in value.split(";")]
        values = np.asarray(value).reshape(-1).tolist()
        return [f"{one:g}" if isinstance(one, float) else str(one) for one in values]

    def usd_of(self, name: str) -> Names[str, Any]:
        """Return the signal description of GetPointData that belongs to a value; empty without one."""
        known = {key: one for key, one in self.names.items() if isinstance(one, Names) and "YUnit" in one}
        match = _BEAM.fullmatch(name)
        ends = [one for key, one in known.items() if match and key.lower().endswith(f"_{match[1].lower()}")]
        fitting = ends if len(ends) == 1 else list(known.values())
        return fitting[0] if len(fitting) == 1 else {}


def describe(tree: Names[str, Any]) -> str:
    """List variables with their sizes, for messages."""
    sizes = {name: " x ".join(map(str, np.shape(value))) for name, value in tree.items()}
    return list_some((f"{name} ({size})" if size else name for name, size in sizes.items()), 12) or "none"


def layouts(space: Space, depth: int = 0) -> list[tuple[Space, Mapping, str]]:
    """Return where spectra are, each with its layout and point: here, in structs, in elements of arrays.

    Several structs are runs with their names, the elements of an array are points.
    """
    layout = _recognise(space)
    if layout is not None:
        return [(space, layout, "")]
    found: list[tuple[Space, Mapping, str]] = []
    for name, value in space.names.items():
        if isinstance(value, Names) and depth < _DEEPEST:
            inner = layouts(space.within(value, name), depth + 1)
            found += [(part, one if depth else replace(one, run=name), point) for part, one, point in inner]
        elif _is_struct_array(value):
            parts = [
                (space.within(one, name, str(number)), str(number)) for number, one in enumerate(value, 1)
            ]
            found += [(part, one, point) for part, point in parts if (one := _recognise(part)) is not None]
    several = len({layout.run for _, layout, _ in found}) > 1
    return found if several else [(part, replace(one, run=""), point) for part, one, point in found]


def _is_struct_array(value: Any) -> bool:
    listed = isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object)
    return listed and np.ndim(value) == 1 and all(isinstance(one, Names) for one in value)


def _recognise(space: Space) -> Mapping | None:
    """Recognise variables by names and shapes; None when frequency or values are not found."""
    frequency = space.first(FREQUENCIES)
    axis = np.asarray(space.names.get(frequency))
    if not frequency or axis.dtype.kind not in "fiu" or axis.size < 2 or axis.size != max(axis.shape):
        return None
    chosen = _values(space, frequency, axis.size)
    if not chosen:
        return None
    beams = [_BEAM.fullmatch(one.name) for one in chosen]
    axes = [match[1].lower() for match in beams if match]
    together = 1 < len(chosen) == len(set(axes))
    signals = []
    for number, one in enumerate(chosen):
        end = axes[number] if together else ""
        own = tuple(f"{word}{mark}{end}" for word in COHERENCES for mark in ("_", "")) if end else ()
        signals.append(
            replace(
                one,
                direction=end or space.first(DIRECTIONS),
                unit=space.text(UNITS),
                coherence=space.first((*own, *COHERENCES)),
                sd=space.first(("sd",)),
                n_avg=space.first(COUNTS),
                run="" if together or len(chosen) == 1 else one.name,
            )
        )
    shape, names = np.shape(space.names[chosen[0].name]), space.first(POINTS)
    rows = 1 if len(shape) == 1 else shape[0] if shape[1] == axis.size else shape[1]
    amplitude = space.text(("amplitude",))
    return Mapping(
        frequency,
        position=space.first(POSITIONS),
        points=names if names and len(space.texts(names)) == rows else "",
        amplitude=amplitude if amplitude in ("peak", "rms") else "",
        signal=tuple(signals),
        body=space.first(("body",)),
    )


def _values(space: Space, frequency: str, lines: int) -> list[Signal]:
    """Return the complex variables over the lines, else pairs of parts, else real ones that ``usd`` names."""
    skip = {frequency.lower(), *POSITIONS, *COUNTS, *DIRECTIONS}
    values = [
        name
        for name, value in space.names.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiuc" and lines in value.shape
        and name.lower() not in skip and not name.lower().startswith((*COHERENCES, "ref", "sd"))
    ]  # fmt: skip
    return (
        [Signal(value=name) for name in values if np.iscomplexobj(space.names[name])]
        or [Signal(value_re=name, value_im=im) for name in values if (im := _imaginary(name, values))]
        or [Signal(value=name) for name in values if _VALUE.fullmatch(name) and space.usd_of(name)]
    )


def _imaginary(name: str, names: list[str]) -> str:
    """Return the name of the imaginary part that belongs to a real part; empty without one."""
    match = _REAL.search(name)
    if match is None:
        return ""
    other = f"{name[: match.start(1)]}{'im' if match[1].lower() == 're' else 'imag'}".lower()
    return next((one for one in names if one.lower() == other), "")


def usd_direction(usd: Names[str, Any]) -> Array | None:
    """Return the direction of the first response that a signal description names; None without one."""
    dofs = usd.get("ResponseDOFs")
    dofs = dofs[0] if isinstance(dofs, list | np.ndarray) and len(dofs) else dofs
    code = dofs.get("Direction") if isinstance(dofs, Names) else None
    if isinstance(code, str):
        match = re.fullmatch(r"ptc(Plus|Minus)([XYZ])Translation", code)
        return axis_vector(("-" if match[1] == "Minus" else "") + match[2].lower()) if match else None
    number = np.asarray(code if code is not None else 0).reshape(-1)
    if number.size == 1 and number.dtype.kind in "fiu" and abs(float(number[0])) in (1.0, 2.0, 3.0):
        return np.asarray(np.sign(float(number[0])) * np.eye(3)[int(abs(number[0])) - 1])
    return None

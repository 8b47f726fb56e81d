"""Read MATLAB files with spectra by scipy.io and h5py (v7.3), as users of Polytec's File Access save them.

Recognised by names and shapes: ``x`` (F, Hz) and ``y`` (points x F, complex, or ``v_re`` and ``v_im``) with
the struct ``usd`` that GetPointData returns; ``xyz`` of GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x`` ...); points x F x 3 for beams x, y, z; ``coh``, ``n_avg``,
``names``. The same inside a struct, in several structs (one run each), or in a struct array with one element
a point. A mapping describes everything else (kinematics.readers.mapping).
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Mapping as Names
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.hdf5 import STRINGS, read_tree
from kinematics.readers.mapping import Mapping, Signal, mapping_beside, read_mapping
from kinematics.readers.recording import (
    Channel,
    Recording,
    Row,
    from_polar,
    recording_of,
    scaled,
    unknown_vector,
)
from kinematics.readers.text import plain_name, shown
from kinematics.readers.units import HERTZ, LENGTHS, PHASES, MotionUnit, motion_unit, unit_fault
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

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
_LENGTH_END = re.compile(r"_(mm|um|m)$")
_STRING_STEP = "Save it as char or cell array: names = cellstr(names); unit = char(unit); then save again"


def read(path: Path, facts: FileFacts) -> Recording:
    """Read a MATLAB file with spectra.

    Raises
    ------
    StapeskitError
        The file is damaged, its layout is not recognised (the variables found are listed), a unit is missing
        or unknown, shapes do not match, or values are not complex.
    """
    return recording_of_tree(read_variables(path), Path(path), facts)


def read_variables(path: Path) -> dict[str, Any]:
    """Return the variables of a file of any version: arrays, texts, dictionaries and lists of them."""
    from scipy.io import loadmat

    with Path(path).open("rb") as stream:
        head = stream.read(1024)
    if b"\x89HDF\r\n\x1a\n" in head:
        return read_tree(path)
    tree = loadmat(path, squeeze_me=True, simplify_cells=True)
    opaque = [name for name, value in tree.items() if _is_opaque(value)]
    plain = {name: value for name, value in tree.items() if not name.startswith("__") and name not in opaque}
    return {**plain, **{(name if name != "None" else "a variable"): STRINGS for name in opaque}}


def _is_opaque(value: Any) -> bool:
    """Return whether a variable is of a class that scipy does not read: a string array or an object."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    return isinstance(value, MatlabOpaque | MatlabFunction)


def recording_of_tree(tree: Names[str, Any], path: Path, facts: FileFacts) -> Recording:
    """Read variables as a mapping says, else by their names.

    Raises
    ------
    StapeskitError
        As `read`.
    """
    path = Path(path)
    strings = [name for name, value in tree.items() if isinstance(value, str) and value == STRINGS]
    tree = {name: value for name, value in tree.items() if name not in strings}
    mapping_file = mapping_beside(path, facts.mapping)
    mapping = None if mapping_file is None else read_mapping(mapping_file)
    try:
        blocks = _layouts(_Space(tree, path.name), mapping)
        if not blocks:
            want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
            step = f"State which variable is what in {path.name}.toml, or by --mapping FILE"
            if any(name.lower() in ("t", "time", "time_s") for name in tree):
                step = "It holds time series: name its channels by --channels FILE"
            raise StapeskitError.of(path.name, want, f"the variables {_describe(tree)}", "", step)
        rows = [row for space, layout, point in blocks for row in _rows(space, layout, point)]
    except StapeskitError as error:
        if not strings:
            raise
        want, got = "of char, cell or number arrays", f"MATLAB string arrays ({', '.join(strings)})"
        raise StapeskitError(
            Fault("the variables", want, got, path.name, _STRING_STEP), *error.faults
        ) from None
    notices: tuple[Notice, ...] = ()
    if strings:
        text = (
            f"{path.name}: {', '.join(strings)} are MATLAB string arrays and were not read. {_STRING_STEP}."
        )
        notices = (Notice("variables_ignored", text),)
    layouts = [layout for _, layout, _ in blocks]
    return recording_of(
        path.name,
        rows,
        notices=notices,
        statement=f"variables of {path.name}",
        amplitude_stated=all(layout.amplitude for layout in layouts),
        length_stated=all(_length_unit(layout) or not layout.position for layout in layouts),
    )


@dataclass(frozen=True)
class _Space:
    """Variables by name, of the file or of a struct before those around it; ``where`` is for messages."""

    names: Names[str, Any]
    where: str

    def within(self, fields: Names[str, Any], name: str) -> _Space:
        """Return the fields of a struct, and for other names what is around it."""
        return _Space(ChainMap(dict(fields), dict(self.names)), f"{self.where}, {name}")

    def first(self, wanted: tuple[str, ...]) -> str:
        """Return the first of some names that is there, in any case; empty without one."""
        low = {name.lower(): name for name in reversed(list(self.names))}
        return next((low[name] for name in wanted if name in low), "")

    def get(self, name: str) -> Any:
        """Return a variable; dots in its name reach into structs."""
        value: Any = self.names
        for part in name.split("."):
            if not isinstance(value, Names) or part not in value:
                step = f"It holds {_describe(self.names)}"
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


def _describe(tree: Names[str, Any]) -> str:
    kinds = (
        f"{name} ({' x '.join(map(str, np.shape(value)))})" if np.ndim(value) else name
        for name, value in tree.items()
    )
    return list_some(kinds, 12) or "none"


def _layouts(space: _Space, mapping: Mapping | None, depth: int = 0) -> list[tuple[_Space, Mapping, str]]:
    """Return where spectra are (here, in structs, in elements of struct arrays), each with its layout."""
    if mapping is not None and mapping.each:
        elements = np.atleast_1d(np.asarray(space.get(mapping.each), dtype=object)).tolist()
        spaces = [
            (space.within(one, f"{mapping.each}({k})"), str(k)) for k, one in enumerate(elements, 1) if one
        ]
        return [(inner, replace(mapping, each=""), point) for inner, point in spaces]
    layout = mapping or _recognise(space)
    if layout is not None:
        return [(space, layout, "")]
    found = []
    for name, value in space.names.items():
        if isinstance(value, Names):
            inner = _layouts(space.within(value, name), None, depth + 1) if depth < 3 else []
            found += [(s, replace(one, run=name) if not depth else one, point) for s, one, point in inner]
        elif isinstance(value, list | np.ndarray) and all(isinstance(one, Names) for one in _some(value)):
            outer = _Space({key: one for key, one in space.names.items() if key != name}, space.where)
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


def _recognise(space: _Space) -> Mapping | None:
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
        chosen = [Signal(value=name) for name in values if _VALUE.fullmatch(name) and _usd(space, name)]
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


def _usd(space: _Space, name: str) -> Names[str, Any]:
    """Return the signal description of GetPointData that belongs to a value; empty without one."""
    known = {key: one for key, one in space.names.items() if isinstance(one, Names) and "YUnit" in one}
    match = _BEAM.fullmatch(name)
    ends = [
        key for key in known if match and len(key) > 1 and key.lower().endswith(f"_{match['axis'].lower()}")
    ]
    if len(ends) == 1:
        return known[ends[0]]
    return next(iter(known.values())) if len(known) == 1 else {}


def _rows(space: _Space, layout: Mapping, point: str) -> list[Row]:
    """Read the signals of a layout; all faults of its variables together."""
    freq = space.numbers(layout.frequency, real=True).astype(float).reshape(-1)
    freq = freq * HERTZ[(layout.frequency_unit or "Hz").lower()]
    if not np.all(np.diff(freq) > 0.0) or not freq[0] >= 0.0 or not np.isfinite(freq[-1]):
        step = "State which variable holds the frequencies in a mapping"
        raise StapeskitError.of(layout.frequency, "ascending and not negative", "others", space.where, step)
    faults: list[Fault] = []
    rows: list[Row] = []
    for signal in layout.signal:
        with collect_faults(faults):
            rows += _signal_rows(space, layout, signal, freq, point)
    raise_all(dict.fromkeys(faults))
    return rows


def _signal_rows(space: _Space, layout: Mapping, signal: Signal, freq: Array, point: str) -> list[Row]:
    """Return one row for every point and beam of a signal."""
    unit = _unit(space, signal)
    value = _values(space, signal, len(freq))
    value = value.conj() if layout.convention == "-" else value
    count, _, beams = value.shape
    scale = unit.scale * (2.0**0.5 if layout.amplitude == "rms" and not unit.per else 1.0)
    names = _names(space, layout, signal, count, point)
    bodies = _bodies(space, signal.body or layout.body, count)
    places = _places(space, layout, count)
    coherence, sd = (_companion(space, name, value.shape) for name in (signal.coherence, signal.sd))
    stated = (
        space.numbers(signal.n_avg, real=True) if isinstance(signal.n_avg, str) and signal.n_avg else None
    )
    n_avg = (
        float(stated.flat[0]) if stated is not None else None if signal.n_avg == "" else float(signal.n_avg)
    )
    rows = []
    for beam in range(beams):
        directions = _directions(space, signal, beam, beams, count)
        for k in range(count):
            where = Place(f"{space.where}, {signal.name}", "row", (k + 1,))
            channel = Channel(
                names[k], bodies[k], signal.run or layout.run, order=unit.order, per=unit.per,
                position_m=places[k], direction=directions[k], where=where,
            )  # fmt: skip
            rows.append(
                Row(
                    channel,
                    freq,
                    scaled(value[k, :, beam], scale),
                    None if sd is None else sd[k, :, beam] * scale,
                    None if coherence is None else coherence[k, :, beam],
                    n_avg,
                )
            )
    return rows


def _unit(space: _Space, signal: Signal) -> MotionUnit:
    """Return the unit that is stated, or that the signal description names."""
    label = signal.unit
    usd = _usd(space, signal.name)
    if not label and usd:
        if np.any(np.asarray(usd.get("PowerSignal", 0)) == 1):
            step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
            raise StapeskitError.of(signal.name, "an amplitude spectrum", "a power", space.where, step)
        label = str(usd.get("YUnit", ""))
    unit = motion_unit(label)
    if unit is None:
        step = 'Give it as unit = "m/s" in a mapping'
        raise StapeskitError(unit_fault(shown(label), (signal.name,), space.where, step))
    return unit


def _values(space: _Space, signal: Signal, count: int) -> ComplexArray:
    """Return the complex values of a signal, (point, F, beam), in its unit."""
    if signal.magnitude:
        turn = PHASES[(signal.phase_unit or "deg").lower()]
        parts = [space.numbers(name, real=True) for name in (signal.magnitude, signal.phase)]
        value = from_polar(parts[0], parts[1], turn) if parts[0].shape == parts[1].shape else np.empty(0)
    elif signal.value_re:
        parts = [space.numbers(name, real=True) for name in (signal.value_re, signal.value_im)]
        value = np.empty(parts[0].shape, dtype=complex)
        if parts[0].shape == parts[1].shape:
            value.real, value.imag = parts
        else:
            value = np.empty(0)
    else:
        value = space.numbers(signal.value)
        if not np.iscomplexobj(value):
            step = "Export Real & Imag., not a magnitude: without phase there is no motion"
            raise StapeskitError.of(
                f"the variable {signal.value}", "complex", "real numbers", space.where, step
            )
    return _shaped(value, count, signal.name, space.where).astype(complex)


def _shaped(value: NDArray[Any], count: int, name: str, where: str) -> NDArray[Any]:
    """Return an array as (point, F, beam)."""
    value = value[None] if value.ndim == 1 else value
    if value.ndim == 2 and value.shape[1] != count and value.shape[0] == count:
        value = value.T
    value = value[:, :, None] if value.ndim == 2 else value
    if value.ndim != 3 or value.shape[1] != count:
        got, step = " x ".join(map(str, value.shape)), "State which variable is what in a mapping"
        raise StapeskitError.of(f"the variable {name}", f"points x {count} frequencies", got, where, step)
    return value


def _names(space: _Space, layout: Mapping, signal: Signal, count: int, point: str) -> list[str]:
    """Return the names of the points, one a row."""
    if not layout.points:
        stated = signal.point or point
        return [stated] if stated and count == 1 else [str(k) for k in range(1, count + 1)]
    names = [plain_name(name) for name in space.texts(layout.points)]
    several = (
        isinstance(signal.direction, str) and bool(signal.direction) and axis_vector(signal.direction) is None
    )
    if len(names) != count or (len(set(names)) != len(names) and not several):
        got = f"{len(names)}, of which {len(set(names))} differ"
        raise StapeskitError.of(layout.points, f"{count} different names, one a row", got, space.where)
    return names


def _bodies(space: _Space, body: str, count: int) -> list[str]:
    """Return the body of every row: of a variable with a name for each, else the text itself."""
    names = space.texts(body) if body and body in space.names else [body]
    return names if len(names) == count else names[:1] * count


def _length_unit(layout: Mapping) -> str:
    ending = _LENGTH_END.search(layout.position)
    return layout.position_unit or (ending[1] if ending else "")


def _places(space: _Space, layout: Mapping, count: int) -> Array:
    """Return the positions of the points (count, 3), m; as metres where no unit is stated."""
    if not layout.position:
        return np.full((count, 3), np.nan)
    values = space.numbers(layout.position, real=True).astype(float)
    values = values.T if values.shape == (3, count) and count != 3 else values
    values = values.reshape(1, 3) if values.size == 3 and count == 1 else values
    if values.shape != (count, 3):
        got = " x ".join(map(str, values.shape))
        raise StapeskitError.of(layout.position, f"points x 3, here {count} x 3", got, space.where)
    return values * LENGTHS[_length_unit(layout) or "m"]


def _companion(space: _Space, name: str, shape: tuple[int, ...]) -> Array | None:
    """Return coherence or standard deviation in the shape of the values; None without one."""
    if not name:
        return None
    value = _shaped(space.numbers(name, real=True).astype(float), shape[1], name, space.where)
    if value.shape[0] != shape[0] or value.shape[2] not in (1, shape[2]):
        raise StapeskitError.of(name, f"{shape[0]} x {shape[1]}", f"{value.shape[0]} rows", space.where)
    return np.broadcast_to(value, shape)


def _directions(space: _Space, signal: Signal, beam: int, beams: int, count: int) -> Array:
    """Return the direction of a beam at every point, (count, 3), NaN where it is not stated."""
    stated = signal.direction
    if beams == 3:
        return np.tile(np.eye(3)[beam], (count, 1))
    axis = axis_vector(stated) if isinstance(stated, str) else None
    if axis is not None:
        return np.tile(axis, (count, 1))
    if stated != "":
        vectors = np.asarray(
            space.numbers(stated, real=True) if isinstance(stated, str) else stated, dtype=float
        )
        vectors = vectors.T if vectors.shape == (3, count) and count != 3 else np.atleast_2d(vectors)
        if vectors.shape not in ((count, 3), (1, 3)):
            got = " x ".join(map(str, vectors.shape))
            raise StapeskitError.of("a direction", f"x, -y ..., or {count} x 3 numbers", got, space.where)
        return np.broadcast_to(vectors, (count, 3)).copy()
    vector = usd_direction(_usd(space, signal.name))
    return np.tile(unknown_vector() if vector is None else vector, (count, 1))


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

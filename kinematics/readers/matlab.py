"""Read MATLAB files with spectra by scipy.io and h5py (v7.3), as users of Polytec's File Access save them.

Recognised by names and shapes: ``x`` (F, Hz) and ``y`` (points x F, complex, or ``v_re`` and ``v_im``) with
the struct ``usd`` that GetPointData returns; ``xyz`` of GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x`` ...); points x F x 3 for beams x, y, z; ``coh``, ``n_avg``,
``names``. The same inside a struct, in several structs (one run each), or in a struct array with one element
a point. A mapping describes everything else (kinematics.readers.mapping).
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Names
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.hdf5 import STRINGS, read_tree
from kinematics.readers.mapping import Mapping, Signal, mapping_beside, read_mapping
from kinematics.readers.matlab_layout import Space, describe, layouts, usd_direction, usd_of
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
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

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
        blocks = layouts(Space(tree, path.name), mapping)
        if not blocks:
            want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
            step = f"State which variable is what in {path.name}.toml, or by --mapping FILE"
            if any(name.lower() in ("t", "time", "time_s") for name in tree):
                step = "It holds time series: name its channels by --channels FILE"
            raise StapeskitError.of(path.name, want, f"the variables {describe(tree)}", "", step)
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
        notices = (Notice("content_ignored", text),)
    used = [layout for _, layout, _ in blocks]
    return recording_of(
        path.name,
        rows,
        notices=notices,
        statement=f"variables of {path.name}",
        amplitude_stated=all(layout.amplitude for layout in used),
        length_stated=all(_length_unit(layout) or not layout.position for layout in used),
    )


def _rows(space: Space, layout: Mapping, point: str) -> list[Row]:
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


def _signal_rows(space: Space, layout: Mapping, signal: Signal, freq: Array, point: str) -> list[Row]:
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


def _unit(space: Space, signal: Signal) -> MotionUnit:
    """Return the unit that is stated, or that the signal description names."""
    label = signal.unit
    usd = usd_of(space, signal.name)
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


def _values(space: Space, signal: Signal, count: int) -> ComplexArray:
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


def _names(space: Space, layout: Mapping, signal: Signal, count: int, point: str) -> list[str]:
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


def _bodies(space: Space, body: str, count: int) -> list[str]:
    """Return the body of every row: of a variable with a name for each, else the text itself."""
    names = space.texts(body) if body and body in space.names else [body]
    return names if len(names) == count else names[:1] * count


def _length_unit(layout: Mapping) -> str:
    ending = _LENGTH_END.search(layout.position)
    return layout.position_unit or (ending[1] if ending else "")


def _places(space: Space, layout: Mapping, count: int) -> Array:
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


def _companion(space: Space, name: str, shape: tuple[int, ...]) -> Array | None:
    """Return coherence or standard deviation in the shape of the values; None without one."""
    if not name:
        return None
    value = _shaped(space.numbers(name, real=True).astype(float), shape[1], name, space.where)
    if value.shape[0] != shape[0] or value.shape[2] not in (1, shape[2]):
        raise StapeskitError.of(name, f"{shape[0]} x {shape[1]}", f"{value.shape[0]} rows", space.where)
    return np.broadcast_to(value, shape)


def _directions(space: Space, signal: Signal, beam: int, beams: int, count: int) -> Array:
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
    vector = usd_direction(usd_of(space, signal.name))
    return np.tile(unknown_vector() if vector is None else vector, (count, 1))

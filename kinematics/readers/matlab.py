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
    from_parts,
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
_STEP = "State which variable is what in a mapping"


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
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    with Path(path).open("rb") as stream:
        if b"\x89HDF\r\n\x1a\n" in stream.read(1024):
            return read_tree(path)
    tree = loadmat(path, squeeze_me=True, simplify_cells=True)
    unread = {name for name, value in tree.items() if isinstance(value, MatlabOpaque | MatlabFunction)}
    plain = {name: value for name, value in tree.items() if not name.startswith("__") and name not in unread}
    return plain | {("a variable" if name == "None" else name): STRINGS for name in unread}


def recording_of_tree(tree: Names[str, Any], path: Path, facts: FileFacts) -> Recording:
    """Read variables as a mapping says, else by their names.

    Raises
    ------
    StapeskitError
        As `read`.
    """
    strings = ", ".join(name for name, value in tree.items() if isinstance(value, str) and value == STRINGS)
    space = Space({name: one for name, one in tree.items() if name not in strings.split(", ")}, path.name)
    mapping_file = mapping_beside(path, facts.mapping)
    try:
        blocks = layouts(space) if mapping_file is None else [(space, read_mapping(mapping_file), "")]
        if not blocks:
            want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
            step = f"State which variable is what in {path.name}.toml; time series need --channels FILE"
            raise StapeskitError.of(path.name, want, f"the variables {describe(space.names)}", "", step)
        rows = [row for part, layout, point in blocks for row in _rows(part, layout, point)]
    except StapeskitError as error:
        want, got = "of char, cell or number arrays", f"MATLAB string arrays ({strings})"
        first = [Fault("the variables", want, got, path.name, _STRING_STEP)] if strings else []
        raise StapeskitError(*first, *error.faults) from None
    text = f"{path.name}: {strings} are MATLAB string arrays and were not read. {_STRING_STEP}."
    used = [layout for _, layout, _ in blocks]
    return recording_of(
        path.name,
        rows,
        notices=(Notice("content_ignored", text),) if strings else (),
        statement=f"variables of {path.name}",
        amplitude_stated=all(layout.amplitude for layout in used),
        length_stated=all(_length_unit(layout) or not layout.position for layout in used),
    )


def _rows(space: Space, layout: Mapping, point: str) -> list[Row]:
    """Read the signals of a layout; all faults of its variables together."""
    freq = space.numbers(layout.frequency).reshape(-1) * HERTZ[(layout.frequency_unit or "Hz").lower()]
    if not np.all(np.diff(freq) > 0.0) or not freq[0] >= 0.0 or not np.isfinite(freq[-1]):
        want = "ascending and not negative"
        raise StapeskitError.of(layout.frequency, want, "others", space.where, _STEP)
    faults: list[Fault] = []
    rows: list[Row] = []
    for signal in layout.signal:
        with collect_faults(faults):
            rows += _signal_rows(space, layout, signal, freq, point)
    raise_all(faults)
    return rows


def _signal_rows(space: Space, layout: Mapping, signal: Signal, freq: Array, point: str) -> list[Row]:
    """Return one row for every point and beam of a signal."""
    unit = _unit(space, signal)
    value = _values(space, signal, len(freq))
    value = value.conj() if layout.convention == "-" else value
    count, _, beams = value.shape
    scale = unit.scale * (2.0**0.5 if layout.amplitude == "rms" and not unit.per else 1.0)
    names = _names(space, layout, signal, count, point)
    body = signal.body or layout.body
    bodies = space.texts(body) if body and body in space.names else [body]
    bodies = bodies if len(bodies) == count else bodies[:1] * count
    places = np.full((count, 3), np.nan)
    if layout.position:
        places = space.vectors(layout.position, count) * LENGTHS[_length_unit(layout) or "m"]
    coherence, sd = (_companion(space, name, value.shape) for name in (signal.coherence, signal.sd))
    n_avg = (
        space.numbers(signal.n_avg).flat[0]
        if isinstance(signal.n_avg, str) and signal.n_avg
        else signal.n_avg
    )
    rows = []
    for beam in range(beams):
        directions = np.tile(np.eye(3)[beam], (count, 1)) if beams == 3 else _directions(space, signal, count)
        for k in range(count):
            channel = Channel(
                names[k], bodies[k], signal.run or layout.run, order=unit.order, per=unit.per,
                position_m=places[k], direction=directions[k],
                where=Place(f"{space.where}, {signal.name}", "row", (k + 1,)),
            )  # fmt: skip
            rows.append(
                Row(
                    channel,
                    freq,
                    scaled(value[k, :, beam], scale),
                    None if sd is None else sd[k, :, beam] * scale,
                    None if coherence is None else coherence[k, :, beam],
                    None if n_avg == "" else float(n_avg),
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
    if signal.value:
        value = space.numbers(signal.value, real=False)
        if not np.iscomplexobj(value):
            step, thing = (
                "Export Real & Imag.: without phase there is no motion",
                f"the variable {signal.value}",
            )
            raise StapeskitError.of(thing, "complex", "real numbers", space.where, step)
        return _shaped(value.astype(complex), count, signal.name, space.where)
    pair = (signal.value_re, signal.value_im) if signal.value_re else (signal.magnitude, signal.phase)
    one, other = (_shaped(space.numbers(name), count, name, space.where) for name in pair)
    if one.shape != other.shape:
        raise StapeskitError.of(f"the variables {' and '.join(pair)}", "of one size", "others", space.where)
    if signal.value_re:
        return from_parts(one, other)
    return from_polar(one, other, PHASES[signal.phase_unit or "deg"])


def _shaped(value: NDArray[Any], count: int, name: str, where: str) -> NDArray[Any]:
    """Return an array as (point, F, beam)."""
    value = value[None] if value.ndim == 1 else value
    if value.ndim == 2 and value.shape[1] != count and value.shape[0] == count:
        value = value.T
    value = value[:, :, None] if value.ndim == 2 else value
    if value.ndim != 3 or value.shape[1] != count:
        got = " x ".join(map(str, value.shape))
        raise StapeskitError.of(f"the variable {name}", f"points x {count} frequencies", got, where, _STEP)
    return value


def _names(space: Space, layout: Mapping, signal: Signal, count: int, point: str) -> list[str]:
    """Return the names of the points, one a row; rows may repeat them where each has its own direction."""
    if not layout.points:
        stated = signal.point or point
        return [stated] if stated and count == 1 else [str(k) for k in range(1, count + 1)]
    names = [plain_name(name) for name in space.texts(layout.points)]
    several = signal.direction in space.names if isinstance(signal.direction, str) else False
    if len(names) != count or (len(set(names)) != count and not several):
        got = f"{len(names)}, of which {len(set(names))} differ"
        raise StapeskitError.of(layout.points, f"{count} different names, one a row", got, space.where)
    return names


def _length_unit(layout: Mapping) -> str:
    ending = _LENGTH_END.search(layout.position)
    return layout.position_unit or (ending[1] if ending else "")


def _companion(space: Space, name: str, shape: tuple[int, ...]) -> Array | None:
    """Return coherence or standard deviation in the shape of the values; None without one."""
    if not name:
        return None
    value = _shaped(space.numbers(name), shape[1], name, space.where)
    if value.shape[0] != shape[0] or value.shape[2] not in (1, shape[2]):
        raise StapeskitError.of(name, f"{shape[0]} x {shape[1]}", f"{value.shape[0]} rows", space.where)
    return np.broadcast_to(value, shape)


def _directions(space: Space, signal: Signal, count: int) -> Array:
    """Return the direction of the beam at every point, (count, 3), NaN where it is not stated."""
    stated = signal.direction
    if isinstance(stated, list):
        return Space({"the direction": stated}, space.where).vectors("the direction", count)
    vector = axis_vector(stated) if stated else usd_direction(usd_of(space, signal.name))
    if stated and vector is None:
        return space.vectors(stated, count)
    return np.tile(unknown_vector() if vector is None else vector, (count, 1))

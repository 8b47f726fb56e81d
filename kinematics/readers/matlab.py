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
from kinematics.readers.gather import Row, recording_of
from kinematics.readers.hdf5 import STRINGS, read_tree
from kinematics.readers.mapping import Mapping, Signal, mapping_beside, read_mapping
from kinematics.readers.matlab_layout import STEP, Space, describe, layouts, usd_direction
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name
from kinematics.readers.units import HERTZ, LENGTHS
from stapeskit.arrays import Array
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
        The file is damaged, its layout is not recognised (the variables found are listed), shapes do not
        match, or values are not complex; as `kinematics.readers.gather.recording_of`.
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
    strings = [name for name, value in tree.items() if isinstance(value, str) and value == STRINGS]
    space = Space({name: one for name, one in tree.items() if name not in strings}, path.name)
    mapping_file = mapping_beside(path, facts.mapping)
    unread = f"MATLAB string arrays ({', '.join(strings)})"
    notices = [Notice("file_read", f"{path.name}: {unread} were not read. {_STRING_STEP}.")]
    try:
        blocks = layouts(space) if mapping_file is None else [(space, read_mapping(mapping_file), "")]
        if not blocks:
            want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
            step = f"State which variable is what in {path.name}.toml; time series need --channels FILE"
            raise StapeskitError.of(path.name, want, f"the variables {describe(space.names)}", "", step)
        used = [layout for _, layout, _ in blocks]
        return recording_of(
            path.name,
            [row for part, layout, point in blocks for row in _rows(part, layout, point)],
            used[0].amplitude,
            notices=notices if strings else (),
            statement=f"variables of {path.name}",
            length_stated=all(_length_unit(layout) or not layout.position for layout in used),
        )
    except StapeskitError as error:
        want = "of char, cell or number arrays"
        first = [Fault("the variables", want, unread, path.name, _STRING_STEP)] if strings else []
        raise StapeskitError(*first, *error.faults) from None


def _rows(space: Space, layout: Mapping, point: str) -> list[Row]:
    """Read the signals of a layout; all faults of its variables together."""
    freq = space.numbers(layout.frequency).reshape(-1) * HERTZ[(layout.frequency_unit or "Hz").lower()]
    faults: list[Fault] = []
    rows: list[Row] = []
    for signal in layout.signal:
        with collect_faults(faults):
            rows += _signal_rows(space, layout, signal, freq, point)
    raise_all(faults)
    return rows


def _signal_rows(space: Space, layout: Mapping, signal: Signal, freq: Array, point: str) -> list[Row]:
    """Return one row for every point and beam of a signal."""

    def numbers(name: str) -> NDArray[Any]:
        value = space.shaped(name, len(freq), real=name != signal.value)
        if name == signal.value and not np.iscomplexobj(value):
            want, step = "complex", "Export Real & Imag.: without phase there is no motion"
            raise StapeskitError.of(f"the variable {name}", want, "real numbers", space.where, step)
        return value

    usd = space.usd_of(signal.name)
    if not signal.unit and np.any(np.asarray(usd.get("PowerSignal", 0)) == 1):
        step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
        raise StapeskitError.of(signal.name, "an amplitude spectrum", "a power", space.where, step)
    value = signal.values(numbers, signal.phase_unit or "deg", space.where)
    value = value.conj() if layout.convention == "-" else value
    count, _, beams = value.shape
    names = _names(space, layout, signal, count, point)
    body = signal.body or layout.body
    bodies = space.texts(body) if body and body in space.names else [body]
    bodies = bodies if len(bodies) == count else bodies[:1] * count
    places = np.full((count, 3), np.nan)
    if layout.position:
        places = space.vectors(layout.position, count) * LENGTHS[_length_unit(layout) or "m"]
    n_avg = signal.n_avg
    if isinstance(n_avg, str) and n_avg:
        n_avg = space.numbers(n_avg).flat[0]
    noise = {
        key: np.broadcast_to(_like(space, name, value.shape), value.shape)
        for key, name in (("sd", signal.sd), ("coherence", signal.coherence))
        if name
    }
    rows = []
    for beam in range(beams):
        directions = np.tile(np.eye(3)[beam], (count, 1)) if beams == 3 else _directions(space, signal, count)
        for k in range(count):
            channel = Channel(
                names[k],
                bodies[k],
                signal.run or layout.run,
                position_m=places[k],
                direction=directions[k],
                where=Place(f"{space.where}, {signal.name}", "row", (k + 1,)),
            )
            rows.append(
                Row(
                    channel,
                    freq,
                    value[k, :, beam],
                    **{key: matrix[k, :, beam] for key, matrix in noise.items()},
                    n_avg=None if n_avg == "" else float(n_avg),
                    unit=signal.unit or str(usd.get("YUnit", "")),
                    source=signal.name,
                )
            )
    return rows


def _like(space: Space, name: str, shape: tuple[int, ...]) -> Array:
    """Return coherence or standard deviation of as many points as the values."""
    value = space.shaped(name, shape[1])
    if value.shape[0] != shape[0] or value.shape[2] not in (1, shape[2]):
        raise StapeskitError.of(name, f"{shape[0]} x {shape[1]}", f"{value.shape[0]} rows", space.where)
    return value


def _names(space: Space, layout: Mapping, signal: Signal, count: int, point: str) -> list[str]:
    """Return the names of the points, one a row; rows may repeat them where each has its own direction."""
    if not layout.points:
        stated = signal.point or point
        return [stated] if stated and count == 1 else [str(k) for k in range(1, count + 1)]
    names = [plain_name(name) for name in space.texts(layout.points)]
    if len(names) != count:
        raise StapeskitError.of(layout.points, f"{count} names, one a row", len(names), space.where, STEP)
    return names


def _length_unit(layout: Mapping) -> str:
    ending = _LENGTH_END.search(layout.position)
    return layout.position_unit or (ending[1] if ending else "")


def _directions(space: Space, signal: Signal, count: int) -> Array:
    """Return the direction of the beam at every point, (count, 3), NaN where it is not stated."""
    stated = signal.direction
    if isinstance(stated, list):
        return Space({"the direction": stated}, space.where).vectors("the direction", count)
    vector = axis_vector(stated) if stated else usd_direction(space.usd_of(signal.name))
    if stated and vector is None:
        return space.vectors(stated, count)
    return np.tile(unknown_vector() if vector is None else vector, (count, 1))

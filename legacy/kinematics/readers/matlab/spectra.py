"""Read spectra from MATLAB files as users of Polytec's File Access have them, or as a mapping says.

Recognised: ``x`` (1 x F, Hz) and ``y`` (points x F, complex, or real and imaginary parts in turn) with the
struct ``usd`` that GetPointData returns; ``xyz`` from GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x``, ...); the same inside a struct, in several structs (one run
each), in a struct array or in cells with one element a point; points x F x 3 for three beams. Versions 5
to 7.3. Everything else is described by a mapping, see kinematics.readers.matlab.mapping.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.containers.matlab_file import describe, read_mat
from legacy.kinematics.readers.mapping_file import mapping_of
from legacy.kinematics.readers.matlab.mapping import Layout, layout_of, read_mapping
from legacy.kinematics.readers.matlab.variables import LENGTH_END, Variables
from legacy.kinematics.readers.recording import Recording, Recordings, scaled, unknown_vector
from legacy.kinematics.readers.unit_labels import MotionUnit
from legacy.kinematics.readers.value_checks import check_frequencies
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice


def read(path: Path, mapping: Path | None = None) -> Recordings:
    """Read a MATLAB file with spectra.

    Parameters
    ----------
    mapping : Path, optional
        Which variable is what; ``<path>.toml`` is taken by itself when it exists.

    Raises
    ------
    KinematicsError
        The file is damaged, its layout is not recognised (the variables found are listed), a unit is
        missing or unknown, shapes do not match, or values are not complex.
    """
    return with_mapping(read_mat(Path(path)), Path(path), mapping)


def with_mapping(tree: Mapping[str, Any], path: Path, mapping: Path | None) -> Recordings:
    """Read variables as a mapping says; without one as ``<path>.toml`` says, else by their names.

    Raises
    ------
    KinematicsError
        As in read.
    """
    mapping = mapping_of(path, mapping)
    if mapping is not None:
        block = _from_layout(Variables(tree, path.name, tree), read_mapping(mapping))
        return _join([block], path.name)
    return of_tree(tree, path)


def of_tree(tree: Mapping[str, Any], path: Path) -> Recordings:
    """Recognise a layout in the variables of a file.

    Raises
    ------
    KinematicsError
        None is recognised; the variables found are listed.
    """
    blocks = _find_layouts(Variables(tree, path.name, tree))
    if not blocks:
        raise KinematicsError(_unrecognised(tree, path))
    return _join(blocks, path.name)


def _unrecognised(tree: Mapping[str, Any], path: Path) -> Fault:
    want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
    step = f"Say which variable is what in {path.name}.toml, or by {named('mapping')} FILE"
    times = [name for name in tree if name.lower() in ("t", "time", "time_s")]
    if times:
        step = f"It holds time series: name its channels by {named('channels')} FILE"
    return Fault(path.name, want, f"the variables {describe(dict(tree))}", "", step)


def _join(blocks: list[Recordings], name: str) -> Recordings:
    recordings = tuple(recording for block in blocks for recording in block.recordings)
    notices = tuple(dict.fromkeys(notice for block in blocks for notice in block.notices))
    return Recordings(
        recordings,
        notices,
        f"variables of {name}",
        amplitude_stated=all(block.amplitude_stated for block in blocks),
        length_stated=all(block.length_stated for block in blocks),
    )


def _find_layouts(variables: Variables) -> list[Recordings]:
    """Search for known layouts here, then in structs, then in struct arrays and cells of structs."""
    layout = layout_of(variables.space)
    if layout is not None:
        return [_from_layout(variables, layout)]
    inner = {
        name: variables.within(value, f"{variables.where}, {name}")
        for name, value in variables.space.items()
        if isinstance(value, dict)
    }
    layouts = {name: layout_of(fields.space) for name, fields in inner.items()}
    good = {name: layout for name, layout in layouts.items() if layout is not None}
    blocks: list[Recordings] = []
    faults: list[Fault] = []
    for name, entry in good.items():
        with collect_faults(faults):
            blocks.append(_from_layout(inner[name], replace(entry, run=name if len(good) > 1 else "")))
    raise_all(KinematicsError, dict.fromkeys(faults))
    if blocks:
        return blocks
    for name, value in variables.space.items():
        if isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value):
            outer = {key: entry for key, entry in variables.space.items() if key != name}
            around = replace(variables, space=outer)
            parts = [
                around.within(entry, f"{variables.where}, {name}({number})")
                for number, entry in enumerate(value, 1)
            ]
            if any(layout_of(part.space) is not None for part in parts):
                return _elements(parts, f"{variables.where}, {name}")
        if isinstance(value, dict):
            deeper = _find_layouts(Variables(value, f"{variables.where}, {name}", variables.tree))
            if deeper:
                return deeper
    return []


def _elements(parts: list[Variables], where: str) -> list[Recordings]:
    """Read the elements of a struct array, of which each is a point."""
    blocks = []
    faults: list[Fault] = []
    for number, part in enumerate(parts, 1):
        layout = layout_of(part.space)
        if layout is None:
            text = f"element {number} holds no spectrum and is left out ({where})."
            blocks.append(Recordings((), (Notice("missing_point", text),), amplitude_stated=True))
        else:
            with collect_faults(faults):
                blocks.append(_from_layout(part, layout, str(number)))
    raise_all(KinematicsError, dict.fromkeys(faults))
    return blocks


def _from_layout(variables: Variables, layout: Layout, point: str = "") -> Recordings:
    if not layout.each:
        return _read_signals(variables, layout, point)
    elements = variables.get(layout.each)
    if not isinstance(elements, list) or not all(isinstance(element, dict) for element in elements):
        want = "a struct array or a cell array of structs"
        raise KinematicsError.of(layout.each, want, "something else", variables.where)
    inside = replace(layout, each="")
    blocks: list[Recordings] = []
    faults: list[Fault] = []
    for k, entry in enumerate(elements, 1):
        part = variables.within(entry, f"{variables.where}, {layout.each}({k})")
        with collect_faults(faults):
            blocks.append(_from_layout(part, inside, str(k)))
    raise_all(KinematicsError, dict.fromkeys(faults))
    return _join(blocks, variables.where)


def _read_signals(variables: Variables, layout: Layout, point: str) -> Recordings:
    """Read the signals of a layout; report all faults of its variables together."""
    faults: list[Fault] = []
    recordings: list[Recording] = []
    freq: Array | None = None
    with collect_faults(faults):
        freq = _frequencies(variables, layout)
    for signal in layout.signal:
        name = signal.value or signal.value_re
        unit, count = MotionUnit(0, 1.0), None
        with collect_faults(faults):
            unit = variables.unit(signal, name)
        with collect_faults(faults):
            count = variables.count(signal)
        if freq is None:
            continue
        with collect_faults(faults):
            values = variables.values(signal, len(freq))
            if layout.convention == "-":
                values = values.conj()
            shape, rows = values.shape, len(values)
            scale = unit.scale * (np.sqrt(2.0) if layout.amplitude == "rms" else 1.0)
            before = len(faults)
            names, places, directions = [""] * rows, [unknown_vector()] * rows, [[unknown_vector()] * rows]
            coherence = spread = None
            with collect_faults(faults):
                names = variables.names(layout, rows, point)
            with collect_faults(faults):
                places = variables.positions(layout, rows)
            with collect_faults(faults):
                coherence = variables.companion(signal.coherence, shape)
            with collect_faults(faults):
                spread = variables.companion(signal.sd, shape)
            with collect_faults(faults):
                directions = [variables.directions(signal, beam, values) for beam in range(shape[2])]
            if len(faults) > before:
                continue
            for beam in range(shape[2]):
                for k in range(rows):
                    with collect_faults(faults):
                        recordings.append(
                            Recording(
                                names[k],
                                freq,
                                scaled(values[k, :, beam], scale),
                                unit.order,
                                Place(f"{variables.where}, {name}", "row", (k + 1,)),
                                signal.run or layout.run,
                                signal.body or layout.body,
                                places[k],
                                directions[beam][k],
                                None if spread is None else spread[k, :, beam] * scale,
                                None if coherence is None else coherence[k, :, beam],
                                count,
                                per=unit.per,
                            )
                        )
    raise_all(KinematicsError, dict.fromkeys(faults))
    length = bool(layout.position_unit or re.search(LENGTH_END, layout.position))
    return Recordings(
        tuple(recordings),
        amplitude_stated=bool(layout.amplitude),
        length_stated=length or not layout.position,
    )


def _frequencies(variables: Variables, layout: Layout) -> Array:
    freq = variables.reals(layout.frequency).reshape(-1)
    step = "Say which variable holds the frequencies in a mapping"
    check_frequencies(freq, variables.where, layout.frequency, step)
    return freq

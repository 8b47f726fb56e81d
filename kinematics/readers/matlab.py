"""Read spectra from MATLAB files as users of Polytec's File Access have them, or as a mapping says.

Recognised: ``x`` (1 x F, Hz) and ``y`` (points x F, complex, or real and imaginary parts in turn) with the
struct ``usd`` that GetPointData returns; ``xyz`` from GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x``, ...); the same inside a struct, in several structs (one run
each), in a struct array or in cells with one element a point; points x F x 3 for three beams. Versions 5
to 7.3. Everything else is said by a mapping, see kinematics.readers.mat_mapping.
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError, sentence
from kinematics.notices import Notice
from kinematics.readers.mat_mapping import Layout, Signal, layout_of, read_mapping, stacked, usd_direction
from kinematics.readers.mat_tree import describe, read_mat
from kinematics.readers.recording import Recording, Recordings, unknown_vector
from kinematics.readers.unit_labels import MOTIONS, MotionUnit, motion_unit
from kinematics.readers.values import scaled

Array = NDArray[np.float64]
_LENGTH_END = r"_(mm|um|m)$"
_SCALES = {"m": 1e3, "mm": 1.0, "um": 1e-3}
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def read(path: Path, mapping: Path | None = None) -> Recordings:
    """Read a MATLAB file with spectra.

    Parameters
    ----------
    path : Path
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
    beside = path.with_name(path.name + ".toml")
    if mapping is None and beside.is_file():
        mapping = beside
    if mapping is not None:
        return _joined([_from_layout(tree, read_mapping(mapping), path.name, tree)], path.name)
    return of_tree(tree, path)


def of_tree(tree: Mapping[str, Any], path: Path) -> Recordings:
    """Recognise a layout in the variables of a file.

    Raises
    ------
    KinematicsError
        None is recognised; the variables found are listed.
    """
    blocks = _found(tree, tree, path.name)
    if not blocks:
        raise KinematicsError(_unrecognised(tree, path))
    return _joined(blocks, path.name)


def _unrecognised(tree: Mapping[str, Any], path: Path) -> str:
    want = "of a known layout (x 1 x F, y points x F complex, usd; see docs/vibrometer_files.md)"
    step = f"Say which variable is what in {path.name}.toml, or by --mapping FILE"
    times = [name for name in tree if name.lower() in ("t", "time", "time_s")]
    if times:
        step = "It holds time series: name its channels by --channels FILE"
    return sentence(path.name, want, f"the variables {describe(dict(tree))}", "", step)


def _joined(blocks: list[Recordings], name: str) -> Recordings:
    recordings = tuple(one for block in blocks for one in block.recordings)
    notices = tuple(dict.fromkeys(notice for block in blocks for notice in block.notices))
    return Recordings(
        recordings,
        notices,
        f"variables of {name}",
        amplitude_stated=all(block.amplitude_stated for block in blocks),
        length_stated=all(block.length_stated for block in blocks),
    )


def _found(space: Mapping[str, Any], tree: Mapping[str, Any], where: str) -> list[Recordings]:
    """Look for known layouts here, then in structs, then in struct arrays and cells of structs."""
    layout = layout_of(space)
    if layout is not None:
        return [_from_layout(space, layout, where, tree)]
    inner = {
        name: layout_of(ChainMap(value, dict(space)))
        for name, value in space.items()
        if isinstance(value, dict)
    }
    good = {name: layout for name, layout in inner.items() if layout is not None}
    blocks = []
    for name, one in good.items():
        run = name if len(good) > 1 else ""
        named = Layout(**{**vars(one), "run": run})
        blocks.append(_from_layout(ChainMap(space[name], dict(space)), named, f"{where}, {name}", tree))
    if blocks:
        return blocks
    for name, value in space.items():
        if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            outer = {key: one for key, one in space.items() if key != name}
            parts = [ChainMap(one, outer) for one in value]
            layouts = [layout_of(part) for part in parts]
            if any(one is not None for one in layouts):
                return _elements(parts, layouts, f"{where}, {name}", tree)
        if isinstance(value, dict) and (deeper := _found(value, tree, f"{where}, {name}")):
            return deeper
    return []


def _elements(
    parts: list[ChainMap[str, Any]], layouts: list[Layout | None], where: str, tree: Mapping[str, Any]
) -> list[Recordings]:
    blocks = []
    for number, (part, layout) in enumerate(zip(parts, layouts, strict=True), 1):
        if layout is None:
            text = f"element {number} holds no spectrum and is left out ({where})."
            blocks.append(Recordings((), (Notice("missing_point", text),), amplitude_stated=True))
        else:
            blocks.append(_from_layout(part, layout, f"{where}({number})", tree, str(number)))
    return blocks


def _from_layout(
    space: Mapping[str, Any], layout: Layout, where: str, tree: Mapping[str, Any], point: str = ""
) -> Recordings:
    if layout.each:
        elements = _variable(space, layout.each, where, tree)
        if not isinstance(elements, list) or not all(isinstance(one, dict) for one in elements):
            want = "a struct array or a cell array of structs"
            raise KinematicsError(sentence(layout.each, want, "something else", where))
        inside = Layout(**{**vars(layout), "each": ""})
        parts = [ChainMap(one, dict(space)) for one in elements]
        spots = [f"{where}, {layout.each}({k})" for k in range(1, len(parts) + 1)]
        blocks = [
            _from_layout(part, inside, place, tree, str(k))
            for k, (part, place) in enumerate(zip(parts, spots, strict=True), 1)
        ]
        return _joined(blocks, where)
    freq = _reals(space, layout.frequency, where, tree).reshape(-1)
    if not (np.all(np.isfinite(freq)) and np.all(np.diff(freq) > 0.0)):
        step = "Say which variable holds the frequencies in a mapping"
        raise KinematicsError(sentence(layout.frequency, "ascending frequencies, Hz", "others", where, step))
    recordings: list[Recording] = []
    for signal in layout.signal:
        values, name = _values(space, signal, len(freq), where, tree)
        unit = _unit(space, signal, name, where, tree)
        scale = unit.scale * (np.sqrt(2.0) if layout.amplitude == "rms" else 1.0)
        if layout.convention == "-":
            values = values.conj()
        names = _names(space, layout, len(values), where, tree, point)
        places = _positions(space, layout, len(values), where, tree)
        coherence = _companion(space, signal.coherence, values.shape, where, tree)
        spread = _companion(space, signal.sd, values.shape, where, tree)
        count = _count(space, signal, where, tree)
        for beam in range(values.shape[2]):
            directions = _directions(space, signal, beam, values, where, tree)
            for k in range(len(values)):
                recordings.append(
                    Recording(
                        names[k],
                        freq,
                        scaled(values[k, :, beam], scale),
                        unit.order,
                        f"{where}, {name}, row {k + 1}",
                        signal.run or layout.run,
                        signal.body or layout.body,
                        places[k],
                        directions[k],
                        None if spread is None else spread[k, :, beam] * scale,
                        None if coherence is None else coherence[k, :, beam],
                        count,
                        per=unit.per,
                    )
                )
    length = bool(layout.position_unit or re.search(_LENGTH_END, layout.position))
    return Recordings(
        tuple(recordings),
        amplitude_stated=bool(layout.amplitude),
        length_stated=length or not layout.position,
    )


def _variable(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> Any:
    value: Any = space
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            step = f"It holds {describe(dict(tree))}"
            raise KinematicsError(sentence(f"the variable {name}", "in the file", "no such one", where, step))
        value = value[part]
    return value


def _reals(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> Array:
    """Return an array of real numbers."""
    value = _numbers(space, name, where, tree)
    if np.iscomplexobj(value):
        step = "Say which variable is what in a mapping"
        raise KinematicsError(sentence(f"the variable {name}", "real numbers", "complex ones", where, step))
    return value.astype(float)


def _numbers(space: Mapping[str, Any], name: str, where: str, tree: Mapping[str, Any]) -> NDArray[Any]:
    value = stacked(_variable(space, name, where, tree))
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fciub" or value.size == 0:
        step = "Say which variable is what in a mapping"
        raise KinematicsError(
            sentence(f"the variable {name}", "an array of numbers", "something else", where, step)
        )
    return value


def _shaped(values: NDArray[Any], count: int, name: str, where: str) -> NDArray[Any]:
    """Return values as (point, F, beam)."""
    if values.ndim == 1:
        values = values[None]
    if values.ndim == 2:
        values = values[:, :, None]
    if values.ndim == 3 and values.shape[1] != count and values.shape[0] == count:
        values = np.swapaxes(values, 0, 1)
    if values.ndim != 3 or values.shape[1] != count or values.shape[2] not in (1, 3):
        got = " x ".join(map(str, values.shape if values.shape[-1] != 1 else values.shape[:-1]))
        want = f"points x {count}, as many columns as frequencies"
        raise KinematicsError(sentence(f"the variable {name}", want, got, where))
    return values


def _values(
    space: Mapping[str, Any], signal: Signal, count: int, where: str, tree: Mapping[str, Any]
) -> tuple[NDArray[np.complex128], str]:
    if signal.value_re:
        parts = [_numbers(space, name, where, tree) for name in (signal.value_re, signal.value_im)]
        shaped = [_shaped(part, count, signal.value_re, where) for part in parts]
        if shaped[0].shape != shaped[1].shape:
            want = f"as large as {signal.value_re}"
            raise KinematicsError(sentence(signal.value_im, want, "another size", where))
        return np.asarray(shaped[0] + 1j * shaped[1]), signal.value_re
    found = _numbers(space, signal.value, where, tree)
    if not np.iscomplexobj(found):
        if found.ndim == 2 and found.shape[1] == 2 * count:
            found = found[:, 0::2] + 1j * found[:, 1::2]
        else:
            step = "Export Real & Imag., not a magnitude: without phase there is no motion"
            raise KinematicsError(
                sentence(f"the variable {signal.value}", "complex", "real numbers", where, step)
            )
    return np.asarray(_shaped(found, count, signal.value, where), dtype=complex), signal.value


def _unit(
    space: Mapping[str, Any], signal: Signal, name: str, where: str, tree: Mapping[str, Any]
) -> MotionUnit:
    label = signal.unit.removeprefix("=")
    if not label and signal.usd:
        usd = _variable(space, signal.usd, where, tree)
        if isinstance(usd, dict):
            power = np.asarray(usd.get("PowerSignal", 0))
            if power.size == 1 and power.dtype.kind in "fiub" and bool(power.reshape(-1)[0]):
                step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
                raise KinematicsError(sentence(name, "an amplitude spectrum", "a power", where, step))
            label = str(usd.get("YUnit", ""))
    unit = motion_unit(label)
    if unit is None:
        got = f'"{label}"' if label else "none"
        step = 'Give it as unit = "m/s" in a mapping'
        raise KinematicsError(sentence(f"the unit of {name}", "; ".join(MOTIONS), got, where, step))
    return unit


def _names(
    space: Mapping[str, Any], layout: Layout, count: int, where: str, tree: Mapping[str, Any], point: str
) -> list[str]:
    if not layout.points:
        return [point] if point and count == 1 else [str(k) for k in range(1, count + 1)]
    found = _variable(space, layout.points, where, tree)
    if isinstance(found, str):
        names = [found]
    elif isinstance(found, list):
        names = [_name(one, layout.points, where) for one in found]
    else:
        names = [f"{number:g}" for number in _reals(space, layout.points, where, tree).reshape(-1)]
    if len(names) != count or len(set(names)) != len(names):
        want = f"{count} different names, one a row"
        raise KinematicsError(sentence(layout.points, want, f"{len(names)}", where))
    return names


def _name(one: Any, variable: str, where: str) -> str:
    if isinstance(one, str) and one.strip():
        return one.strip()
    if isinstance(one, np.ndarray) and one.size == 1 and one.dtype.kind in "fiu":
        return f"{float(one.reshape(-1)[0]):g}"
    raise KinematicsError(sentence(variable, "a name or number for every point", "something else", where))


def _positions(
    space: Mapping[str, Any], layout: Layout, count: int, where: str, tree: Mapping[str, Any]
) -> list[Array]:
    if not layout.position:
        return [unknown_vector()] * count
    found = _reals(space, layout.position, where, tree)
    if found.shape == (3, count) and count != 3:
        found = found.T
    found = found.reshape(1, 3) if found.size == 3 and count == 1 else found
    if found.shape != (count, 3):
        want = f"points x 3, here {count} x 3"
        got = " x ".join(map(str, found.shape))
        raise KinematicsError(sentence(layout.position, want, got, where))
    unit = layout.position_unit
    ending = re.search(_LENGTH_END, layout.position)
    if unit or ending:
        return list(found * _SCALES[unit or (ending[1] if ending else "m")])
    return list(found * 1e3)


def _companion(
    space: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str, tree: Mapping[str, Any]
) -> Array | None:
    if not name:
        return None
    found = _reals(space, name, where, tree)
    shaped = _shaped(found, shape[1], name, where)
    if shaped.shape[0] != shape[0] or shaped.shape[2] not in (1, shape[2]):
        raise KinematicsError(sentence(name, f"{shape[0]} x {shape[1]}", f"{shaped.shape[0]} rows", where))
    return np.broadcast_to(shaped, shape)


def _count(space: Mapping[str, Any], signal: Signal, where: str, tree: Mapping[str, Any]) -> float | None:
    if signal.n_avg == "":
        return None
    value = signal.n_avg
    number = np.asarray(_variable(space, value, where, tree) if isinstance(value, str) else value)
    if number.size != 1 or number.dtype.kind not in "fiu" or not float(number.reshape(-1)[0]) >= 1.0:
        raise KinematicsError(sentence("n_avg", "a number from 1 on", value, where))
    return float(number.reshape(-1)[0])


def _directions(
    space: Mapping[str, Any],
    signal: Signal,
    beam: int,
    values: NDArray[np.complex128],
    where: str,
    tree: Mapping[str, Any],
) -> list[Array]:
    count = len(values)
    if values.shape[2] == 3:
        return [np.array(_AXES["xyz"[beam]])] * count
    given = signal.direction
    if isinstance(given, str) and given.lower().lstrip("+-") in _AXES:
        sign = -1.0 if given.startswith("-") else 1.0
        return [sign * np.array(_AXES[given.lower().lstrip("+-")])] * count
    if isinstance(given, str) and given:
        found = _reals(space, given, where, tree)
        if found.shape not in ((count, 3), (1, 3)):
            raise KinematicsError(sentence(given, f"{count} x 3 directions", found.shape, where))
        return list(np.broadcast_to(found, (count, 3)))
    if isinstance(given, list):
        if len(given) != 3 or not all(isinstance(one, (int, float)) for one in given):
            raise KinematicsError(sentence("direction", "x, -x, ..., or three numbers", given, where))
        return [np.array(given, dtype=float)] * count
    axis = usd_direction(space.get(signal.usd)) if signal.usd else None
    return [unknown_vector() if axis is None else axis] * count
